"""Draw a flight as a rerun recording: room, path and vehicle in 3-D, plots with their limits, phases and events.

Everything is sent as complete columns after the flight; the stream's process never sees any of this. All times are
seconds since the record's first message, on the one timeline `flight`.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from cfplan.flight.setpoints.packets import PAYLOAD_SIZE, decode
from cfplan.flight.telemetry import Level
from cfplan.recording.header import RecordHeader
from cfplan.recording.plots import FLOWN as FLOWN_COLOUR
from cfplan.recording.plots import LIMIT, Colour, Plot, finite_limits, motor_thrust, near_limits, plots
from cfplan.recording.plots import WANTED as WANTED_COLOUR
from cfplan.recording.record import Record, meant_motion
from cfplan.recording.rerun import layout
from cfplan.recording.rerun.picture import write_png
from cfplan.recording.rerun.plan_view import log_plan
from cfplan.recording.rerun.states import PHASE_COLOURS, SUPERVISOR_COLOURS, supervisor_states
from cfplan.recording.rerun.viewer import open_viewer, save
from cfplan.recording.summary import dropouts, pose_gaps, reference_span, reference_times, summary_text
from cfplan.safety.space import Box, Cylinder
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.rotations import about_z

AXIS_LENGTH = 0.25  # m, of the body axes as drawn
LARGEST_FLOOR = 100.0  # m, from the origin, that is drawn
STRIPS_AT_ONCE = 500  # `rerun rrd verify` takes a time that grows with the square of the strips in one chunk
BODY_SCALE = 4.0  # the vehicle is enlarged, to be visible in its room
TRACK_RADIUS, TAIL_RADIUS, WANTED_RADIUS, PATH_RADIUS = 0.004, 0.02, 0.01, 0.006  # m, of the lines
HOVER_ARROW = 0.35  # m, of the thrust in hover
THRUST_COLOUR: Colour = (240, 228, 66)
FENCE_COLOUR: Colour = (170, 90, 90)
OBSTACLE_COLOUR: Colour = (120, 104, 84)
FLOOR_COLOUR: Colour = (62, 66, 74)
PATH_COLOUR: Colour = (130, 130, 140)
COMMITTED_COLOUR: Colour = (120, 170, 255)
COMMITTED_EVERY = 5  # setpoints, of which one is drawn
_STRIP = pa.list_(pa.field("item", pa.list_(pa.field("item", pa.float32(), nullable=False), 3), nullable=False))
LEVEL_NAMES = {Level.INFO: "INFO", Level.WARNING: "WARN", Level.ERROR: "ERROR"}


def write_rrd(record: Record, file: Path, *, overwrite: bool = False) -> None:
    """Write the recording with its blueprint atomically. Raises InputError if it cannot be written."""
    save(
        file,
        _blueprint(record),
        partial(log_record, record=record),
        overwrite=overwrite,
    )


def show(record: Record) -> None:
    """Open the viewer on the recording; it outlives this command. Raises InputError where there is no screen."""
    open_viewer(_blueprint(record), partial(log_record, record=record))


def picture(record: Record, file: Path, *, moment: float | None = None, overwrite: bool = False) -> tuple[str, ...]:
    """Write a PNG of the view at a moment, s since the record's start; else in the middle of the path.

    Return the viewer's complaints. Raises InputError as write_png does.
    """
    begin, end = reference_span(record)
    middle = (begin + end) / 2 - record.start if np.isfinite(begin) else record.duration / 2
    draw = partial(log_record, record=record)
    at = middle if moment is None else moment
    return write_png(file, _blueprint(record), draw, at, overwrite=overwrite)


def _blueprint(record: Record) -> rrb.Blueprint:
    return layout.blueprint(record.header, span=(0.0, record.duration))


def log_record(stream: rr.RecordingStream, record: Record) -> None:
    """Send all of a record."""
    stream.send_recording_name(record.header.name)
    log_room(stream, record.header)
    shown = [
        replace(plot, limits=near_limits(plot.limits, [line.values for line in plot.lines])) for plot in plots(record)
    ]
    log_styles(stream, shown)
    log_columns(stream, record, shown, record.start)
    log_plan(stream, record)
    _log_whole_track(stream, record)
    for entity, times, colour in (
        (layout.BODY, record.poses.time, FLOWN_COLOUR),
        (layout.GHOST, reference_times(record.setpoints), WANTED_COLOUR),
    ):
        if len(times):
            log_outline(stream, entity, record.header.vehicle.arm, times - record.start, colour)
    if record.duration > 0:
        log_limits(stream, shown, [0.0, record.duration])
    stream.log(layout.SUMMARY, rr.TextDocument(summary_text(record), media_type=rr.MediaType.MARKDOWN), static=True)


def log_room(stream: rr.RecordingStream, header: RecordHeader) -> None:
    """Send the static entities: fence, floor, and the path."""
    low, high = np.array(header.fence)
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    box = rr.Boxes3D(mins=[low], sizes=[high - low], colors=[FENCE_COLOUR], fill_mode="MajorWireframe")
    stream.log(layout.FENCE, box, static=True)
    floor = rr.LineStrips3D(floor_lines(low, high), colors=[FLOOR_COLOUR], radii=rr.Radius.ui_points(0.5))
    stream.log(layout.FLOOR, floor, static=True)
    _log_obstacles(stream, header)
    if len(header.path):
        path = rr.LineStrips3D([header.path], colors=[PATH_COLOUR], radii=PATH_RADIUS)
        stream.log(layout.PATH, path, static=True)


def _log_obstacles(stream: rr.RecordingStream, header: RecordHeader) -> None:
    """Send the obstacles, boxes and cylinders apart, with their names."""
    for kind in (Box, Cylinder):
        some = [each for each in header.obstacles if isinstance(each, kind)]
        if not some:
            continue
        table, names = np.array([each.prism for each in some]), [each.name for each in some]
        look: dict[str, Any] = {
            "centers": table[:, :3], "quaternions": about_z(table[:, 7]), "colors": [OBSTACLE_COLOUR], "labels": names,
            "fill_mode": "Solid",
        }  # fmt: skip
        half, radii = table[:, 3:6], table[:, 6]
        boxes = kind is Box
        shape = (
            rr.Boxes3D(half_sizes=half, **look)
            if boxes
            else rr.Cylinders3D(lengths=2 * half[:, 2], radii=radii, **look)
        )
        stream.log(f"{layout.OBSTACLES}/{'boxes' if boxes else 'cylinders'}", shape, static=True)


def floor_lines(low: NDArray, high: NDArray) -> list[NDArray]:
    """Return lines on the floor, 1 m apart, beneath the box from low to high, both (3,) m."""
    low, high = np.clip([np.floor(low), np.ceil(high)], -LARGEST_FLOOR, LARGEST_FLOOR)
    xs, ys = np.arange(low[0], high[0] + 0.5), np.arange(low[1], high[1] + 0.5)
    across = [np.array([[x, low[1], 0.0], [x, high[1], 0.0]]) for x in xs]
    return across + [np.array([[low[0], y, 0.0], [high[0], y, 0.0]]) for y in ys]


def log_styles(stream: rr.RecordingStream, shown: Sequence[Plot]) -> None:
    """Send the styles of all entities with a time."""
    stream.log(layout.BODY, rr.TransformAxes3D(AXIS_LENGTH), static=True)
    stream.log(layout.THRUST, rr.Arrows3D.from_fields(colors=[THRUST_COLOUR], radii=[0.008]), static=True)
    for plot in shown:
        for line in plot.lines:
            style = rr.SeriesLines(
                colors=line.colours, names=line.labels, widths=[1.5] * len(line.labels), aggregation_policy="MinMax"
            )
            stream.log(f"{layout.PLOTS}/{plot.name}/{line.name}", style, static=True)
        count = len(finite_limits(plot))
        style = rr.SeriesLines(colors=[LIMIT] * count, names=["limit"] * count, widths=[1.0] * count)
        stream.log(f"{layout.PLOTS}/{plot.name}/limit", style, static=True)
    for entity, colours in ((layout.PHASES, PHASE_COLOURS), (layout.SUPERVISOR, SUPERVISOR_COLOURS)):
        states = rr.StateConfiguration(values=list(colours), labels=list(colours), colors=list(colours.values()))
        stream.log(entity, states, static=True)


def log_columns(stream: rr.RecordingStream, record: Record, shown: Sequence[Plot], start: float) -> None:
    """Send all rows of a record, or of a part of one, and of its plots; `start`, s, is 0 on the timeline."""
    poses = record.poses
    setpoints = replace(record.setpoints, quaternion=meant_motion(record.setpoints)[0])  # not that of the packets
    for entity, tail, times, moving, colour, radius in (
        (layout.BODY, layout.TAIL, poses.time, poses, FLOWN_COLOUR, TAIL_RADIUS),
        (layout.GHOST, layout.WANTED_TAIL, reference_times(setpoints), setpoints, WANTED_COLOUR, WANTED_RADIUS),
    ):
        if len(times):
            columns = rr.Transform3D.columns(translation=moving.position, quaternion=moving.quaternion)
            stream.send_columns(entity, [_time_column(start, times)], columns, strict=True)
            log_tail(stream, tail, times - start, moving.position, colour, radius)
    _log_thrust(stream, record, start)
    for plot in shown:
        for line in plot.lines:
            if len(line.time):
                values = rr.Scalars.columns(scalars=line.values.reshape(-1))
                columns = values.partition([len(line.labels)] * len(line.time))
                entity = f"{layout.PLOTS}/{plot.name}/{line.name}"
                stream.send_columns(entity, [_time_column(start, line.time)], columns, strict=True)
    _log_states(stream, record, start)
    _log_events(stream, record, start)
    _log_commitments(stream, record, start)


def _log_whole_track(stream: rr.RecordingStream, record: Record) -> None:
    poses = record.poses
    if len(poses.time):
        stretches = np.split(poses.position, dropouts(pose_gaps(poses.time)) + 1)
        track = rr.LineStrips3D(stretches, colors=[_dimmed(FLOWN_COLOUR)], radii=TRACK_RADIUS)
        stream.log(layout.FLOWN, track, static=True)


def _log_thrust(stream: rr.RecordingStream, record: Record, start: float) -> None:
    """Send an arrow along the body's z axis, by the commands to the four motors; HOVER_ARROW long in hover."""
    status, poses = record.status, record.poses
    if len(status.time) == 0 or len(poses.time) == 0:
        return
    seen = (status.time >= poses.time[0]) & (status.time <= poses.time[-1])
    length = motor_thrust(record)[seen].sum(axis=1) / (record.header.vehicle.mass * GRAVITY) * HOVER_ARROW
    columns = rr.Arrows3D.columns(vectors=np.stack([0 * length, 0 * length, length], axis=1))
    stream.send_columns(layout.THRUST, [_time_column(start, status.time[seen])], columns, strict=True)


