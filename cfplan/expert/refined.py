"""A profile that is nearly right made right: its limits kept everywhere, as fast as they allow, its yaw left alone.

Searched from near, the expert's problem takes a fraction of its steps. A long path is taken window by window, so that
time grows with its length and memory does not: each window begins in the state where the kept part of the one before
ends, and looks further than it keeps, by more than it takes to brake. Joints are crossed a little below the limits.
"""

import math
import time

import numpy as np
from numpy.typing import NDArray

from cfplan.expert.problem import FLOOR, Ends, pose
from cfplan.expert.program import Shape, layout_of
from cfplan.expert.solution import Solution, Status
from cfplan.expert.solvers import interior_point, quickly, quickly_again
from cfplan.expert.spline_profile import h_coefficients, spline_profile, yaw_of
from cfplan.expert.stage import Penalties
from cfplan.expert.tightening import Task, flaw, kept_between
from cfplan.expert.yaw_track import YawTrack
from cfplan.geometry.path import Path
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.profile import BoundaryState, SpeedProfile

WINDOW, AHEAD = 96, 32
# intervals that a window keeps, and how much further it looks


def refine(
    path: Path,
    profile: SpeedProfile,
    airframe: Airframe,
    limits: PlanLimits,
    *,
    start: BoundaryState | None = None,
    end: BoundaryState | None = None,
) -> Solution:
    """A profile within a few thousandths of the fastest, on the grid and with the yaw of the given one.

    `start` and `end` are kept where given.
    """
    began = time.perf_counter()
    nodes = len(profile.s) - 1
    step, unit = path.end / nodes, limits.speed**2
    table = np.maximum(h_coefficients(profile) / unit, FLOOR)[:, None]
    turning = limits.angular_acceleration < math.inf
    iterations = rounds = windows = 0
    for first, last in windows_of(nodes):
        part = path if last - first == nodes else path.part(first * step, last * step)
        track = yaw_of(profile, first, last)
        state = start if first == 0 else _state(table[first : first + 3, 0] * unit, track, step)
        joint = WINDOW if last < nodes else None
        ends = Ends(state, end if last == nodes else None, continues=first > 0, joint=joint)
        shape = Shape(last - first, False, turning, (3 * (first == 0), 3 * (last == nodes)))
        task = Task(part, airframe, limits, ends, track, layout_of(shape))
        near = table[first : last + 3] if not (first == 0 and start) and not (last == nodes and end) else None
        seconds = float(np.sum(step / np.sqrt(unit * table[first : last + 3, 0])))
        given = airframe, limits, track, 0.0, ends, Penalties()
        problem = pose(task.layout, part, *given, near)
        attempt = interior_point(problem, None, quickly(seconds))
        if flaw(attempt, problem, task):  # not near enough
            problem = pose(task.layout, part, *given)
            attempt = interior_point(problem, None)
        if reason := flaw(attempt, problem, task):
            where = f"s = {first * step:.3g} to {last * step:.3g}"
            return Solution(Status.NOT_CONVERGED, None, f"refining {where}: {reason}")
        kept = kept_between(attempt, problem, task, quickly_again(seconds))
        table[first : last + 3] = kept.table
        iterations += kept.iterations
        rounds += kept.rounds
        windows += 1
    stats: dict[str, float | int | str] = {
        "solve_seconds": time.perf_counter() - began,
        "iterations": iterations,
        "rounds": rounds,
        "windows": windows,
        "solver": "interior point",
    }
    return Solution(Status.SOLVED, spline_profile(table[:, 0] * unit, path.end, yaw_of(profile)), "", stats)


def windows_of(nodes: int) -> list[tuple[int, int]]:
    """(first interval, first beyond) of each window; one where it fits. Each keeps what the next does not begin."""
    begins = range(0, max(nodes - AHEAD, 1), WINDOW)
    return [(first, nodes if first == begins[-1] else first + WINDOW + AHEAD) for first in begins]


def _state(cubic: NDArray, track: YawTrack, step: float) -> BoundaryState:
    """The state at a track's start, where the first three coefficients of h are these."""
    h, slope, bend = (cubic[0] + 4 * cubic[1] + cubic[2]) / 6, (cubic[2] - cubic[0]) / 2, np.diff(cubic, 2)[0]
    return BoundaryState(
        float(h), float(slope / step), float(bend / step**2), float(track.yaw[0]), float(track.dyaw[0])
    )
