"""Refine a near-feasible profile on its grid, keeping its yaw, until every limit holds.

A warm start: from a near-feasible profile the search of the expert's problem takes a fraction of its steps.
"""

import math
import time
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from cfplan.planners.expert.point_constraints import Penalties
from cfplan.planners.expert.problem import FLOOR, Ends, pose, profile_of
from cfplan.planners.expert.program import Shape, layout_of
from cfplan.planners.expert.solvers import interior_point, quickly, quickly_again
from cfplan.planners.expert.tightening import Kept, Task, flaw, kept_between
from cfplan.planners.expert.windows import by_windows
from cfplan.planners.solution import Solution, Status
from cfplan.planners.task import PlanningTask
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.profile_spline import h_coefficients, spline_profile
from cfplan.vehicle.yaw_spline import YawSpline

WINDOW = (224, 32)
# intervals that a window keeps, and how much further it looks
SLOWER, OVER = 0.1, 10
# share of h by which the search begins below what it is given, fully so from so many intervals behind a joint on:
# where limits are used to the full, nearly all constraints then begin inside their bounds, and steps are long


def refine(
    task: PlanningTask,
    profile: SpeedProfile,
    *,
    passes: Callable[[SpeedProfile], bool] | None = None,
) -> Solution:
    """A profile within a few thousandths of the fastest, with the grid and the yaw of the given one, not of the task.

    Long paths are taken window by window. On a path of one window limits are held at points first; what exceeds them
    between is looked for where `passes` says that it must be.
    """
    began = time.perf_counter()
    path, limits = task.path, task.limits
    nodes, unit, track = len(profile.s) - 1, limits.speed**2, YawSpline.of(profile)
    near = np.maximum(h_coefficients(profile) / unit, FLOOR)[:, None]
    layout = layout_of(Shape(nodes, False, turning_limited=limits.angular_acceleration < math.inf))
    whole = Task(path, task.airframe, limits, Ends(task.start, task.end), track, layout)
    joined = by_windows(whole, WINDOW, partial(_refined, passes=passes), near)
    if isinstance(joined, str):
        return Solution(Status.NOT_CONVERGED, None, f"refining: {joined}")
    stats: dict[str, float | int | str] = {
        "solve_seconds": time.perf_counter() - began,
        "iterations": joined.iterations,
        "rounds": joined.rounds,
        "windows": 1 + len(joined.joints),
        "solver": "interior point",
    }
    refined = spline_profile(joined.table[:, 0] * unit, path.end, track)
    return Solution(Status.SOLVED, refined, "", stats, joined.joints)


def _refined(task: Task, near: NDArray, passes: Callable[[SpeedProfile], bool] | None) -> Kept | str:
    nodes, unit = task.layout.shape.nodes, task.limits.speed**2
    interval = task.path.end / nodes * float(np.mean(1.0 / np.sqrt(unit * near[:, 0])))
    given = task.layout, task.path, task.airframe, task.limits, task.track, 0.0, task.ends, Penalties()
    agrees = not task.ends.end and (task.ends.continues or not task.ends.start)
    problem = pose(*given, _lowered(near, task.ends) if agrees else None)
    attempt = interior_point(problem, None, quickly(interval))
    if flaw(attempt, problem, task):  # not near enough
        problem = pose(*given)
        attempt = interior_point(problem, None)
    if why := flaw(attempt, problem, task):
        return why
    whole = not task.ends.continues and task.ends.joint is None
    if passes and whole and passes(profile_of(attempt.table, unit, task.track, task.path.end)):
        return Kept(attempt.table, 0, attempt.iterations)
    return kept_between(attempt, problem, task, quickly_again(interval))


def _lowered(near: NDArray, ends: Ends) -> NDArray:
    """Where to begin; what a joint decides stays."""
    share = np.full((len(near), 1), SLOWER)
    if ends.continues:
        share[:OVER, 0] *= np.maximum(np.arange(OVER) - 2, 0) / (OVER - 2)
    return (1.0 - share) * near
