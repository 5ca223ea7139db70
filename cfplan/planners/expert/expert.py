"""The expert planner: the fastest speed profile that keeps every limit, by splines and an interior point method.

h is a cubic B-spline on the grid, yaw a quadratic one, and their coefficients are the variables, so everything physical
follows point by point through the flatness map (vehicle/flatness.py). Minimised is the time of flight, by Gauss
quadrature, with small penalties on angular acceleration, yaw rate and roughness. Limits hold at both ends of every
interval, where h''' and ψ'' jump, and at points inside (problem.py). Three strategies search for the solution:

    OPTIMUM      from a guess to the optimum
    early()      from a guess to within about 0.02 % of it, in half the time; gives up early if there is no solution
    refining()   to the same accuracy, from a near-feasible profile, in a fraction of the steps

Between the points a limit can still be exceeded by about a percent. The solution is checked densely; in each interval
that exceeds a limit, that limit is lowered by the excess, and the problem is solved again from there, which takes a few
iterations and makes the flight about 0.01 % longer. Long paths are planned in windows (windows.py).

At a rest (γ' = γ'' = γ''' = 0) h has no effect on the motion and almost none on its first derivatives, so an optimiser
lets it diverge or fall to zero. There h stays constant over the first, or last, interval.
"""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.deadline import NEVER, Deadline
from cfplan.geometry.yaw import YawMode
from cfplan.planners.expert.initial_guess import guess_spline, led_into, lowered
from cfplan.planners.expert.intersample import DensePath
from cfplan.planners.expert.problem import (
    Ends,
    Problem,
    Segment,
    Shape,
    build_problem,
    held_by,
    interval_of,
    layout_of,
    slowness_of,
    tightened,
)
from cfplan.planners.expert.transcription import SplineProgram
from cfplan.planners.expert.tuning import TUNING, WindowSize
from cfplan.planners.expert.windows import Joined, Tightened, by_windows, windows_of
from cfplan.planners.solution import Solution, Status
from cfplan.planners.solver.interior_point import Multipliers, Search, minimise
from cfplan.planners.task import PlanningTask
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.profile_spline import h_coefficients
from cfplan.vehicle.yaw_spline import YawSpline, end_coefficients


def plan_expert(task: PlanningTask, *, window: WindowSize = TUNING.window) -> Solution:
    """Plan the fastest profile that keeps every limit of the task.

    Yaw is that of the Hopf fibration. FIXED holds the yaw angle, TANGENT follows the horizontal direction of flight;
    both are fixed before the speed is planned (see YawSpline), which allows for the turning. FREE leaves yaw to the
    optimiser, from a first yaw between that angle and a quarter turn more, as the paper has it. A start or end state
    brings its own yaw in every mode. A path longer than `window` is planned window by window, and in one piece if one
    of them fails. If the task's deadline passes there is no profile, unless all limits at points were kept by then.

    Raises:
        InputError: fewer nodes than the path needs.
    """
    return _plan(task, window, lambda _interval: OPTIMUM, TUNING.enough)


def plan_early(task: PlanningTask, enough: float = TUNING.enough) -> Solution:
    """Plan like plan_expert(), to within about 0.02 % of the fastest, by one search in half the time.

    If the limits leave room, planning takes less: `enough`, a fraction of a limit, may be exceeded between points.
    Raises as plan_expert() does.
    """
    return _plan(task, TUNING.early_window, early, enough)


def can_begin(task: PlanningTask) -> bool:
    """Return whether the beginning of a task that starts in motion can be planned, regardless of the rest.

    If it cannot, the task has no plan; if it can, there usually is one, as the vehicle may fly slower farther on.
    In marginal cases one of the two searches may fail alone: of 6,245 paths that began in motion the answer was right
    for 6,240, in half the time that plan_early() takes to fail, and a fifth of the time that it takes to succeed.
    """
    if task.refusal:
        return False
    moves = task.start.h**0.5 if task.start else 0.0  # units of s a second
    intervals = math.ceil(TUNING.beginning * moves * task.nodes / task.path.end)
    segment = segment_of(task, min(max(intervals, TUNING.least_beginning), task.nodes))
    problem = build_problem(segment, task.yaw_angle)
    starts = early(interval_of(segment, problem.coefficients)).starts
    return not rejection_reason(solve(problem, problem.coefficients, starts, task.deadline), segment)


def refine(task: PlanningTask, profile: SpeedProfile, *, window: WindowSize = TUNING.early_window) -> Solution:
    """Refine a near-feasible profile on its grid to within about 0.02 % of the fastest.

    Yaw is that of the profile, not of the task; if the task leaves it free it is optimised too. If the solution has a
    reason besides a profile, the reason names the place from which the profile is unchanged.
    """
    *_, last = refinements(task, profile, window=window)
    return last


