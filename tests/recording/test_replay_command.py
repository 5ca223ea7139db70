"""Words of `cfplan replay` and of the watchers of `cfplan fly` that cannot be followed: one line, nothing written."""

import shutil

import pytest
from click.testing import CliRunner

from cfplan.cli import cfplan
from cfplan.errors import InputError
from cfplan.recording.rerun.record_view import write_rrd


def refused(*words):
    """The error that the command ends with."""
    result = CliRunner().invoke(cfplan, [str(word) for word in words])
    assert isinstance(result.exception, InputError), result.output
    assert "\n" not in str(result.exception)
    return result.exception


@pytest.fixture
def no_driver(monkeypatch, tmp_path):
    for name in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
        monkeypatch.setenv(name, str(tmp_path / "none.json"))


@pytest.mark.integration
def test_a_picture_without_a_driver_names_the_package_and_writes_nothing(flight, tmp_path, no_driver):
    error = refused("replay", flight.folder, "--png", tmp_path / "a.png")
    assert "mesa-vulkan-drivers" in error.hint
    assert list(tmp_path.iterdir()) == []


def test_a_picture_is_overwritten_only_when_told(flight, tmp_path):
    (tmp_path / "a.png").write_text("mine")
    assert "--force" in refused("replay", flight.folder, "--png", tmp_path / "a.png").hint
    assert (tmp_path / "a.png").read_text() == "mine"


@pytest.mark.parametrize("moment", ["12", "nan"])
def test_a_moment_belongs_to_a_picture(flight, tmp_path, moment):
    words = ["--save", tmp_path / "a.rrd"] if moment == "12" else ["--png", tmp_path / "a.png"]
    assert "--png" in refused("replay", flight.folder, *words, "--at", moment).hint
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_a_recording_of_reruns_whole_or_cut_off_is_told_where_to_go(flight, tmp_path, share):
    file = tmp_path / "a.rrd"
    write_rrd(flight.record, file)
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    error = refused("replay", file, "--save", tmp_path / "b.rrd")
    assert "rerun rrd merge" in error.hint
    assert not (tmp_path / "b.rrd").exists()


def test_a_truncated_record_is_drawn_as_far_as_it_goes_and_said(flight, tmp_path):
    place = shutil.copytree(flight.folder, tmp_path / "cut")
    file = place / "flight.mcap"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    result = CliRunner().invoke(cfplan, ["replay", str(place), "--save", str(tmp_path / "a.rrd")])
    assert result.exit_code == 0
    assert "truncated" in result.output
    assert (tmp_path / "a.rrd").stat().st_size > 0


def test_a_flight_without_a_screen_or_a_place_for_mavlink_does_not_begin(monkeypatch, tmp_path):
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    records = tmp_path / "records"
    assert "--live" in refused("fly", "line.yaml", "--live", "--records", records).hint
    for place in ("udp:14550", "tcp:127.0.0.1:5760", "udp:127.0.0.1:nan"):
        error = refused("fly", "line.yaml", "--mavlink", place, "--records", records)
        assert (error.where, "udp:127.0.0.1:14550" in error.hint) == (place, True)
    assert not records.exists()
