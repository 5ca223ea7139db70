"""How the interior point method searches a speed-profile problem: where each search starts, and when it stops."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.deadline import NEVER, Deadline
from cfplan.machine_code import njit
from cfplan.planners.expert.initial_guess import lowered
from cfplan.planners.expert.problem import Problem, Segment
from cfplan.planners.expert.transcription import SplineProgram
from cfplan.planners.solver.interior_point import Multipliers, Search, minimise


class Start(NamedTuple):
    """One search, and where it starts."""

    search: Search
    lowered: float = 0.0  # share of h by which it starts below the coefficients that it is given
    goes_on: bool = False  # with the multipliers that are known


class Attempt(NamedTuple):
    """A solution of a problem as the solver left it."""

    coefficients: NDArray  # (N+3, 1 or 2)
    rows: NDArray  # (ROWS, P) at points
    multipliers: Multipliers
    solved: bool
    iterations: int  # of all searches
    message: str


# From a guess; what the first does not solve starts far inside the bounds, and at last slower.
COLD_START = (
    Start(Search(iterations=60)),
    Start(Search(barrier=0.1, push=0.3, iterations=100)),
    Start(Search(barrier=0.1, push=0.3, iterations=100), lowered=0.5),
)
# From the solution of a problem almost the same: with its multipliers; near the bounds, and further off.
WARM_START = (
    Start(Search(barrier=3e-3, iterations=12), goes_on=True),
    Start(Search(barrier=3e-3, push=1e-4, iterations=20)),
    Start(Search(barrier=0.05, push=1e-3, iterations=40)),
    *COLD_START,
)
# Refining stops early, within about 0.02 % of the optimum: at a barrier of EARLY_STOP for each second that an interval
# takes. What then remains of the constraints is a fraction of the margin that they are tightened by; whole steps leave
# less than a tenth of the gradient. Before limits are tightened ROUGHLY as many times that may remain.
EARLY_STOP, EARLY_FEASIBILITY, EARLY_GRADIENT, EARLY_LEFT_BY_STEP = 0.15, 2e-4, 0.05, 0.2
ROUGHLY = 10.0
# Times that barrier: with which refining begins. From a profile far off, a search that begins with the last one crawls
# along its bounds.
FIRST_BARRIER = 3.0
# Times the last barrier: what multipliers are at first, which are far larger where limits are used to the full.
EARLY_MULTIPLIERS = 10.0

# Times that barrier, further inside the bounds and 0.3 % from the optimum: where the search does not end otherwise, and
# under caps, which giving way finds step by step: from profiles at their limits it finds lower ones.
EARLIER = 8.0

# Share of a step, below which a search from a guess is given up: of 217 that succeeded one had a shorter step, of 164
# that failed all; they end after half as many.
LEAST_STEP = 3e-3


def refining_starts(interval: float, *, capped: bool = False) -> Sequence[Start]:
    """Return the searches that refine a near-feasible profile whose intervals take this long, s."""
    if capped:
        return _early(EARLIER * EARLY_STOP * interval, push=1e-2, iterations=40, roughly=ROUGHLY), *COLD_START
    return (
        _early(EARLY_STOP * interval, push=1e-2, iterations=40, roughly=ROUGHLY, first=FIRST_BARRIER),
        _early(EARLIER * EARLY_STOP * interval, push=1e-2, iterations=40, roughly=ROUGHLY, first=FIRST_BARRIER),
        *COLD_START,
    )


def early_start(interval: float) -> Start:
    """Return the search from a guess that stops as early as refining does, and gives up early."""
    return Start(Search(
        last_barrier=EARLY_STOP * interval, push=0.1, iterations=60, feasibility=ROUGHLY * EARLY_FEASIBILITY,
        gradient=ROUGHLY * EARLY_GRADIENT, left_by_step=EARLY_LEFT_BY_STEP, least_step=LEAST_STEP,
    ))  # fmt: skip


def refining_again(interval: float, lowered: float) -> Start:
    """Return the search that goes on where one of these crawled: from that share below it, at the last barrier."""
    return _early(EARLY_STOP * interval, push=1e-2, iterations=40, roughly=ROUGHLY)._replace(lowered=lowered)


def refining_restarts(interval: float, *, capped: bool = False) -> Sequence[Start]:
    """Return the same from the solution of a problem almost the same."""
    stop = EARLIER * EARLY_STOP if capped else EARLY_STOP
    start = _early(stop * interval, push=3e-3, iterations=20)
    return start._replace(goes_on=True), start, *WARM_START


def _early(barrier: float, push: float, iterations: int, roughly: float = 1.0, first: float = 1.0) -> Start:
    return Start(Search(
        barrier=first * barrier, last_barrier=barrier, multipliers=EARLY_MULTIPLIERS / first, push=push,
        iterations=iterations, feasibility=roughly * EARLY_FEASIBILITY, gradient=roughly * EARLY_GRADIENT,
        left_by_step=EARLY_LEFT_BY_STEP,
    ))  # fmt: skip


def solve(
    problem: Problem, coefficients: NDArray, starts: Sequence[Start], deadline: Deadline = NEVER,
    known: Multipliers | None = None,
) -> Attempt:  # fmt: skip
    """Search from these coefficients, (N+3, 1 or 2), as the first of `starts` that succeeds, until the deadline.

    Starts that go on take the multipliers that are `known` of a problem almost the same.
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
    """Return why a solution must be rejected even if the solver reports success; empty where it need not be."""
    if not attempt.solved:
        return attempt.message
    finite, positive = _soundness(attempt.coefficients)
    if not finite:
        return "the solution is not finite"
    if positive:  # then so is h, which lies between its coefficients
        return ""
    profile = segment.profile(attempt.coefficients)
    places = np.linspace(0.0, 1.0, 9)
    nodes = np.arange(segment.layout.shape.nodes)
    s = profile.s[:-1, None] + np.diff(profile.s)[:, None] * places
    if (profile.at(s, np.repeat(nodes[:, None], len(places), axis=1)).h <= 0).any():
        return "h falls to zero between nodes"
    return ""


@njit
def _soundness(coefficients: NDArray) -> tuple[bool, bool]:
    """Return whether all coefficients, (N+3, 1 or 2), are finite, and whether all of h are positive."""
    finite = positive = True
    for n in range(coefficients.shape[0]):
        positive = positive and coefficients[n, 0] > 0.0
        for column in range(coefficients.shape[1]):
            finite = finite and math.isfinite(coefficients[n, column])
    return finite, positive