def refinements(
    task: PlanningTask, profile: SpeedProfile, *, window: WindowSize = TUNING.early_window
) -> Iterator[Solution]:
    """Yield the refined profile, after each round in which limits exceeded between points are lowered.

    The first usually passes the certificate. A path longer than `window` is planned window by window and yields one
    profile, after all rounds. A failure is the only item. After the task's deadline the rest stays as given.
    """
    began, nodes = time.perf_counter(), len(profile.s) - 1
    whole, near = _given(task, profile)

    def search(segment: Segment, near: NDArray) -> Tightened | str:
        found = _hold_at_points(task, segment, near)
        return found if isinstance(found, str) else _last(_tighten_refined(task, segment, found))

    if len(windows_of(task.path, nodes, window, task.limits)) > 1:
        yield _refined(task, whole, by_windows(whole, window, search, near), began)
        return
    found = _hold_at_points(task, whole, near)
    if isinstance(found, str):
        yield _refined(task, whole, found, began)
        return
    for held in _tighten_refined(task, whole, found):
        yield _refined(task, whole, Joined(held.coefficients, (), held.iterations, held.rounds), began)


def segment_of(task: PlanningTask, nodes: int) -> Segment:
    """Return the first `nodes` intervals of a task; their end is free unless they are all of it."""
    whole, step = nodes == task.nodes, task.path.end / task.nodes
    path = task.path if whole else task.path.part(0.0, nodes * step)
    yaw = YawSpline.along(task.path, task.nodes, task.yaw, task.yaw_angle, task.start)
    shape = Shape(nodes, task.yaw is YawMode.FREE, task.limits.angular_acceleration < math.inf, (3, 3 * whole))
    return Segment(
        path, task.airframe, task.limits, Ends(task.start), yaw.part(0, nodes),
        layout_of(shape),
        task.speed_caps and task.speed_caps.part(0.0, path.end),
        slowness_of(guess_spline(path, task.airframe, task.limits, nodes), task.limits),
    )  # fmt: skip


class Start(NamedTuple):
    """How a search starts."""

    search: Search
    lowered: float = 0.0  # fraction by which it lowers h of the given coefficients
    goes_on: bool = False  # whether it takes the known multipliers


class Strategy(NamedTuple):
    """A strategy of search: its starts are tried until one succeeds."""

    starts: tuple[Start, ...]
    restarts: tuple[Start, ...]  # from a solution, after limits were lowered


# From a guess; if the first start fails, the next begins far inside the bounds, and the last slower.
FROM_GUESS = (
    Start(Search(iterations=60)),
    Start(Search(barrier=0.1, push=0.3, iterations=100)),
    Start(Search(barrier=0.1, push=0.3, iterations=100), lowered=0.5),
)
# From the solution of a nearly identical problem: with its multipliers; near the bounds, and farther off.
FROM_NEARBY = (
    Start(Search(barrier=3e-3, iterations=12), goes_on=True),
    Start(Search(barrier=3e-3, push=1e-4, iterations=20)),
    Start(Search(barrier=0.05, push=1e-3, iterations=40)),
    *FROM_GUESS,
)
OPTIMUM = Strategy(FROM_GUESS, FROM_NEARBY)


def early(interval: float) -> Strategy:
    """Return the strategy that stops and gives up early, for intervals that take about `interval`, s."""
    t = TUNING
    start = Start(Search(
        last_barrier=t.stop_barrier * interval, push=0.1, iterations=60,
        feasibility=t.loose_factor * t.stop_feasibility, gradient=t.loose_factor * t.stop_gradient,
        predicted_gradient_factor=t.predicted_gradient_factor, least_step=t.least_step,
    ))  # fmt: skip
    return Strategy((start,), refining(interval).restarts[:2])


def refining(interval: float, *, capped: bool = False) -> Strategy:
    """Return the strategy for a near-feasible profile whose intervals take `interval`, s; `capped` by speed caps."""
    t = TUNING
    stop, fallback = t.stop_barrier * interval, t.fallback_barrier_factor * t.stop_barrier * interval
    restart = _stopping_early(fallback if capped else stop, push=3e-3, iterations=20)
    barriers, first = ((fallback,), 1.0) if capped else ((stop, fallback), t.first_barrier_factor)
    starts = (_stopping_early(barrier, loosely=t.loose_factor, first=first) for barrier in barriers)
    return Strategy((*starts, *FROM_GUESS), (restart._replace(goes_on=True), restart, *FROM_NEARBY))


