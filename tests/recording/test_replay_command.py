"""Words of `cfplan replay` and of the watchers of `cfplan fly` that cannot be followed: one line, nothing written."""

import json
import resource
import shutil
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from cfplan.cli import cfplan
from cfplan.cli.output import Steps
from cfplan.cli.reference_plan import reference_plan
from cfplan.errors import InputError
from cfplan.geometry.min_snap import min_snap
from cfplan.planning.plan import plan
from cfplan.planning.plan_file import save_plan
from cfplan.preparation.plan_flight import plan_flight
from cfplan.recording.flight_figure import draw_flight
from cfplan.recording.reader import read_record
from cfplan.recording.rerun.record_view import write_rrd
from cfplan.recording.summary import summarise
from cfplan.recording.writer import write_summary
from cfplan.safety.limits_file import load_limits

REPOSITORY = Path(__file__).parents[2]


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


def test_a_figure_of_a_flight_lies_over_its_plan(flight, tmp_path):
    limits = load_limits(REPOSITORY / "safety.yaml")
    place = shutil.copytree(flight.folder, tmp_path / "flown")
    made = plan(min_snap([[-1, -1, 0.8], [1, -0.5, 0.9]]), limits.airframe, limits, planner="minsnap", nodes=40)
    save_plan(made, place / "plan.parquet")
    file = tmp_path / "a.svg"
    result = CliRunner().invoke(cfplan, ["replay", str(place), "--figure", str(file)])
    assert result.exit_code == 0, result.output
    record = read_record(place)
    worst = summarise(record).max_deviation
    (off,) = [axes for axes in draw_flight(record).axes if axes.get_ylabel() == "deviation, cm"]
    assert off.lines[0].get_ydata().max() == pytest.approx(100 * worst)
    assert "deviation, cm" in file.read_text()


def test_a_figure_is_of_one_record(flight, tmp_path):
    assert "one record" in refused("replay", flight.folder, flight.folder, "--figure", tmp_path / "a.svg").what
    assert "plan.parquet" in refused("replay", flight.folder, "--figure", tmp_path / "a.svg").where
    assert list(tmp_path.iterdir()) == []


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


def test_a_recording_that_does_not_fit_on_the_disk_leaves_the_old_file(flight, tmp_path):
    file = tmp_path / "a.rrd"
    file.write_text("mine")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))  # bytes; writing more fails as on a full disk
    try:
        error = refused("replay", flight.folder, "--save", file, "--force")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert error.where == str(file)
    assert [kept.read_text() for kept in tmp_path.iterdir()] == ["mine"]


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


def test_a_folder_of_records_is_listed(flight, tmp_path):
    for stamp in ("20240102-120000", "20240101-120000"):
        shutil.copytree(flight.folder, tmp_path / f"{stamp}-figure8")
    summary = {"uri": "sim://0", "outcome": {"reason": "landed"}, "travel_time_flown": 10.04, "max_deviation": 0.031}
    write_summary(tmp_path / "20240102-120000-figure8", summary)
    (tmp_path / "notes.txt").write_text("mine")
    shown = CliRunner().invoke(cfplan, ["replay", str(tmp_path)])
    assert shown.exit_code == 0
    first, last = [line for line in shown.output.splitlines() if line.strip().startswith("2024")]
    assert first.split()[0] == "20240101-120000-figure8"
    assert last.split() == ["20240102-120000-figure8", "sim://0", "landed", "10.04", "s", "3.1", "cm"]
    assert f"cfplan replay {tmp_path / '20240102-120000-figure8'}" in shown.output
    listed = json.loads(CliRunner().invoke(cfplan, ["replay", str(tmp_path), "--json"]).stdout)["records"]
    assert [entry.get("uri") for entry in listed] == [None, "sim://0"]


def test_a_log_is_laid_over_the_plan_that_flew(flight, tmp_path):
    """Of a record its own plan, of a path what `cfplan fly` would plan."""
    limits = load_limits(REPOSITORY / "safety.yaml")
    planned = plan_flight(REPOSITORY / "flights" / "line.yaml", limits)
    save_plan(planned.plan, shutil.copytree(flight.folder, tmp_path / "flown") / "plan.parquet", {"name": "line"})
    with click.Context(click.Command("replay")):
        steps = Steps(as_json=True)
        flown = reference_plan(tmp_path / "flown", None, steps)
        again = reference_plan(REPOSITORY / "flights" / "line.yaml", REPOSITORY / "safety.yaml", steps)
    assert flown.time[-1] == planned.plan.trajectory.duration
    assert again.time[-1] == pytest.approx(planned.plan.trajectory.duration, abs=1e-6)


def test_a_log_can_be_looked_at_in_a_room_too_small_for_its_path(tmp_path, capsys):
    small = (REPOSITORY / "safety.yaml").read_text().replace("4.0, 0.0]", "1.0, 0.0]").replace("4.0, 2.0]", "1.0, 2.0]")
    (tmp_path / "safety.yaml").write_text(small)
    with click.Context(click.Command("replay")):
        found = reference_plan(REPOSITORY / "flights" / "line.yaml", tmp_path / "safety.yaml", Steps(as_json=False))
    assert found.position[:, 1].max() > 3.0
    assert "not to be flown there" in capsys.readouterr().out
