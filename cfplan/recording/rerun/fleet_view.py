"""Draw the flight of a fleet in one rerun recording: all vehicles in their room, each in its colour.

Above the plots of trials is the distance of each vehicle to the nearest other; the lowest curve is the smallest
distance of all. Below are the phases of each vehicle, and all warnings and errors.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from cfplan.flight.telemetry import Level
from cfplan.recording.fleet_record import FleetRecord, distances_to_others
from cfplan.recording.plots import LIMIT
from cfplan.recording.record import Record
from cfplan.recording.rerun import layout
from cfplan.recording.rerun.overlay_view import COLOURS, log_curve, log_trials, room, time_plots, window
from cfplan.recording.rerun.picture import write_png
from cfplan.recording.rerun.record_view import LEVEL_NAMES, log_room
from cfplan.recording.rerun.states import PHASE_COLOURS
from cfplan.recording.rerun.viewer import open_viewer, save

_TITLES = {
    "distance": "Distance to the nearest other, m",
    "deviation": "Deviation, m",
    "speed": "Speed, m/s",
    "z": "z, m",
}


def write_fleet(fleet: FleetRecord, file: Path, *, overwrite: bool = False) -> None:
    """Write the recording atomically. Raises InputError if it cannot be written."""
    save(file, blueprint(fleet), partial(log_fleet, fleet=fleet), overwrite=overwrite)


def show_fleet(fleet: FleetRecord) -> None:
    """Open the viewer on the fleet. Raises InputError where there is no screen."""
    open_viewer(blueprint(fleet), partial(log_fleet, fleet=fleet))


def picture_fleet(
    fleet: FleetRecord, file: Path, *, moment: float | None = None, overwrite: bool = False
) -> tuple[str, ...]:
    """Write a PNG of the view at a moment, s from the fleet's start; else at the nearest approach of any pair.

    Return the viewer's complaints. Raises InputError as write_png does.
    """
    if moment is None:
        nearest = [(float(pair.distance[row]), float(pair.time[row])) for pair in fleet.pairs()
                   if (row := pair.nearest) is not None]  # fmt: skip
        moment = min(nearest)[1] if nearest else 0.0
    return write_png(file, blueprint(fleet), partial(log_fleet, fleet=fleet), moment, overwrite=overwrite)


def blueprint(fleet: FleetRecord) -> rrb.Blueprint:
    """Return the layout: 3-D at the left, plots at the right, phases and events below."""
    trials = fleet.trials
    below = rrb.Horizontal(
        rrb.StateTimelineView(contents=[f"{layout.PHASES}/**"], name="Phases"),
        rrb.TextLogView(origin=layout.EVENTS, name="Warnings and errors", columns=layout.event_columns()),
        column_shares=[3, 2],
    )
    plots = rrb.Vertical(*time_plots(trials, _TITLES), row_shares=[2, 1, 1, 1])
    above = rrb.Horizontal(room(trials, fleet.name), plots, column_shares=[6, 5])
    return window(rrb.Vertical(above, below, row_shares=[5, 1]))


def log_fleet(stream: rr.RecordingStream, fleet: FleetRecord) -> None:
    """Send all of a fleet's records; time 0 is the fleet's start."""
    trials, start = fleet.trials, fleet.start
    log_trials(stream, trials)
    stream.send_recording_name(fleet.name)
    header = next(iter(fleet.records.values())).header
    log_room(stream, replace(header, path=np.empty((0, 3))))
    for index, (trial, distance) in enumerate(zip(trials, distances_to_others(trials), strict=True)):
        colour, entity = COLOURS[index % len(COLOURS)], f"{layout.PLOTS}/distance/vehicle_{index}"
        log_curve(stream, entity, trial.name, colour, trial.time, distance)
    ends = np.array([min(trial.time[0] for trial in trials if len(trial.time)),
                     max(trial.time[-1] for trial in trials if len(trial.time))])  # fmt: skip
    log_curve(stream, f"{layout.PLOTS}/distance/apart", "apart", LIMIT, ends, np.full(2, fleet.apart))
    for name, record in fleet.records.items():
        _log_phases(stream, name, record, start)
        _log_grave_events(stream, name, record, start)


def _log_phases(stream: rr.RecordingStream, name: str, record: Record, start: float) -> None:
    entity, phases = f"{layout.PHASES}/{rr.escape_entity_path_part(name)}", record.phases
    states = rr.StateConfiguration(
        values=list(PHASE_COLOURS), labels=list(PHASE_COLOURS), colors=list(PHASE_COLOURS.values())
    )
    stream.log(entity, states, static=True)
    if len(phases.time):
        time = rr.TimeColumn(layout.TIMELINE, duration=phases.time - start)
        stream.send_columns(entity, [time], rr.StateChange.columns(state=list(phases.phase)), strict=True)


def _log_grave_events(stream: rr.RecordingStream, name: str, record: Record, start: float) -> None:
    events = record.events
    grave = np.flatnonzero(np.isin(events.level, (Level.WARNING, Level.ERROR)))
    if len(grave):
        time = events.time[grave] - start
        texts = [f"{at:6.2f} s  {name}: {text}" for at, text in zip(time, events.text[grave], strict=True)]
        columns = rr.TextLog.columns(text=texts, level=[LEVEL_NAMES[level] for level in events.level[grave]])
        entity = f"{layout.EVENTS}/{rr.escape_entity_path_part(name)}"
        stream.send_columns(entity, [rr.TimeColumn(layout.TIMELINE, duration=time)], columns, strict=True)
