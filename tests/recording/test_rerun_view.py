"""The rerun recording: complete, in order, equal to the record, and fit to be looked at."""

import dataclasses
import io
import os
import socket
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
import rerun_cli
from PIL import Image
from rerun.chunk import RrdReader
from rerun.components import AggregationPolicy
from rerun.experimental import ViewerClient

from cfplan.errors import InputError
from cfplan.recording import layout
from cfplan.recording.plots import finite_limits, motor_thrust, plots
from cfplan.recording.reader import read_record
from cfplan.recording.rerun_view import floor_lines, show, vehicle_outline, write_rrd
from cfplan.recording.writer import RecordWriter

RERUN = Path(rerun_cli.__file__).with_name("rerun")
VULKAN = [Path("/usr/share/vulkan/icd.d"), Path("/etc/vulkan/icd.d")]


@pytest.fixture(scope="module")
def rrd(flight, tmp_path_factory):
    file = tmp_path_factory.mktemp("rrd") / "flight.rrd"
    write_rrd(flight.record, file)
    return file


def verify(file):
    environment = {**os.environ, "RERUN_ANALYTICS": "false"}
    return subprocess.run([RERUN, "rrd", "verify", file], capture_output=True, text=True, env=environment, timeout=60)


def rows(file, entity, component):
    """(times in s, values) of one component of an entity, in order of time."""
    times, values = [], []
    for chunk in RrdReader(file).stream().filter(content=[entity]):
        batch = chunk.to_record_batch()
        if layout.TIMELINE in batch.schema.names and component in batch.schema.names:
            times += [stamp.value * 1e-9 for stamp in batch.column(layout.TIMELINE)]
            values += batch.column(component).to_pylist()
    order = np.argsort(times, kind="stable")
    return np.array(times)[order], [values[i] for i in order]


def test_rerun_accepts_the_recording(rrd):
    result = verify(rrd)
    assert result.returncode == 0, result.stdout + result.stderr


def test_the_blueprint_is_inside(rrd):
    assert len(RrdReader(rrd).blueprints()) == 1


@pytest.mark.parametrize(
    ("entity", "stream", "stamp"), [(layout.BODY, "poses", "time"), (layout.GHOST, "setpoints", "due")]
)
def test_poses_and_setpoints_read_back_equal_to_the_record(flight, rrd, entity, stream, stamp):
    wanted = getattr(flight.record, stream)
    times, positions = rows(rrd, f"/{entity}", "Transform3D:translation")
    np.testing.assert_allclose(times, getattr(wanted, stamp) - flight.record.start, atol=2e-9)
    np.testing.assert_array_equal(np.array(positions)[:, 0, :], wanted.position.astype(np.float32))
    _, quaternions = rows(rrd, f"/{entity}", "Transform3D:quaternion")
    np.testing.assert_array_equal(np.array(quaternions)[:, 0, :], wanted.quaternion.astype(np.float32))


def test_every_curve_reads_back_equal(flight, rrd):
    for plot in plots(flight.record):
        for line in plot.lines:
            times, values = rows(rrd, f"/{layout.PLOTS}/{plot.name}/{line.name}", "Scalars:scalars")
            np.testing.assert_allclose(times, line.time - flight.record.start, atol=2e-9)
            np.testing.assert_array_equal(np.array(values).reshape(line.values.shape), line.values)


def test_every_limit_is_a_level_line_over_the_whole_flight(flight, rrd):
    for plot in plots(flight.record):
        times, values = rows(rrd, f"/{layout.PLOTS}/{plot.name}/limit", "Scalars:scalars")
        np.testing.assert_allclose(times, [0, flight.record.duration], atol=2e-9)
        assert values == [list(finite_limits(plot))] * 2


def test_curves_are_drawn_such_that_no_spike_is_averaged_away(rrd):
    policies = []
    for chunk in RrdReader(rrd).stream().filter(content=[f"/{layout.PLOTS}/**"]):
        batch = chunk.to_record_batch()
        if "SeriesLines:aggregation_policy" in batch.schema.names:
            policies += batch.column("SeriesLines:aggregation_policy").to_pylist()
    assert len(policies) >= 8
    assert policies == [[AggregationPolicy.MinMax.value]] * len(policies)


def test_phases_and_events_read_back_equal(flight, rrd):
    times, phases = rows(rrd, f"/{layout.PHASES}", "StateChange:state")
    assert [phase for (phase,) in phases] == flight.record.phases.phase.tolist()
    np.testing.assert_allclose(times, flight.record.phases.time - flight.record.start, atol=2e-9)
    _, texts = rows(rrd, f"/{layout.EVENTS}", "TextLog:text")
    assert [text for (text,) in texts] == flight.record.events.text.tolist()
    _, levels = rows(rrd, f"/{layout.EVENTS}", "TextLog:level")
    assert [level for (level,) in levels] == ["INFO", "WARN", "INFO"]


