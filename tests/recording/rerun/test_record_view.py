"""The rerun recording: complete, in order, equal to the record, and fit to be looked at."""

import dataclasses
import io
import itertools
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import rerun_cli
from PIL import Image
from rerun.chunk import RrdReader
from rerun.components import AggregationPolicy

from cfplan.errors import InputError
from cfplan.geometry.min_snap import min_snap
from cfplan.planning.active_limits import ACTIVE, FREE, active_limits
from cfplan.planning.plan import plan
from cfplan.planning.plan_file import save_plan
from cfplan.recording.plots import motor_thrust, near_limits, plots
from cfplan.recording.reader import read_record
from cfplan.recording.record import PLAN_FILE, meant_motion
from cfplan.recording.rerun import layout
from cfplan.recording.rerun.picture import SIZE, HeadlessViewer
from cfplan.recording.rerun.record_view import HOVER_ARROW, floor_lines, picture, show, vehicle_outline, write_rrd
from cfplan.recording.summary import reference_times
from cfplan.recording.writer import RecordWriter
from cfplan.safety.limits_file import load_limits

RERUN = Path(rerun_cli.__file__).with_name("rerun")
VULKAN = [Path("/usr/share/vulkan/icd.d"), Path("/etc/vulkan/icd.d")]


@pytest.fixture(scope="module")
def made_plan():
    limits = load_limits(Path(__file__).parents[3] / "safety.yaml")
    path = min_snap([[-1, -1, 0.8], [0, 0.5, 1.2], [1, -0.5, 0.9]])
    return plan(path, limits.airframe, limits, planner="minsnap", nodes=60)


@pytest.fixture(scope="module")
def rrd_with_plan(flight, made_plan, tmp_path_factory):
    folder = tmp_path_factory.mktemp("planned") / "flight"
    shutil.copytree(flight.folder, folder)
    save_plan(dataclasses.replace(made_plan, joints=(made_plan.path.end / 3,)), folder / PLAN_FILE)
    file = folder / "flight.rrd"
    write_rrd(read_record(folder), file)
    return file


@pytest.fixture(scope="module")
def rrd(flight, tmp_path_factory):
    file = tmp_path_factory.mktemp("rrd") / "flight.rrd"
    write_rrd(flight.record, file)
    return file


def verify(file):
    return rrd_tool("verify", file)


def rrd_tool(word, file):
    environment = {**os.environ, "RERUN_ANALYTICS": "false"}
    return subprocess.run([RERUN, "rrd", word, file], capture_output=True, text=True, env=environment, timeout=60)


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


def test_the_blueprint_is_inside_and_goes_before_the_one_that_the_viewer_remembers(rrd):
    assert len(RrdReader(rrd).blueprints()) == 1
    assert "make_active: true" in rrd_tool("print", rrd).stdout


@pytest.mark.parametrize(
    ("entity", "stream", "when"),
    [
        (layout.BODY, "poses", lambda poses: poses.time),
        (layout.GHOST, "setpoints", reference_times),
    ],
)
def test_poses_and_setpoints_read_back_equal_to_the_record(flight, rrd, entity, stream, when):
    wanted = getattr(flight.record, stream)
    times, positions = rows(rrd, f"/{entity}", "Transform3D:translation")
    np.testing.assert_allclose(times, when(wanted) - flight.record.start, atol=2e-9)
    np.testing.assert_array_equal(np.array(positions)[:, 0, :], wanted.position.astype(np.float32))
    _, quaternions = rows(rrd, f"/{entity}", "Transform3D:quaternion")
    shown = wanted.quaternion if stream == "poses" else meant_motion(wanted)[0]  # packets carry other attitudes
    np.testing.assert_array_equal(np.array(quaternions)[:, 0, :], shown.astype(np.float32))


def test_every_curve_reads_back_equal(flight, rrd):
    for plot in plots(flight.record):
        for line in plot.lines:
            times, values = rows(rrd, f"/{layout.PLOTS}/{plot.name}/{line.name}", "Scalars:scalars")
            np.testing.assert_allclose(times, line.time - flight.record.start, atol=2e-9)
            np.testing.assert_array_equal(np.array(values).reshape(line.values.shape), line.values)


def test_every_limit_near_what_was_measured_is_a_level_line_over_the_whole_flight(flight, rrd):
    drawn = {plot.name: near_limits(plot.limits, [line.values for line in plot.lines]) for plot in plots(flight.record)}
    assert len(drawn["motor_thrust"]) == 2
    assert drawn["deviation"] == ()  # 0.5 m would make centimetres invisible
    for name, limits in drawn.items():
        if limits:
            times, values = rows(rrd, f"/{layout.PLOTS}/{name}/limit", "Scalars:scalars")
            np.testing.assert_allclose(times, [0, flight.record.duration], atol=2e-9)
            assert values == [list(limits)] * 2


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
    assert [text for (text,) in texts] == [
        "  0.11 s  connected to sim://0", " 10.11 s  no pose for 0.1 s", " 17.01 s  the path is flown",
    ]  # fmt: skip
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
    with pytest.raises(InputError, match="no such folder") as caught:
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


