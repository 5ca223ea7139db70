"""`cfplan mocap`, and what `cfplan fly` says about motion capture."""

import json

import pytest
from click.testing import CliRunner

from cfplan.cli import cfplan
from cfplan.errors import CfplanError, InputError, LinkError
from cfplan.simulation.virtual_vicon.cameras import ViconSettings
from cfplan.simulation.virtual_vicon.faults import FaultKind, ViconFault
from cfplan.simulation.virtual_vicon.vicon import serve
from cfplan.steering.starting_vehicle import check_uris


def moving(t):
    return (0.1 * t, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0)


@pytest.fixture
def vicon():
    settings = ViconSettings(
        segment="root",
        others=(("gate", (1.0, 2.0, 0.0)),),
        faults=(ViconFault(FaultKind.OCCLUDE, start=-1.0, subject="gate"),),
    )
    with serve(settings, moving) as served:
        yield served


def run(*arguments):
    """The result of a command that ended well."""
    result = CliRunner().invoke(cfplan, [str(each) for each in arguments])
    if isinstance(result.exception, CfplanError):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.output


@pytest.mark.integration
def test_bodies_rate_and_remarks_are_one_document(vicon):
    found = json.loads(run("mocap", vicon.uri, "--json", "--seconds", "1.0"))
    assert found["rate"] > 0  # how exactly is tested on the stepped clock, with the virtual Vicon
    assert found["announced_rate"] == 100
    assert found["latency"] == pytest.approx(0.01)
    bodies = {body["name"]: body for body in found["bodies"]}
    assert bodies["cf1"]["counts"]["good"] > 25
    assert bodies["cf1"]["segments"] == ["root"]
    assert bodies["gate"]["position"] is None
    assert any("named 'root'" in remark for remark in found["remarks"])
    assert "gate: never seen" in found["remarks"]


@pytest.mark.integration
def test_a_person_reads_a_table(vicon):
    text = run("mocap", vicon.uri_of(""), "--seconds", "0.3")
    for word in ("cf1", "gate", "not seen", "Hz", "jitter", "missing"):
        assert word in text


@pytest.mark.integration
def test_a_body_that_is_not_there_is_an_error(vicon):
    with pytest.raises(InputError, match="no body named 'cf2'") as caught:
        run("mocap", vicon.uri_of("cf2"))
    assert "cf1, gate" in caught.value.hint


@pytest.mark.integration
def test_nobody_there_is_an_error():
    with pytest.raises(LinkError, match="refused"):
        run("mocap", "vicon://127.0.0.1:9")


def test_hardware_needs_motion_capture_before_anything_else():
    with pytest.raises(InputError, match="needs a source of poses") as caught:
        check_uris("radio://0/80/2M/E7E7E7E7E7", None)
    assert "--mocap" in caught.value.hint
    with pytest.raises(InputError, match="which body"):
        check_uris("radio://0/80/2M/E7E7E7E7E7", "vicon://192.168.1.2")
    check_uris("radio://0/80/2M/E7E7E7E7E7", "qualisys://192.168.1.2/cf1")


def test_the_virtual_crazyflie_has_poses_of_its_own_and_a_virtual_vicon():
    check_uris("sim://0", None)
    check_uris("sim://0", "vicon-sdk://lab/cf1")
    with pytest.raises(InputError, match="virtual Vicon only"):
        check_uris("sim://0", "vrpn://lab/cf1")


@pytest.mark.integration
@pytest.mark.parametrize("uri", ["vrpn://127.0.0.1:3999", "vrpn://127.0.0.1:3999/cf1"])
def test_a_vrpn_server_that_is_not_there_is_an_error_not_an_empty_table(uri):
    with pytest.raises(LinkError, match="nothing") as caught:
        run("mocap", uri, "--seconds", "0.5")
    assert "server" in caught.value.hint