def log_outline(stream: rr.RecordingStream, entity: str, arm: float, times: NDArray, colour: Colour) -> None:
    """Send the outline of the vehicle from the first of the times to the last, so that it is never drawn at the origin.

    With a single time it is drawn from then on.
    """
    strips = vehicle_outline(arm * BODY_SCALE)
    ends = rr.TimeColumn(layout.TIMELINE, duration=times[[0, -1]] if len(times) > 1 else times)
    columns = rr.LineStrips3D.columns(
        strips=strips, colors=[colour] * len(strips), radii=[0.008] * len(strips)
    ).partition([len(strips), 0][: len(times)])
    stream.send_columns(f"{entity}/outline", [ends], columns, strict=True)


def vehicle_outline(arm: float) -> list[NDArray]:
    """Return two crossed arms and four rotors in body axes, m; a motor stands at ±arm in x and in y."""
    angle = np.linspace(0, 2 * np.pi, 25)
    circle = 0.6 * arm * np.stack([np.cos(angle), np.sin(angle), np.zeros(25)], axis=1)
    corners = arm * np.array([[1, -1, 0], [-1, -1, 0], [-1, 1, 0], [1, 1, 0]], dtype=float)
    return [corners[[0, 2]], corners[[1, 3]], *(corner + circle for corner in corners)]


