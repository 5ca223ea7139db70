"""Draw the plan in the rerun view: the joints of its pieces, and the active limit along it."""

import numpy as np
import rerun as rr

from cfplan.errors import CfplanError
from cfplan.planning.active_limits import FREE, FREE_COLOUR, LIMIT_COLOURS, Colour, active_limits
from cfplan.planning.plan_file import load_plan
from cfplan.recording.record import PLAN_FILE, Record
from cfplan.recording.rerun import layout
from cfplan.recording.summary import reference_span

PIECE_RADIUS, JOINT_RADIUS, LIMIT_RADIUS = 0.02, 0.035, 0.01  # m, as drawn
PIECE_COLOUR: Colour = (235, 235, 235)
JOINT_COLOUR: Colour = (190, 255, 60)


def log_plan(stream: rr.RecordingStream, record: Record) -> None:
    """Send the plan beside a record; nothing where there is none that can be read."""
    try:
        plan = load_plan(record.folder / PLAN_FILE)
    except CfplanError:
        return
    for entity, places, radius, colour in (
        (layout.PIECES, plan.path.breaks, PIECE_RADIUS, PIECE_COLOUR),
        (layout.JOINTS, np.array(plan.joints), JOINT_RADIUS, JOINT_COLOUR),
    ):
        if len(places):
            stream.log(entity, rr.Points3D(plan.path(places), radii=radius, colors=[colour]), static=True)
    active = active_limits(plan)
    for name, colour in LIMIT_COLOURS.items():
        strips = [active.position[rows] for found, rows in active.stretches() if found == name]
        if strips:
            lines = rr.LineStrips3D(strips, colors=[colour], radii=LIMIT_RADIUS)
            stream.log(f"{layout.LIMITS}/{name.replace(',', '').replace(' ', '_')}", lines, static=True)
    begin, _ = reference_span(record)
    colours = {**LIMIT_COLOURS, FREE: FREE_COLOUR}
    style = rr.StateConfiguration(values=list(colours), labels=list(colours), colors=list(colours.values()))
    stream.log(layout.ACTIVE_LIMIT, style, static=True)
    if np.isfinite(begin):
        runs = [(active.time[rows.start], name) for name, rows in active.stretches()]
        times = np.array([time for time, _ in runs] + [plan.trajectory.duration]) + begin - record.start
        columns = rr.StateChange.columns(state=[name for _, name in runs] + [FREE])
        stream.send_columns(layout.ACTIVE_LIMIT, [rr.TimeColumn(layout.TIMELINE, duration=times)], columns, strict=True)
