"""Logs laid over plans: found where they were flown, whatever was flown before, unseen, shifted or noisy."""

import dataclasses
import io
import json
import socket
from pathlib import Path

import numpy as np
import pytest
import rerun_cli
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from rerun.chunk import RrdReader
from rerun.experimental import ViewerClient
from waiting import a_moment, until

from cfplan.cli import cfplan
from cfplan.errors import InputError
from cfplan.geometry.min_snap import min_snap
from cfplan.planning.plan import plan
from cfplan.planning.plan_file import save_plan
from cfplan.recording.importers.mocap_log import LoggedSubject
from cfplan.recording.overlay import Reference, align, extent, rooms, short_name, trial_of_record, trial_of_subject
from cfplan.recording.reader import is_record
from cfplan.recording.rerun import layout
from cfplan.recording.rerun.overlay_view import DASH, dashes, references, stretches, write_overlay
from cfplan.recording.summary import summarise
from cfplan.safety.limits_file import load_limits

DURATION = 8.0
VULKAN = [Path("/usr/share/vulkan/icd.d"), Path("/etc/vulkan/icd.d")]


def software_vulkan():
    return any(list(folder.glob("lvp_icd*.json")) for folder in VULKAN)


def path(moments):
    """A knot flown once with a smooth begin and end, at rest before and after; (N, 3) m."""
    x = np.clip(np.asarray(moments) / DURATION, 0, 1)
    angle = 2 * np.pi * (10 * x**3 - 15 * x**4 + 6 * x**5)
    return np.stack([np.sin(2 * angle), 1.5 * np.sin(angle), 1 + 0.3 * np.sin(3 * angle)], axis=-1)


TIMES = np.append(np.arange(0, DURATION, 0.01), DURATION)
PLAN = Reference("knot", TIMES, path(TIMES))


def log(offset, *, length=30.0, rate=300.0, noise=0.0, aside=(0, 0, 0), gaps=(), seed=0):
    """A subject that flies the plan from `offset` on; each gap is (begin, end) in s of the log."""
    time = np.arange(0, length, 1 / rate) + 100.0
    position = path(time - 100.0 - offset) + np.array(aside)
    position += np.random.default_rng(seed).normal(0, noise, position.shape)
    for begin, end in gaps:
        position[(time - 100.0 >= begin) & (time - 100.0 < end)] = np.nan
    return LoggedSubject("cf1", time, position, np.full((len(time), 4), np.nan))


@settings(deadline=None, max_examples=12)
@given(offset=st.floats(0, 20), rate=st.sampled_from([60.0, 100.0, 240.0, 300.0]))
def test_the_offset_is_found_to_a_fraction_of_a_frame(offset, rate):
    found = align(log(offset, rate=rate), PLAN)
    assert found.offset == pytest.approx(100.0 + offset, abs=1e-3)
    assert found.rms_deviation < 2e-3  # straight lines between frames
    assert found.covered == pytest.approx(1.0, abs=0.01)
    assert found.alike


@settings(deadline=None, max_examples=12)
@given(aside=st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(-2, 2)), offset=st.floats(0, 20))
def test_a_shift_in_space_is_kept_told_and_does_not_move_the_time(aside, offset):
    found = align(log(offset, aside=aside), PLAN)
    assert found.offset == pytest.approx(100.0 + offset, abs=1e-3)
    np.testing.assert_allclose(found.aside, aside, atol=1e-3)
    assert found.rms_deviation == pytest.approx(np.linalg.norm(aside), abs=2e-3)


def test_noise_and_gaps_leave_the_offset_where_it_is():
    found = align(log(7.3, noise=0.005, gaps=((9, 10), (12, 12.5))), PLAN)
    assert found.offset == pytest.approx(107.3, abs=2e-3)
    assert found.covered == pytest.approx(1 - 1.5 / DURATION, abs=0.01)
    assert found.rms_deviation == pytest.approx(0.005 * np.sqrt(3), rel=0.1)


def test_a_log_that_begins_in_the_middle_of_the_flight_is_laid_there():
    whole = log(5.0)
    late = whole.time > 107.0
    found = align(LoggedSubject("cf1", whole.time[late], whole.position[late], whole.quaternion[late]), PLAN)
    assert found.offset == pytest.approx(105.0, abs=1e-3)
    assert found.covered == pytest.approx(0.75, abs=0.01)


def test_a_constant_lag_is_taken_for_time_and_a_growing_one_is_deviation():
    assert align(log(5.0 + 0.08), PLAN).rms_deviation < 1e-3
    time = log(5.0).time
    slower = LoggedSubject("cf1", time, path((time - 105.0) * 0.97), np.full((len(time), 4), np.nan))
    assert align(slower, PLAN).rms_deviation > 0.02


def test_another_flight_hardly_looks_like_the_plan():
    time = np.arange(0, 30, 0.01)
    circle = np.stack([np.cos(time), np.sin(time), 1 + 0 * time], axis=1)
    assert not align(LoggedSubject("cf1", time, circle, np.full((len(time), 4), np.nan)), PLAN).alike


