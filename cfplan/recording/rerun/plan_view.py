"""Draw the plan in the rerun view: where its pieces join, and where which limit holds it back."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from cfplan.errors import CfplanError
from cfplan.planning.plan_file import load_plan
from cfplan.planning.plan_result import Plan
from cfplan.recording.plots import Colour
from cfplan.recording.record import PLAN_FILE, Record
from cfplan.recording.rerun import layout
from cfplan.recording.summary import reference_span
from cfplan.safety.certificate import shares

ACTIVE = 0.95  # share from which a limit counts as what holds the plan back
STEP = 0.01  # s, between the samples of the plan
PIECE_RADIUS, JOINT_RADIUS, LIMIT_RADIUS = 0.02, 0.035, 0.01  # m, as drawn
PIECE_COLOUR: Colour = (235, 235, 235)
JOINT_COLOUR: Colour = (190, 255, 60)
FREE, FREE_COLOUR = "none", (60, 66, 76)
LIMIT_COLOURS: dict[str, Colour] = {
    "speed": (0, 158, 115),
    "acceleration": (204, 121, 167),
    "angular velocity": (213, 94, 0),
    "angular acceleration": (170, 130, 220),
    "tilt": (240, 228, 66),
    "motor thrust, most": (226, 74, 74),
    "motor thrust, least": (0, 114, 178),
    "specific thrust, least": (150, 150, 210),
}


@dataclass(frozen=True, slots=True, eq=False)
class ActiveLimits:
    """Which limit holds the plan back, and where."""

    time: NDArray  # (N,) s from the begin of the path
    position: NDArray  # (N, 3) m
    name: NDArray  # (N,) str: the limit that is used most, where that is at least ACTIVE of it, else FREE

    def stretches(self) -> list[tuple[str, slice]]:
        """Return each run of samples with one name, in order; neighbours share a sample, so that lines meet."""
        edges = [0, *(np.flatnonzero(self.name[1:] != self.name[:-1]) + 1), len(self.name)]
        return [
            (str(self.name[begin]), slice(int(begin), min(int(end) + 1, len(self.name))))
            for begin, end in pairwise(edges)
        ]


def active_limits(plan: Plan) -> ActiveLimits:
    """Sample the active limit every STEP."""
    trajectory = plan.trajectory
    time = np.append(np.arange(0.0, trajectory.duration, STEP), trajectory.duration)
    used = shares(trajectory, plan.limits.plan, time)
    table = np.stack(list(used.values()))
    names = np.where(table.max(axis=0) >= ACTIVE, np.array(list(used))[table.argmax(axis=0)], FREE)
    return ActiveLimits(time, trajectory.at(time).position, names)


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