def log_tail(
    stream: rr.RecordingStream,
    entity: str,
    times: NDArray,
    positions: NDArray,
    colour: Colour,
    radius: float = TAIL_RADIUS,
) -> None:
    """Send each step as a short line at its own time; the layout shows those of the last seconds."""
    stream.log(entity, rr.LineStrips3D.from_fields(colors=[colour], radii=[radius]), static=True)
    for begin in range(0, len(times) - 1, STRIPS_AT_ONCE):
        some = slice(begin, begin + STRIPS_AT_ONCE + 1)
        columns = rr.LineStrips3D.columns(strips=_steps(positions[some]))
        stream.send_columns(entity, [rr.TimeColumn(layout.TIMELINE, duration=times[some][1:])], columns, strict=True)


def _steps(positions: NDArray) -> pa.ListArray:
    """Return a strip from each position to the next, as Arrow has strips; rerun's conversion takes 30 µs a strip."""
    ends = np.stack([positions[:-1], positions[1:]], axis=1).astype(np.float32)
    points = pa.FixedSizeListArray.from_arrays(pa.array(ends.reshape(-1)), type=_STRIP.value_type)
    return pa.ListArray.from_arrays(pa.array(np.arange(0, 2 * len(ends) + 1, 2, dtype=np.int32)), points, type=_STRIP)