needs_driver = pytest.mark.skipif(
    not software_vulkan(), reason="no software Vulkan driver (Debian: mesa-vulkan-drivers)"
)


def colours(picture):
    return len(Image.open(io.BytesIO(picture)).convert("RGB").getcolors(maxcolors=1 << 24))


@pytest.mark.slow
@pytest.mark.integration
@needs_driver
def test_every_view_renders_without_reports_and_is_not_blank(rrd_with_plan):
    with HeadlessViewer.opened(rrd_with_plan) as viewer:
        viewer.go_to(12.0)
        views = viewer.views()
        assert len(views) == 12
        for view in views:
            assert view.reports == (), view.name
            if view.name != "Summary":  # behind the events, in the same tabs
                assert colours(viewer.picture(view)) > 20, view.name
        assert viewer.complaints() == ()


@pytest.mark.integration
@needs_driver
def test_a_picture_is_the_whole_window_at_its_moment(flight, tmp_path):
    for name, moment in (("early", 8.0), ("late", None)):
        assert picture(flight.record, tmp_path / name, moment=moment) == ()
    images = {file.name: Image.open(file).convert("RGB") for file in tmp_path.iterdir()}
    assert {image.size for image in images.values()} == {SIZE}
    assert len({image.tobytes() for image in images.values()}) == 2


@pytest.mark.integration
def test_without_a_driver_a_picture_is_an_error_with_a_way_out(flight, tmp_path, monkeypatch):
    monkeypatch.setenv("VK_DRIVER_FILES", str(tmp_path / "none.json"))
    monkeypatch.setenv("VK_ICD_FILENAMES", str(tmp_path / "none.json"))
    with pytest.raises(InputError, match="no Vulkan driver") as caught:
        picture(flight.record, tmp_path / "a.png")
    assert "mesa-vulkan-drivers" in caught.value.hint
    assert list(tmp_path.iterdir()) == []


def test_a_picture_is_not_overwritten_unasked(flight, tmp_path):
    (tmp_path / "a.png").write_text("mine")
    with pytest.raises(InputError, match="already"):
        picture(flight.record, tmp_path / "a.png")
    assert (tmp_path / "a.png").read_text() == "mine"


def test_where_a_limit_is_active_is_where_the_plan_uses_nearly_all_of_it(made_plan):
    active = active_limits(made_plan)
    state, limits = made_plan.trajectory.at(active.time), made_plan.limits.plan
    used = {
        "speed": np.linalg.norm(state.velocity, axis=1) / limits.speed,
        "acceleration": np.linalg.norm(state.acceleration, axis=1) / limits.acceleration,
    }
    for name, share in used.items():
        assert np.all(share[active.name == name] >= ACTIVE)
        assert np.all(share[active.name == FREE] < ACTIVE)
    assert made_plan.certificate.worst.name in active.name


def test_stretches_of_active_limits_are_in_order_and_leave_nothing_out(made_plan):
    active = active_limits(made_plan)
    covered = [(rows.start, rows.stop) for _, rows in active.stretches()]
    assert covered[0][0] == 0
    assert covered[-1][1] == len(active.time)
    assert all(begin == end - 1 for (_, end), (begin, _) in itertools.pairwise(covered))
    for name, rows in active.stretches():
        assert set(active.name[rows.start : rows.stop - 1]) <= {name}


@pytest.mark.parametrize("entity", [layout.PIECES, layout.JOINTS])
def test_where_the_plan_was_put_together_is_in_the_recording(rrd_with_plan, made_plan, entity):
    places = {layout.PIECES: made_plan.path.breaks, layout.JOINTS: [made_plan.path.end / 3]}[entity]
    (drawn,) = [
        value
        for chunk in RrdReader(rrd_with_plan).stream().filter(content=[f"/{entity}"])
        for value in chunk.to_record_batch().column("Points3D:positions").to_pylist()
    ]
    np.testing.assert_allclose(drawn, made_plan.path(np.array(places)), atol=1e-6)


def test_active_limits_of_the_plan_are_in_the_recording(rrd_with_plan, made_plan):
    times, names = rows(rrd_with_plan, f"/{layout.ACTIVE_LIMIT}", "StateChange:state")
    assert [name for (name,) in names] == [name for name, _ in active_limits(made_plan).stretches()] + [FREE]
    assert times[-1] - times[0] == pytest.approx(made_plan.trajectory.duration)


def test_the_thrust_arrow_in_hover_has_its_length(flight, rrd):
    times, arrows = rows(rrd, f"/{layout.THRUST}", "Arrows3D:vectors")
    length = np.array(arrows)[:, 0, 2]
    hovering = (times > 18.5) & (times < 19.5)
    assert np.mean(length[hovering]) == pytest.approx(HOVER_ARROW, rel=0.01)
    assert np.all(length[times < 2.9] == 0.0)