def test_flight_is_the_only_timeline(rrd):
    for chunk in RrdReader(rrd).stream().filter(content=["/world/**", "/plots/**", "/phase", "/events"]):
        names = set(chunk.to_record_batch().schema.names)
        assert not names & {"log_time", "log_tick"}


def test_thrust_follows_the_command_up_to_the_cap(flight):
    record = flight.record
    status = dataclasses.replace(record.status, motor=np.array([[0, 65535, 13107, 32767]]))
    thrust = motor_thrust(dataclasses.replace(record, status=status))
    np.testing.assert_allclose(thrust, [[0.0, 0.12, 0.024, 0.06]], atol=1e-6)


def test_the_drawn_vehicle_has_its_motors_where_the_airframe_has_them():
    crossing_a, crossing_b, *rotors = vehicle_outline(0.1)
    ends = np.concatenate([crossing_a, crossing_b])
    np.testing.assert_allclose(np.abs(ends), [[0.1, 0.1, 0.0]] * 4)
    for rotor in rotors:
        np.testing.assert_allclose(np.abs(rotor[:-1].mean(axis=0)), [0.1, 0.1, 0.0], atol=1e-12)


def test_the_floor_lies_beneath_the_fence():
    lines = np.concatenate(floor_lines(np.array([-1.2, -3.0, 0.2]), np.array([1.9, 3.4, 2.0])))
    np.testing.assert_array_equal(lines.min(axis=0), [-2, -3, 0])
    np.testing.assert_array_equal(lines.max(axis=0), [2, 4, 0])


def test_a_record_with_hardly_anything_in_it_can_be_viewed(tmp_path, flight, small_header):
    RecordWriter(tmp_path / "empty", small_header).close()
    with RecordWriter(tmp_path / "few", small_header) as writer:
        for message in flight.messages[:3]:
            writer.write(message)
    for name in ("empty", "few"):
        write_rrd(read_record(tmp_path / name), tmp_path / f"{name}.rrd")
        assert verify(tmp_path / f"{name}.rrd").returncode == 0


def test_a_recording_is_not_overwritten_unasked(tmp_path, flight):
    file = tmp_path / "a.rrd"
    file.write_text("mine")
    with pytest.raises(InputError, match="already"):
        write_rrd(flight.record, file)
    assert file.read_text() == "mine"
    write_rrd(flight.record, file, overwrite=True)
    assert verify(file).returncode == 0
    assert [path.name for path in tmp_path.iterdir()] == ["a.rrd"]


def test_a_folder_that_is_not_there_is_an_error(tmp_path, flight):
    with pytest.raises(InputError, match="cannot be written") as caught:
        write_rrd(flight.record, tmp_path / "nowhere" / "a.rrd")
    assert "nowhere" in caught.value.where


def test_without_a_screen_showing_is_an_error_with_a_way_out(flight, monkeypatch):
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(InputError, match="no screen") as caught:
        show(flight.record)
    assert "--save" in caught.value.hint


def software_vulkan():
    return any(list(folder.glob("lvp_icd*.json")) for folder in VULKAN)


@pytest.mark.integration
@pytest.mark.skipif(not software_vulkan(), reason="no software Vulkan driver (Debian: mesa-vulkan-drivers)")
def test_every_view_renders_without_reports_and_is_not_blank(rrd, tmp_path, monkeypatch):
    monkeypatch.setenv("RERUN_ANALYTICS", "false")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    viewer = ViewerClient.spawn(headless=True, port=port, hide_welcome_screen=True, executable_path=str(RERUN))
    try:
        viewer.open(str(rrd))
        deadline = time.monotonic() + 30
        while viewer.get_state().loading and time.monotonic() < deadline:
            time.sleep(0.1)
        viewer.set_time(layout.TIMELINE, duration=12.0)
        time.sleep(1.0)
        views = viewer.get_state().views
        assert len(views) == 12
        for view in views:
            assert view.reports == [], view.name
            if view.name != "Summary":  # behind the events, in the same tabs
                image = Image.open(io.BytesIO(viewer.take_screenshot(view.view_id))).convert("RGB")
                colours = image.getcolors(maxcolors=1 << 24)
                assert len(colours) > 20, view.name
        assert [entry.message for entry in viewer.get_logs() if entry.level == "ERROR"] == []
    finally:
        viewer.quit()
