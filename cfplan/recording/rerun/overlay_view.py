"""Draw several flights in one rerun recording: each trial in its colour, the references dashed."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from cfplan.recording.overlay import Reference, Trial, extent, rooms, short_name
from cfplan.recording.plots import FOUR, WANTED, Colour
from cfplan.recording.rerun import layout
from cfplan.recording.rerun.layout import PLOTS, TIMELINE, WORLD, tail_range, time_plot
from cfplan.recording.rerun.picture import write_png
from cfplan.recording.rerun.record_view import (
    FENCE_COLOUR,
    FLOOR_COLOUR,
    PATH_COLOUR,
    TRACK_RADIUS,
    floor_lines,
    log_outline,
    log_tail,
)
from cfplan.recording.rerun.viewer import open_viewer, save

COLOURS: tuple[Colour, ...] = (FOUR[0], WANTED, *FOUR[1:], (213, 94, 0), (0, 114, 178))
ARM = 0.0375  # m, of the vehicle as drawn: a log does not know its size
DASH = 0.05  # m, of the reference as drawn, and as much between two
MAX_DASHES = 20_000
DRAWN_RATE = 100.0  # Hz: more poses than that are not drawn in 3-D, as they could not be distinguished
_REFERENCE, _TRIAL = f"{WORLD}/reference", f"{WORLD}/trial"
_AXES = "xyz"
_CAMERA_DISTANCE_FACTOR = 1.25  # times as far as in the view of one record, which is less high for its width


def write_overlay(trials: Sequence[Trial], file: Path, *, overwrite: bool = False) -> None:
    """Write the recording atomically. Raises InputError if it cannot be written."""
    save(file, blueprint(trials), partial(log_trials, trials=trials), overwrite=overwrite)


def show_overlay(trials: Sequence[Trial]) -> None:
    """Open the viewer on the trials. Raises InputError where there is no screen."""
    open_viewer(blueprint(trials), partial(log_trials, trials=trials))


def picture_overlay(
    trials: Sequence[Trial], file: Path, *, moment: float | None = None, overwrite: bool = False
) -> tuple[str, ...]:
    """Write a PNG of the view at a moment, s from the start of the path; else half-way. Return the viewer's complaints.

    Raises InputError as write_png does.
    """
    ends = [reference.time[-1] for reference in references(trials)] or [trial.time[-1] for trial in trials]
    middle = float(max(ends)) / 2
    draw = partial(log_trials, trials=trials)
    return write_png(file, blueprint(trials), draw, middle if moment is None else moment, overwrite=overwrite)


def blueprint(trials: Sequence[Trial]) -> rrb.Blueprint:
    """Return the layout: 3-D at the left; deviation where there are references, speed and coordinates at the right."""
    names = {"speed": "Speed, m/s", **{axis: f"{axis}, m" for axis in _AXES}}
    if references(trials):
        names = {"deviation": "Deviation, m", **names}
    return window(
        rrb.Horizontal(room(trials, "Trials"), rrb.Vertical(*time_plots(trials, names)), column_shares=[6, 5])
    )


def time_plots(trials: Sequence[Trial], names: Mapping[str, str]) -> list[rrb.TimeSeriesView]:
    """Return axes over the time of all trials, by the names of their plots with a title each."""
    seen = [trial.time[np.isfinite(trial.position).all(axis=1)] for trial in trials]
    moments = np.concatenate([*seen, np.zeros(1)])
    span = (float(moments.min()), float(moments.max()))
    return [time_plot(name, title, span) for name, title in names.items()]


def window(views: rrb.Container) -> rrb.Blueprint:
    """Return the layout of these views, with only the time panel besides."""
    return rrb.Blueprint(
        views,
        rrb.TimePanel(timeline=TIMELINE, state="collapsed", play_state="paused"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
    )


def room(trials: Sequence[Trial], name: str) -> rrb.Spatial3DView:
    """Return the 3-D view, which shows everything that the trials pass."""
    low, high = extent(trials)
    centre, size = (low + high) / 2, max(float(np.linalg.norm(high - low)), 1.0)
    aside = _CAMERA_DISTANCE_FACTOR * np.array(
        layout.LONG_IN_Y if high[1] - low[1] > high[0] - low[0] else layout.LONG_IN_X
    )
    return rrb.Spatial3DView(
        origin=WORLD,
        name=name,
        overrides={f"{_TRIAL}/{i}/tail": [tail_range()] for i in range(len(trials))},
        line_grid=False,
        eye_controls=rrb.EyeControls3D(position=centre + size * aside, look_target=centre, eye_up=(0.0, 0.0, 1.0)),
    )


def references(trials: Sequence[Trial]) -> tuple[Reference, ...]:
    """Return each reference that any trial follows, once: trials of one plan share theirs."""
    found: list[Reference] = []
    for reference in (trial.reference for trial in trials):
        if reference is not None and not any(_same(reference, other) for other in found):
            found.append(reference)
    return tuple(found)


def _same(one: Reference, other: Reference) -> bool:
    """Return whether both lead along the same places at the same times, within what can be seen."""
    if one is other:
        return True
    if abs(one.time[-1] - other.time[-1]) > 0.05:
        return False
    gap = np.linalg.norm(one.at(other.time) - other.position, axis=1)
    return bool(np.nanmax(gap, initial=0.0) < 0.01)


def log_trials(stream: rr.RecordingStream, trials: Sequence[Trial]) -> None:
    """Send all trials."""
    stream.send_recording_name(" and ".join(trial.name for trial in trials[:3]))
    stream.log(WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    lines = rr.LineStrips3D(floor_lines(*extent(trials)), colors=[FLOOR_COLOUR], radii=rr.Radius.ui_points(0.5))
    stream.log(f"{WORLD}/floor", lines, static=True)
    if flown_in := rooms(trials):
        low, high = np.array(flown_in).transpose(1, 0, 2)
        box = rr.Boxes3D(mins=low, sizes=high - low, colors=[FENCE_COLOUR], fill_mode="MajorWireframe")
        stream.log(layout.FENCE, box, static=True)
    for index, reference in enumerate(references(trials)):
        dashed = rr.LineStrips3D(dashes(reference.position), colors=[PATH_COLOUR], radii=TRACK_RADIUS)
        stream.log(f"{_REFERENCE}/{index}", dashed, static=True)
        for axis, values in zip(_AXES, reference.position.T, strict=True):
            entity = f"{PLOTS}/{axis}/reference_{index}"
            log_curve(stream, entity, f"{reference.name} (plan)", PATH_COLOUR, reference.time, values)
    for index, trial in enumerate(trials):
        colour = COLOURS[index % len(COLOURS)]
        _log_track(stream, f"{_TRIAL}/{index}", trial, colour)
        curves = {"speed": trial.speed, **dict(zip(_AXES, trial.position.T, strict=True))}
        if trial.reference is not None:
            curves["deviation"] = trial.deviation
        for name, values in curves.items():
            log_curve(stream, f"{PLOTS}/{name}/trial_{index}", short_name(trial.name), colour, trial.time, values)


def dashes(points: NDArray) -> list[NDArray]:
    """Return (M, 3) as pieces DASH long with gaps of the same length between them."""
    if len(points) < 2:
        return []
    along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]
    dash = max(DASH, along[-1] / (2 * MAX_DASHES))
    places = np.arange(0.0, along[-1], 2 * dash)
    ends = np.stack([places, np.minimum(places + dash, along[-1])], axis=1)
    moving = np.r_[True, np.diff(along) > 0]
    return list(np.stack([np.interp(ends, along[moving], axis[moving]) for axis in points.T], axis=-1))


def stretches(trial: Trial) -> list[NDArray]:
    """Return the rows of each stretch in which it was seen."""
    seen = np.isfinite(trial.position).all(axis=1)
    edges = np.flatnonzero(np.diff(seen.astype(int))) + 1
    pieces = np.split(np.arange(len(seen)), edges)
    return [piece for piece in pieces if len(piece) > 1 and seen[piece[0]]]


def _log_track(stream: rr.RecordingStream, entity: str, trial: Trial, colour: Colour) -> None:
    track = rr.LineStrips3D(
        [trial.position[piece] for piece in stretches(trial)], colors=[(*colour, 140)], radii=TRACK_RADIUS
    )
    stream.log(f"{entity}/track", track, static=True)
    rows = _drawn(trial)
    if len(rows) == 0:
        return
    for piece in stretches(trial):
        some = np.intersect1d(rows, piece, assume_unique=True)
        log_tail(stream, f"{entity}/tail", trial.time[some], trial.position[some], colour)
    quaternion = trial.quaternion[rows]
    level = ~np.isfinite(quaternion).all(axis=1)
    columns = rr.Transform3D.columns(
        translation=trial.position[rows], quaternion=np.where(level[:, None], [0.0, 0.0, 0.0, 1.0], quaternion)
    )
    stream.send_columns(f"{entity}/body", [rr.TimeColumn(TIMELINE, duration=trial.time[rows])], columns, strict=True)
    log_outline(stream, f"{entity}/body", ARM, trial.time[rows], colour)


def _drawn(trial: Trial) -> NDArray:
    """Return the rows to draw in 3-D: those in which it was seen, no more of them than can be distinguished."""
    seen = np.flatnonzero(np.isfinite(trial.position).all(axis=1))
    if len(seen) < 2:
        return seen
    step = float(np.median(np.diff(trial.time[seen])))
    return seen[:: max(1, round(1 / max(DRAWN_RATE * step, 1e-3)))]


def log_curve(
    stream: rr.RecordingStream, entity: str, label: str, colour: Colour, time: NDArray, values: NDArray
) -> None:
    """Send values over time, (N,), as a curve with its label; NaN breaks it."""
    style = rr.SeriesLines(colors=[colour], names=[label], widths=[1.5], aggregation_policy="MinMax")
    stream.log(entity, style, static=True)
    known = np.isfinite(values)
    known[1:] |= known[:-1].copy()  # a NaN behind each stretch, so that no line bridges a gap
    if known.any():
        columns = rr.Scalars.columns(scalars=values[known])
        stream.send_columns(entity, [rr.TimeColumn(TIMELINE, duration=time[known])], columns, strict=True)
