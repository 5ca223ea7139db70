"""`cfplan fly` where hardware is not as it must be: one line with a hint, before anything is planned, nothing armed."""

import math

import pytest

from cfplan.cli import run_command
from cfplan.simulation.virtual_vicon.cameras import ViconSettings
from cfplan.simulation.virtual_vicon.vicon import serve

pytestmark = pytest.mark.integration

PATH = "waypoints: [[0, 0, 1], [1, 0, 1]]\n"
LEVEL = (0.0, 0.0, 0.0, 1.0)
TURNED = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))  # what a level body with y up looks like
ELSEWHERE = (("gate", (3.0, 0.0, 1.0)),)


@pytest.fixture
def refused(tmp_path, monkeypatch, capsys):
    """Fly with these options and without anything that could be armed; the error's one line."""

    def never(*_, **__):
        pytest.fail("a vehicle was reached for")

    monkeypatch.setattr("cfplan.simulation.lab.lab.launch_lab", never)
    monkeypatch.setattr("cfplan.flight.pilot.process.fly", never)
    (tmp_path / "path.yaml").write_text(PATH)

    def fly(*words: str) -> tuple[int, str]:
        records = tmp_path / "records"
        monkeypatch.setattr(
            "sys.argv", ["cfplan", "fly", str(tmp_path / "path.yaml"), "--records", str(records), "--yes", *words]
        )
        with pytest.raises(SystemExit) as ending:
            run_command()
        said = capsys.readouterr().err
        assert said.startswith("error: ")
        assert said.count("\n") == 1
        assert "hint: " in said
        assert not records.exists()
        return int(ending.value.code or 0), said

    return fly


@pytest.mark.parametrize(
    ("uri", "what"),
    [
        ("radio//0/80", "not the URI of a vehicle"),
        ("radio://0/80/3M/E7E7E7E7E7", "not a rate"),
        ("radio://0/126/2M", "not a channel"),
        ("udp://127.0.0.1", "port"),
        ("sim://nonsense", "no such virtual vehicle"),
    ],
)
def test_a_wrong_uri(refused, uri, what):
    code, said = refused("--uri", uri, "--mocap", "vicon://127.0.0.1/cf1")
    assert code == 2
    assert what in said


def test_an_absent_radio(refused, monkeypatch):
    monkeypatch.setattr("cfplan.flight.radio.crazyradio.find_radios", lambda kind=None: [])
    code, said = refused("--uri", "radio://0/80/2M/E7E7E7E7E7", "--mocap", "vicon://127.0.0.1/cf1")
    assert code == 8
    assert "plug one in" in said


@pytest.mark.parametrize("system", ["vicon", "vicon-sdk"])
def test_a_vicon_that_is_not_there(refused, system):
    code, said = refused("--mocap", f"{system}://127.0.0.1:9/cf1")
    assert code == 8
    assert "is Vicon Tracker running there" in said


def test_a_wrong_subject_with_those_there_are(refused):
    with serve(ViconSettings(others=ELSEWHERE), lambda _: ((0.0, 0.0, 0.0), LEVEL)) as vicon:
        code, said = refused("--mocap", vicon.uri_of("cf2", "vicon"))
    assert code == 2
    assert "no body named 'cf2'" in said
    assert "cf1, gate" in said


@pytest.mark.parametrize(
    ("position", "quaternion", "what"),
    [((500.0, 200.0, 3.0), LEVEL, "millimetres"), ((0.5, 0.0, 0.2), TURNED, "y up")],
    ids=["millimetres", "y up"],
)
def test_poses_in_millimetres_or_with_y_up(refused, position, quaternion, what):
    with serve(ViconSettings(), lambda _: (position, quaternion)) as vicon:
        code, said = refused("--mocap", vicon.uri)
    assert code == 2
    assert what in said