def log_limits(stream: rr.RecordingStream, shown: Sequence[Plot], times: Sequence[float]) -> None:
    """Send the level lines of every plot, at some times, s on the timeline."""
    for plot in shown:
        levels = finite_limits(plot)
        if levels:
            columns = rr.Scalars.columns(scalars=np.tile(levels, len(times))).partition([len(levels)] * len(times))
            stream.send_columns(
                f"{layout.PLOTS}/{plot.name}/limit",
                [rr.TimeColumn(layout.TIMELINE, duration=times)],
                columns,
                strict=True,
            )


def _log_states(stream: rr.RecordingStream, record: Record, start: float) -> None:
    supervisor = supervisor_states(record.status.supervisor)
    changes = np.flatnonzero(np.r_[True, supervisor[1:] != supervisor[:-1]]) if len(supervisor) else np.empty(0, int)
    for entity, time, states in (
        (layout.PHASES, record.phases.time, record.phases.phase),
        (layout.SUPERVISOR, record.status.time[changes], supervisor[changes]),
    ):
        if len(time):
            columns = rr.StateChange.columns(state=list(states))
            stream.send_columns(entity, [_time_column(start, time)], columns, strict=True)


def _log_events(stream: rr.RecordingStream, record: Record, start: float) -> None:
    events = record.events
    if len(events.time):
        levels = [LEVEL_NAMES.get(level, "INFO") for level in events.level]
        texts = [
            f"{time - start:6.2f} s  {text}" for time, text in zip(events.time, events.text, strict=True)
        ]  # the viewer's own column of times is too narrow to read
        columns = rr.TextLog.columns(text=texts, level=levels)
        stream.send_columns(layout.EVENTS, [_time_column(start, events.time)], columns, strict=True)


def _log_commitments(stream: rr.RecordingStream, record: Record, start: float) -> None:
    """Send the path to which the vehicle was committed, at each time when a plan was committed in flight."""
    commitments = record.commitments
    if not len(commitments.time):
        return
    strips = [
        decode(np.frombuffer(payloads, np.uint8).reshape(-1, PAYLOAD_SIZE)[::COMMITTED_EVERY]).position
        for payloads in commitments.payloads
    ]
    columns = rr.LineStrips3D.columns(
        strips=strips, colors=[COMMITTED_COLOUR] * len(strips), radii=[PATH_RADIUS] * len(strips)
    )
    stream.send_columns(layout.COMMITTED, [_time_column(start, commitments.time)], columns, strict=True)


def _time_column(start: float, times: NDArray) -> rr.TimeColumn:
    return rr.TimeColumn(layout.TIMELINE, duration=times - start)


def _dimmed(colour: Colour) -> tuple[int, int, int, int]:
    return (*colour, 110)
