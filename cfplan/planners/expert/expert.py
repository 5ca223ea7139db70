"""The expert planner: the fastest speed profile that keeps every limit, by splines and an interior point method.

h is a cubic B-spline on the grid, yaw a quadratic one, and their coefficients are the variables, so everything physical
follows point by point through the flatness map (vehicle/flatness.py). Minimised is the time of flight, by Gauss
quadrature, with small penalties on angular acceleration, yaw rate and roughness. Limits hold at both ends of every
interval, where h''' and ψ'' jump, and at points inside.

Between those points a limit can still be exceeded by a percent or so. The solution is checked densely; where it
exceeds a limit, that limit is lowered by as much in that interval alone, and the problem solved again from there,
which takes a few iterations and costs about a hundredth of a percent in time.

Where the path rests (γ' = γ'' = γ''' = 0) h has no bearing on motion and hardly any on its first derivatives: left
alone, an optimiser lets it run away or stop short. There h stays constant over the first, or last, interval.
"""

import math
import time
from collections.abc import Callable, Sequence

from numpy.typing import NDArray

from cfplan.geometry.yaw import YawMode
from cfplan.planners.expert.initial_guess import guess_spline
from cfplan.planners.expert.layout import Shape, layout_of
from cfplan.planners.expert.point_constraints import Penalties
from cfplan.planners.expert.problem import Ends, Problem, Segment, build_problem, interval_of, slowness_of
from cfplan.planners.expert.search import (
    COLD_START,
    WARM_START,
    Start,
    early_start,
    refining_restarts,
    rejection_reason,
    solve,
)
from cfplan.planners.expert.tightening import ENOUGH, Tightened, tighten_until_feasible
from cfplan.planners.expert.windows import LONG_WINDOW, WindowSize, by_windows, failed_status, solution_of
from cfplan.planners.solution import Solution
from cfplan.planners.task import PlanningTask
from cfplan.vehicle.yaw_spline import YawSpline

WINDOW = WindowSize(kept=96, ahead=24)  # longer windows take more iterations
BEGINNING, LEAST_BEGINNING = 0.6, 12  # s, and intervals, within which a start in motion shows whether it leads on


def plan_expert(
    task: PlanningTask,
    *,
    penalties: Penalties | None = None,
    window: WindowSize = WINDOW,
    starts: Sequence[Start] = COLD_START,
) -> Solution:
    """Plan the fastest profile that keeps every limit of the task.

    Yaw is that of the Hopf fibration. FIXED holds the yaw angle, TANGENT follows the horizontal direction of flight;
    both are laid out before the speed (see YawSpline), which then respects what turning takes. FREE leaves yaw to the
    optimiser, from a first yaw between that angle and a quarter turn more, as the paper has it. A start or end state
    brings its own yaw in every mode. A path longer than `window` is planned window by window, and as a whole if one of
    them fails. The search begins as the first of `starts` that succeeds. At the task's deadline there is no profile,
    unless only limits between points were still exceeded.

    Raises:
        InputError: fewer nodes than the path needs.
    """
    return _plan(task, window, penalties, lambda problem, segment: (starts, WARM_START))


def plan_early(task: PlanningTask, enough: float = ENOUGH) -> Solution:
    """Plan as plan_expert() does, but stop within about 0.02 % of the fastest, as refine() does, after one search.

    That takes half the time; and less where the limits are to leave room, of which `enough`, a share of a limit, may be
    used between points. Raises as plan_expert() does.
    """

    def searches(problem: Problem, segment: Segment) -> tuple[Sequence[Start], Sequence[Start]]:
        interval = interval_of(segment, problem.coefficients)
        return (early_start(interval),), refining_restarts(interval)[:2]

    return _plan(task, LONG_WINDOW, None, searches, enough)


def can_begin(task: PlanningTask) -> bool:
    """Return whether the first BEGINNING of a task that starts in motion can be planned, whatever comes behind it.

    Where it cannot, neither can the whole; where it can the whole mostly can, as farther on the vehicle may fly slower.
    Where one search only just succeeds, now and then the other does not: of 6,245 paths that began in motion this told
    6,240 right, in half the time that plan_early() takes to fail, and a fifth of that to succeed.
    """
    if task.refusal:
        return False
    moves = task.start.h**0.5 if task.start else 0.0  # units of s a second
    intervals = math.ceil(BEGINNING * moves * task.nodes / task.path.end)
    segment = segment_of(task, min(max(intervals, LEAST_BEGINNING), task.nodes))
    problem = build_problem(segment, task.yaw_angle)
    starts = (early_start(interval_of(segment, problem.coefficients)),)
    return not rejection_reason(solve(problem, problem.coefficients, starts, task.deadline), segment)


def segment_of(task: PlanningTask, nodes: int) -> Segment:
    """Return the first so many intervals of a task; the end of less than all of them is free."""
    whole, step = nodes == task.nodes, task.path.end / task.nodes
    path = task.path if whole else task.path.part(0.0, nodes * step)
    yaw = YawSpline.along(task.path, task.nodes, task.yaw, task.yaw_angle, task.start, task.end)
    shape = Shape(nodes, task.yaw is YawMode.FREE, task.limits.angular_acceleration < math.inf, (3, 3 * whole))
    return Segment(
        path, task.airframe, task.limits, Ends(task.start, task.end if whole else None), yaw.part(0, nodes),
        layout_of(shape),
        task.speed_caps and task.speed_caps.part(0.0, path.end),
        slowness_of(guess_spline(path, task.airframe, task.limits, nodes), task.limits),
    )  # fmt: skip


def _plan(
    task: PlanningTask,
    window: WindowSize,
    penalties: Penalties | None,
    searches: Callable[[Problem, Segment], tuple[Sequence[Start], Sequence[Start]]],
    enough: float = ENOUGH,
) -> Solution:
    """Plan a task from a guess; `searches` are those that begin there, and those that go on with lower limits."""
    task.check_nodes()
    if task.refusal:
        return task.refusal
    began = time.perf_counter()

    def search(segment: Segment, _near: NDArray) -> Tightened | str:
        problem = build_problem(segment, task.yaw_angle, penalties)
        starts, restarts = searches(problem, segment)
        attempt = solve(problem, problem.coefficients, starts, task.deadline)
        return rejection_reason(attempt, segment) or tighten_until_feasible(
            attempt, problem, segment, restarts, task.deadline, enough
        )

    whole = segment_of(task, task.nodes)
    joined = by_windows(whole, window, search)
    if isinstance(joined, str) and sum(window) < task.nodes and not task.deadline.passed:
        joined = by_windows(whole, WindowSize(task.nodes, 0), search)  # no motion continues from a joint of two windows
    if isinstance(joined, str):
        return Solution(failed_status(task.deadline), None, joined)
    return solution_of(whole, joined, began)
