"""Refine a near-feasible profile on its grid, keeping its yaw, until every limit holds.

A warm start: from a near-feasible profile the search of the expert's problem takes a fraction of its steps.
"""

import math
import time
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.planners.expert.point_constraints import Penalties
from cfplan.planners.expert.problem import FLOOR, Ends, Problem, pose
from cfplan.planners.expert.program import Shape, layout_of
from cfplan.planners.expert.solvers import Attempt, interior_point, quickly, quickly_again
from cfplan.planners.expert.tightening import Kept, Task, flaw, kept_between
from cfplan.planners.expert.windows import Joined, by_windows, far_enough, windows_of
from cfplan.planners.solution import Solution, Status
from cfplan.planners.solver.interior_point import Search
from cfplan.planners.task import PlanningTask
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.profile_spline import h_coefficients, spline_profile
from cfplan.vehicle.yaw_spline import YawSpline

WINDOW = (224, 32)
# intervals that a window keeps, and how much further it looks
SLOWER, OVER = 0.1, 10
# share of h by which the search begins below what it is given, fully so from so many intervals behind a joint on:
# where limits are used to the full, nearly all constraints then begin inside their bounds, and steps are long


def refine(task: PlanningTask, profile: SpeedProfile) -> Solution:
    """Plan a profile within about 0.3 % of the fastest, with the grid and the yaw of the given one, not of the task."""
    *_, last = refinements(task, profile)
    return last


def refinements(task: PlanningTask, profile: SpeedProfile) -> Iterator[Solution]:
    """Yield the refined profile: first with limits held at points, then, if it is asked for, between them too.

    The first often passes the certificate, and costs half. A path longer than WINDOW is planned window by window; its
    profile comes once, with limits held between points. A failure comes alone.
    """
    began = time.perf_counter()
    path, limits = task.path, task.limits
    nodes, unit, track = len(profile.s) - 1, limits.speed**2, YawSpline.of(profile)
    near = np.maximum(h_coefficients(profile) / unit, FLOOR)[:, None]
    layout = layout_of(Shape(nodes, False, turning_limited=limits.angular_acceleration < math.inf))
    whole = Task(path, task.airframe, limits, Ends(task.start, task.end), track, layout)
    if len(windows_of(nodes, *far_enough(WINDOW, path.end / nodes, limits))) > 1:
        yield _solution(whole, by_windows(whole, WINDOW, _refine_window, near), began)
        return
    found = _hold_at_points(whole, near)
    if isinstance(found, str):
        yield _solution(whole, found, began)
        return
    yield _solution(whole, Joined(found.attempt.table, (), found.attempt.iterations, 0), began)
    between = kept_between(found.attempt, found.problem, whole, found.restarts)
    yield _solution(whole, Joined(between.table, (), between.iterations, between.rounds), began)


def _solution(whole: Task, joined: Joined | str, began: float) -> Solution:
    if isinstance(joined, str):
        return Solution(Status.NOT_CONVERGED, None, f"refining: {joined}")
    stats: dict[str, float | int | str] = {
        "solve_seconds": time.perf_counter() - began,
        "iterations": joined.iterations,
        "rounds": joined.rounds,
        "windows": 1 + len(joined.joints),
        "solver": "interior point",
    }
    refined = spline_profile(joined.table[:, 0] * whole.limits.speed**2, whole.path.end, whole.track)
    return Solution(Status.SOLVED, refined, "", stats, joined.joints)


class _HeldAtPoints(NamedTuple):
    """A solution that keeps its limits at points, and what it takes to go on from there."""

    attempt: Attempt
    problem: Problem
    restarts: Sequence[Search]


def _hold_at_points(task: Task, near: NDArray) -> _HeldAtPoints | str:
    """Solve the problem from the coefficients `near`, or return why not."""
    nodes, unit = task.layout.shape.nodes, task.limits.speed**2
    interval = task.path.end / nodes * float(np.mean(1.0 / np.sqrt(unit * near[:, 0])))
    given = task.layout, task.path, task.airframe, task.limits, task.track, 0.0, task.ends, Penalties()
    agrees = not task.ends.end and (task.ends.continues or not task.ends.start)
    problem = pose(*given, _lowered(near, task.ends) if agrees else None)
    attempt = interior_point(problem, None, quickly(interval))
    if flaw(attempt, problem, task):  # not near enough
        problem = pose(*given)
        attempt = interior_point(problem, None)
    return flaw(attempt, problem, task) or _HeldAtPoints(attempt, problem, quickly_again(interval))


def _refine_window(task: Task, near: NDArray) -> Kept | str:
    found = _hold_at_points(task, near)
    if isinstance(found, str):
        return found
    return kept_between(found.attempt, found.problem, task, found.restarts)


def _lowered(near: NDArray, ends: Ends) -> NDArray:
    """Where to begin; what a joint decides stays."""
    share = np.full((len(near), 1), SLOWER)
    if ends.continues:
        share[:OVER, 0] *= np.maximum(np.arange(OVER) - 2, 0) / (OVER - 2)
    return (1.0 - share) * near