def test_a_subject_that_was_hardly_seen_cannot_be_laid():
    with pytest.raises(InputError, match="too short"):
        align(log(5.0, gaps=((0.001, 100),)), PLAN)


def test_the_deviation_of_a_trial_is_that_from_the_plan_at_its_time():
    trial = trial_of_subject(log(5.0, aside=(0.03, 0.04, 0)), PLAN, 105.0)
    inside = (trial.time > 0.01) & (trial.time < DURATION - 0.01)
    np.testing.assert_allclose(trial.deviation[inside], 0.05, atol=1e-3)
    assert np.isnan(trial.deviation[(trial.time < -0.01) | (trial.time > DURATION + 0.01)]).all()


def test_the_speed_of_a_trial_is_that_of_its_path_and_unknown_at_gaps():
    trial = trial_of_subject(log(5.0, gaps=((8, 9),)), PLAN, 105.0)
    slope = (path(trial.time + 1e-5) - path(trial.time - 1e-5)) / 2e-5
    known = np.isfinite(trial.speed)
    np.testing.assert_allclose(trial.speed[known], np.linalg.norm(slope, axis=1)[known], atol=0.02)
    assert not known[(trial.time > 3) & (trial.time < 4)].any()


def test_a_record_as_a_trial_deviates_as_its_summary_says(flight):
    trial = trial_of_record(flight.record, "made up")
    assert np.nanmax(trial.deviation) == pytest.approx(summarise(flight.record).max_deviation, rel=1e-9)


def test_the_room_of_a_record_is_around_all_that_is_drawn(flight):
    trial = trial_of_record(flight.record, "flight")
    assert rooms([trial, trial]) == [flight.record.header.fence]
    low, high = extent([trial])
    assert (low <= flight.record.header.fence[0]).all()
    assert (high >= flight.record.header.fence[1]).all()


def test_trials_of_one_plan_share_their_reference(flight):
    first = trial_of_record(flight.record, "a")
    moved = dataclasses.replace(first.reference, position=first.reference.position + 0.5)
    second, third = (dataclasses.replace(first, name=name) for name in "bc")
    assert len(references([first, second, dataclasses.replace(third, reference=moved)])) == 2


def test_dashes_lie_on_the_line_and_cover_half_of_it():
    line = np.array([[0.0, 0, 0], [0, 0, 0], [3, 0, 0], [3, 4, 0]])
    pieces = dashes(line)
    lengths = [np.linalg.norm(np.diff(piece, axis=0), axis=1).sum() for piece in pieces]
    assert sum(lengths) == pytest.approx(3.5, abs=DASH)
    for piece in pieces:
        on_first, on_second = piece[:, 1] == 0, piece[:, 0] == pytest.approx(3)
        assert np.all(on_first | on_second)


def test_stretches_are_what_was_seen():
    trial = trial_of_subject(log(5.0, gaps=((8, 9), (12, 13))))
    pieces = stretches(trial)
    assert len(pieces) == 3
    assert np.isfinite(trial.position[np.concatenate(pieces)]).all()


def test_an_overlay_of_nothing_seen_still_has_an_extent():
    nothing = LoggedSubject("cf1", np.arange(3.0), np.full((3, 3), np.nan), np.full((3, 4), np.nan))
    low, high = extent([trial_of_subject(nothing)])
    assert np.all(high > low)


def rows(file, entity, component):
    values = []
    for chunk in RrdReader(file).stream().filter(content=[entity]):
        batch = chunk.to_record_batch()
        if layout.TIMELINE in batch.schema.names and component in batch.schema.names:
            stamps = [stamp.value * 1e-9 for stamp in batch.column(layout.TIMELINE)]
            values += zip(stamps, batch.column(component).to_pylist(), strict=True)
    return sorted(values)


def test_trials_read_back_from_the_recording(tmp_path):
    trial = trial_of_subject(log(5.0, rate=100.0, gaps=((8, 9),)), PLAN, 105.0)
    write_overlay([trial, trial], tmp_path / "a.rrd")
    for index in (0, 1):
        drawn = rows(tmp_path / "a.rrd", f"/world/trial/{index}/body", "Transform3D:translation")
        seen = np.isfinite(trial.position).all(axis=1)
        np.testing.assert_allclose([time for time, _ in drawn], trial.time[seen], atol=2e-9)
        np.testing.assert_allclose([place[0] for _, place in drawn], trial.position[seen], atol=1e-6)
        curve = rows(tmp_path / "a.rrd", f"/plots/x/trial_{index}", "Scalars:scalars")
        values = np.array([value for _, (value,) in curve])
        np.testing.assert_array_equal(values[np.isfinite(values)], trial.position[seen, 0])
        assert np.isnan(values).sum() == 1  # behind the stretch before the gap


