"""Refine a near-feasible profile on its grid to the optimum; yaw stays as it is unless it is free.

A warm start: from a near-feasible profile the search of the expert's problem takes a fraction of its steps.
"""

import math
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.deadline import Deadline
from cfplan.geometry.yaw import YawMode
from cfplan.planners.expert.initial_guess import led_into, lowered
from cfplan.planners.expert.layout import Shape, layout_of
from cfplan.planners.expert.problem import FLOOR, Ends, Problem, Segment, build_problem, interval_of, slowness_of
from cfplan.planners.expert.search import (
    COLD_START,
    Attempt,
    refining_again,
    refining_restarts,
    refining_starts,
    rejection_reason,
    solve,
)
from cfplan.planners.expert.tightening import Tightened, tighten, tighten_until_feasible
from cfplan.planners.expert.windows import (
    LONG_WINDOW,
    Joined,
    WindowSize,
    by_windows,
    failed_status,
    solution_of,
    windows_of,
)
from cfplan.planners.solution import Solution
from cfplan.planners.task import PlanningTask
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.profile_spline import h_coefficients
from cfplan.vehicle.yaw_spline import YawSpline, end_coefficients

# Share of h by which the search begins below the given profile: where that uses limits to the full, nearly all
# constraints then begin inside their bounds, and steps are long.
SLOWER = 0.1
# Steps from which a search is taken to have crawled along its bounds, from a profile far off: it may then stop up to
# 3 % short of the optimum, and starts once more from where it is, which takes a few steps.
CRAWLED = 16


def refine(task: PlanningTask, profile: SpeedProfile, *, window: WindowSize = LONG_WINDOW) -> Solution:
    """Plan a profile within about 0.02 % of the fastest, on the grid of the given one.

    Yaw is that of the profile, not of the task; where the task leaves it free it is optimised too. A profile may come
    with a reason, which then says from where on it stayed as given.
    """
    *_, last = refinements(task, profile, window=window)
    return last


def refinements(task: PlanningTask, profile: SpeedProfile, *, window: WindowSize = LONG_WINDOW) -> Iterator[Solution]:
    """Yield the refined profile, after each round in which limits exceeded between points are lowered.

    The first mostly passes the certificate. A path longer than `window` is planned window by window; its profile comes
    once, after all rounds. A failure comes alone. At the task's deadline what is not refined yet stays as given.
    """
    began = time.perf_counter()
    path, limits, nodes = task.path, task.limits, len(profile.s) - 1
    free = task.yaw is YawMode.FREE
    layout = layout_of(Shape(nodes, free, turning_limited=limits.angular_acceleration < math.inf))
    ends, yaw = Ends(task.start, task.end), YawSpline.of(profile)
    whole = Segment(path, task.airframe, limits, ends, yaw, layout, task.speed_caps, slowness_of(profile.h, limits))
    step = path.end / nodes
    near = np.maximum(h_coefficients(profile) / whole.unit, FLOOR)
    near = led_into(near, whole.unit, step, task.start, task.end)[:, None]
    if free:
        near = np.column_stack([near, np.append(yaw.coefficients(step), 0.0)])
        for state, rows in ((task.start, near[:2]), (task.end, near[-3:-1])):
            if state:
                rows[:, 1] = end_coefficients(state.yaw, state.dyaw * step)
    if len(windows_of(path, nodes, window, limits)) > 1:
        joined = by_windows(whole, window, partial(_refine_window, task), near)
        yield _solution(whole, joined, began, task.deadline)
        return
    found = _hold_at_points(task, whole, near)
    if isinstance(found, str):
        yield _solution(whole, found, began, task.deadline)
        return
    starts = refining_restarts(found.interval, capped=task.speed_caps is not None)
    for held in tighten(found.attempt, found.problem, whole, starts, task.deadline):
        yield solution_of(whole, Joined(held.coefficients, (), held.iterations, held.rounds), began)


def _solution(whole: Segment, joined: Joined | str, began: float, deadline: Deadline) -> Solution:
    if isinstance(joined, str):
        return Solution(failed_status(deadline), None, f"refining: {joined}")
    solution = solution_of(whole, joined, began)
    return replace(solution, reason=solution.reason and f"refining: {solution.reason}")


class _HeldAtPoints(NamedTuple):
    """A solution that keeps its limits at points, and what it takes to go on from there."""

    attempt: Attempt
    problem: Problem
    interval: float  # s that an interval takes, about


def _hold_at_points(task: PlanningTask, segment: Segment, near: NDArray) -> _HeldAtPoints | str:
    """Solve the problem from the coefficients `near`, or return why not."""
    interval, step = interval_of(segment, near), segment.path.end / segment.layout.shape.nodes
    rate, angle, capped = segment.unit**0.5 / step, task.yaw_angle, segment.caps is not None
    problem = build_problem(segment, angle, coefficients=lowered(near, SLOWER, segment.ends.held, rate))
    attempt = _search(problem, interval, capped, task.deadline)
    if rejection_reason(attempt, segment) and not task.deadline.passed:  # not near enough
        problem = build_problem(segment, angle)
        attempt = solve(problem, problem.coefficients, COLD_START, task.deadline)
    return rejection_reason(attempt, segment) or _HeldAtPoints(attempt, problem, interval)


def _search(problem: Problem, interval: float, capped: bool, deadline: Deadline) -> Attempt:
    """Search as the first of refining_starts() that succeeds, and on from there if that stops far from the optimum."""
    first, *others = refining_starts(interval, capped=capped)
    attempt = solve(problem, problem.coefficients, (first,), deadline)
    steps = attempt.iterations
    if attempt.solved and steps >= CRAWLED and not capped:
        again = solve(problem, attempt.coefficients, (refining_again(interval, SLOWER),), deadline)
        return (again if again.solved else attempt)._replace(iterations=steps + again.iterations)
    if attempt.solved or deadline.passed:
        return attempt
    attempt = solve(problem, problem.coefficients, others, deadline)
    steps += attempt.iterations
    if attempt.solved:
        on = refining_restarts(interval, capped=capped)[:1]
        nearer = solve(problem, attempt.coefficients, on, deadline, attempt.multipliers)
        steps += nearer.iterations
        attempt = nearer if nearer.solved else attempt
    return attempt._replace(iterations=steps)


def _refine_window(task: PlanningTask, segment: Segment, near: NDArray) -> Tightened | str:
    found = _hold_at_points(task, segment, near)
    if isinstance(found, str):
        return found
    restarts = refining_restarts(found.interval, capped=segment.caps is not None)
    return tighten_until_feasible(found.attempt, found.problem, segment, restarts, task.deadline)