def _stopping_early(
    barrier: float, push: float = 1e-2, iterations: int = 40, loosely: float = 1.0, first: float = 1.0
) -> Start:
    return Start(Search(
        barrier=first * barrier, last_barrier=barrier, multipliers=TUNING.first_multipliers / first, push=push,
        iterations=iterations, feasibility=loosely * TUNING.stop_feasibility, gradient=loosely * TUNING.stop_gradient,
        predicted_gradient_factor=TUNING.predicted_gradient_factor,
    ))  # fmt: skip


class Attempt(NamedTuple):
    """The solver's solution of a problem."""

    coefficients: NDArray  # (N+3, 1 or 2)
    rows: NDArray  # (ROWS, P) at points
    multipliers: Multipliers
    solved: bool
    iterations: int  # of all searches
    message: str


def solve(
    problem: Problem, coefficients: NDArray, starts: Sequence[Start], deadline: Deadline = NEVER,
    known: Multipliers | None = None,
) -> Attempt:  # fmt: skip
    """Search from these coefficients, (N+3, 1 or 2), trying `starts` until one succeeds or the deadline passes.

    Starts that go on take the multipliers `known` from a nearly identical problem.
    """
    program, iterations = SplineProgram(problem), 0
    for start in starts:
        from_here = coefficients
        if start.lowered:
            from_here = lowered(coefficients, start.lowered, problem.ends.held, problem.unit**0.5 / problem.step)
        result = minimise(program, program.v_of(from_here), start.search, deadline, known if start.goes_on else None)
        iterations += result.iterations
        if result.solved or deadline.passed:
            break
    return Attempt(
        program.coefficients_of(result.v), program.rows_of(result.values.constraints), result.multipliers,
        result.solved, iterations, result.message,
    )  # fmt: skip


def rejection_reason(attempt: Attempt, segment: Segment) -> str:
    """Return why a solution must be rejected even if the solver reports success; empty if it is acceptable."""
    if not attempt.solved:
        return attempt.message
    if not np.isfinite(attempt.coefficients).all():
        return "the solution is not finite"
    if (attempt.coefficients[:, 0] > 0.0).all():  # then h is positive too: it lies between its coefficients
        return ""
    profile = segment.profile(attempt.coefficients)
    places = np.linspace(0.0, 1.0, 9)
    nodes = np.arange(segment.layout.shape.nodes)
    s = profile.s[:-1, None] + np.diff(profile.s)[:, None] * places
    if (profile.at(s, np.repeat(nodes[:, None], len(places), axis=1)).h <= 0).any():
        return "h falls to zero between nodes"
    return ""


def _tighten(
    attempt: Attempt, problem: Problem, segment: Segment, restarts: Sequence[Start], deadline: Deadline, enough: float
) -> Iterator[Tightened]:
    """Lower limits and solve again until none is exceeded between points; yield the result of each round.

    If nothing is exceeded at first by more than `enough`, a fraction of a limit, or the deadline has passed, yield only
    the attempt itself. A round that fails is the last: slowing the plan does the rest.
    """
    nodes = segment.layout.shape.nodes
    dense = DensePath(segment.path, nodes, held_by(segment.ends, nodes), segment.caps)
    found = Tightened(attempt.coefficients, 0, attempt.iterations)
    for done in range(TUNING.rounds):
        violation = dense.violation(segment.profile(attempt.coefficients), segment.airframe, segment.limits)
        if violation.worst <= enough or deadline.passed:
            break
        problem = tightened(problem, violation, attempt.rows)
        attempt = solve(problem, attempt.coefficients, restarts, deadline, attempt.multipliers)
        if rejection_reason(attempt, segment):
            break
        found = Tightened(attempt.coefficients, done + 1, found.iterations + attempt.iterations)
        yield found
    if not found.rounds:
        yield found


def _last(rounds: Iterator[Tightened]) -> Tightened:
    *_, last = rounds
    return last


def _plan(task: PlanningTask, window: WindowSize, strategy_for: Callable[[float], Strategy], enough: float) -> Solution:
    """Plan a task from a guess; `strategy_for` gives the strategy by the duration of an interval, s."""
    task.check_nodes()
    if task.refusal:
        return task.refusal
    began = time.perf_counter()

    def search(segment: Segment, _near: NDArray) -> Tightened | str:
        problem = build_problem(segment, task.yaw_angle)
        strategy = strategy_for(interval_of(segment, problem.coefficients))
        attempt = solve(problem, problem.coefficients, strategy.starts, task.deadline)
        return rejection_reason(attempt, segment) or _last(
            _tighten(attempt, problem, segment, strategy.restarts, task.deadline, enough)
        )

    whole = segment_of(task, task.nodes)
    joined = by_windows(whole, window, search)
    if isinstance(joined, str) and sum(window) < task.nodes and not task.deadline.passed:
        joined = by_windows(whole, WindowSize(task.nodes, 0), search)  # no motion continues from a joint of two windows
    return _solution(task, whole, joined, began)