@pytest.mark.integration
@pytest.mark.skipif(not software_vulkan(), reason="no software Vulkan driver (Debian: mesa-vulkan-drivers)")
def test_every_view_of_an_overlay_renders_without_reports_and_is_not_blank(tmp_path, monkeypatch):
    monkeypatch.setenv("RERUN_ANALYTICS", "false")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    trials = [trial_of_subject(log(5.0, gaps=((8, 9),)), PLAN, 105.0), trial_of_subject(log(6.0), PLAN, 105.0)]
    write_overlay(trials, tmp_path / "a.rrd")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    executable = Path(rerun_cli.__file__).with_name("rerun")
    viewer = ViewerClient.spawn(headless=True, port=port, hide_welcome_screen=True, executable_path=str(executable))
    try:
        viewer.open(str(tmp_path / "a.rrd"))
        assert until(lambda: not viewer.get_state().loading)
        viewer.set_time(layout.TIMELINE, duration=4.0)
        a_moment(1.0)
        views = viewer.get_state().views
        assert {view.name for view in views} == {"Trials", "Deviation, m", "Speed, m/s", "x, m", "y, m", "z, m"}
        for view in views:
            assert view.reports == [], view.name
            image = Image.open(io.BytesIO(viewer.take_screenshot(view.view_id))).convert("RGB")
            assert len(image.getcolors(maxcolors=1 << 24)) > 20, view.name
        assert [entry.message for entry in viewer.get_logs() if entry.level == "ERROR"] == []
    finally:
        viewer.quit()


def write_vicon(file, position):
    """A subject cf1 at 100 Hz, level."""
    head = "Objects\n100\n,,Global Angle (Quaternion) cf1:cf1,,,,,,\n"
    head += "Frame,Sub Frame,RX,RY,RZ,RW,TX,TY,TZ\n,,,,,,mm,mm,mm\n"
    rows = [f"{i + 1},0,0,0,0,1,{x:.6f},{y:.6f},{z:.6f}\n" for i, (x, y, z) in enumerate(1000 * position)]
    file.write_text(head + "".join(rows))
    return file


@pytest.fixture
def vicon(tmp_path):
    return write_vicon(tmp_path / "vicon.csv", log(5.0, rate=100.0).position)


def run(*arguments):
    return CliRunner().invoke(cfplan, [str(argument) for argument in arguments])


def test_replay_lays_a_record_and_a_log_side_by_side(tmp_path, vicon, flight):
    result = run("replay", vicon, flight.folder, "--save", tmp_path / "a.rrd", "--json")
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    assert [trial["name"] for trial in document["trials"]] == ["cf1", flight.folder.name]
    assert (tmp_path / "a.rrd").stat().st_size > 10_000


def test_replay_lays_a_log_over_a_plan_and_prints_the_offset(tmp_path):
    limits = load_limits(Path(__file__).parents[2] / "safety.yaml")
    path = min_snap([[-1, -1, 0.8], [0, 0.5, 1.2], [1, -0.5, 0.9]])
    made = plan(path, limits.airframe, limits, planner="minsnap", nodes=60)
    save_plan(made, tmp_path / "plan.parquet")
    moments = np.arange(0, made.trajectory.duration + 6, 0.01)
    file = write_vicon(tmp_path / "vicon.csv", made.trajectory.at(moments - 3.21).position)
    result = run("replay", file, "--plan", tmp_path / "plan.parquet", "--save", tmp_path / "a.rrd")
    assert result.exit_code == 0, result.output
    assert "offset 3.210 s, 100 % of the plan seen" in result.stdout


def test_replay_of_one_record_is_its_own_view(tmp_path, flight):
    result = run("replay", flight.folder, "--save", tmp_path / "a.rrd", "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["travel_time_planned"] == 10.0


def test_replay_lists_the_subjects_where_one_is_not_there(tmp_path, vicon):
    result = run("replay", vicon, "--subject", "cf2", "--save", tmp_path / "a.rrd")
    assert isinstance(result.exception, InputError)
    assert result.exception.hint == "it has: cf1"
    assert not (tmp_path / "a.rrd").exists()


def test_replay_overwrites_only_when_told(tmp_path, vicon):
    (tmp_path / "a.rrd").write_text("mine")
    assert isinstance(run("replay", vicon, "--save", tmp_path / "a.rrd").exception, InputError)
    assert (tmp_path / "a.rrd").read_text() == "mine"
    assert run("replay", vicon, "--save", tmp_path / "a.rrd", "--force").exit_code == 0


def test_a_record_is_told_from_other_logs(tmp_path, flight, vicon):
    other = tmp_path / "other.mcap"
    other.write_bytes((flight.folder / "flight.mcap").read_bytes().replace(b"cfplan", b"ros2..", 1))
    named = tmp_path / "renamed"
    named.write_bytes((flight.folder / "flight.mcap").read_bytes()[:500])
    assert is_record(flight.folder)
    assert is_record(named)
    assert not any(is_record(place) for place in (other, vicon, tmp_path, tmp_path / "none"))


@pytest.mark.parametrize(
    ("name", "short"),
    [("20261122-094221-figure8", "figure8 09:42:21"), ("20261122-094221-a-b-2", "a-b-2 09:42:21"), ("cf1", "cf1")],
)
def test_a_record_has_a_label_that_can_be_read(name, short):
    assert short_name(name) == short