def _given(task: PlanningTask, profile: SpeedProfile) -> tuple[Segment, NDArray]:
    """Return a task on the grid and with the yaw of a profile, and the profile's coefficients, (N+3, 1 or 2)."""
    path, limits, nodes = task.path, task.limits, len(profile.s) - 1
    free, step = task.yaw is YawMode.FREE, task.path.end / nodes
    layout = layout_of(Shape(nodes, free, turning_limited=limits.angular_acceleration < math.inf))
    ends, yaw = Ends(task.start), YawSpline.of(profile)
    whole = Segment(path, task.airframe, limits, ends, yaw, layout, task.speed_caps, slowness_of(profile.h, limits))
    near = np.maximum(h_coefficients(profile) / whole.unit, TUNING.floor)
    near = led_into(near, whole.unit, step, task.start)[:, None]
    if free:
        near = np.column_stack([near, np.append(yaw.coefficients(step), 0.0)])
        if task.start:
            near[:2, 1] = end_coefficients(task.start.yaw, task.start.dyaw * step)
    return whole, near


class _HeldAtPoints(NamedTuple):
    """A solution that keeps its limits at points, and the inputs for tightening it."""

    attempt: Attempt
    problem: Problem
    strategy: Strategy


def _hold_at_points(task: PlanningTask, segment: Segment, near: NDArray) -> _HeldAtPoints | str:
    """Refine the coefficients `near` until limits are kept at points, or return the reason for failure."""
    step, capped = segment.path.end / segment.layout.shape.nodes, segment.caps is not None
    strategy = refining(interval_of(segment, near), capped=capped)
    begin = lowered(near, TUNING.initial_h_reduction, segment.ends.held, segment.unit**0.5 / step)
    problem = build_problem(segment, task.yaw_angle, coefficients=begin)
    attempt = _search_near(problem, strategy, capped, task.deadline)
    if rejection_reason(attempt, segment) and not task.deadline.passed:  # too far from feasible
        problem = build_problem(segment, task.yaw_angle)
        attempt = solve(problem, problem.coefficients, FROM_GUESS, task.deadline)
    return rejection_reason(attempt, segment) or _HeldAtPoints(attempt, problem, strategy)


def _search_near(problem: Problem, strategy: Strategy, capped: bool, deadline: Deadline) -> Attempt:
    """Try the strategy's starts until one succeeds; search on from there if it stopped far from the optimum."""
    first, *others = strategy.starts
    attempt = solve(problem, problem.coefficients, (first,), deadline)
    steps = attempt.iterations
    if attempt.solved and (capped or steps < TUNING.stall_iterations):
        return attempt
    if attempt.solved:  # it may have stalled at its bounds
        last = first.search.last_barrier
        search = replace(first.search, barrier=last, multipliers=TUNING.first_multipliers)
        on = Start(search, lowered=TUNING.initial_h_reduction)
        nearer = solve(problem, attempt.coefficients, (on,), deadline)
    elif deadline.passed:
        return attempt
    else:
        attempt = solve(problem, problem.coefficients, others, deadline)
        steps += attempt.iterations
        if not attempt.solved:
            return attempt._replace(iterations=steps)
        nearer = solve(problem, attempt.coefficients, strategy.restarts[:1], deadline, attempt.multipliers)
    return (nearer if nearer.solved else attempt)._replace(iterations=steps + nearer.iterations)


def _tighten_refined(task: PlanningTask, segment: Segment, found: _HeldAtPoints) -> Iterator[Tightened]:
    return _tighten(found.attempt, found.problem, segment, found.strategy.restarts, task.deadline, TUNING.enough)


def _solution(task: PlanningTask, whole: Segment, joined: Joined | str, began: float) -> Solution:
    """Return the solution made of joined windows; the search began at `began`, by time.perf_counter()."""
    if isinstance(joined, str):
        return Solution(Status.OUT_OF_TIME if task.deadline.passed else Status.NOT_CONVERGED, None, joined)
    stats: dict[str, float | int | str] = {
        "solve_seconds": time.perf_counter() - began,
        "iterations": joined.iterations,
        "rounds": joined.rounds,
        "windows": 1 + len(joined.joints),
        "solver": "interior point",
    }
    return Solution(Status.SOLVED, whole.profile(joined.coefficients), joined.unfinished, stats, joined.joints)


def _refined(task: PlanningTask, whole: Segment, joined: Joined | str, began: float) -> Solution:
    solution = _solution(task, whole, joined, began)
    return replace(solution, reason=solution.reason and f"refining: {solution.reason}")
