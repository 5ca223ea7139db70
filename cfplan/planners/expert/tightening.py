"""From limits kept at points to limits kept between them: lower them where they are exceeded, and search again."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from numpy.typing import NDArray

from cfplan.deadline import NEVER, Deadline
from cfplan.planners.expert.intersample import ALLOWANCE, DensePath
from cfplan.planners.expert.problem import Problem, Segment, held_by, tightened
from cfplan.planners.expert.search import WARM_START, Attempt, Start, rejection_reason, solve

ROUNDS = 5  # of tightening, at most
ENOUGH = ALLOWANCE / 3  # violation of the allowance that ends them, unless limits leave room


class Tightened(NamedTuple):
    """A solution that keeps its limits between the points, as far as tightening led."""

    coefficients: NDArray  # (N+3, 1 or 2)
    rounds: int
    iterations: int  # of the attempt and of all rounds


def tighten(
    attempt: Attempt, problem: Problem, segment: Segment, starts: Sequence[Start] = WARM_START,
    deadline: Deadline = NEVER, enough: float = ENOUGH,
) -> Iterator[Tightened]:  # fmt: skip
    """Lower limits and solve again until none is exceeded between points; yield what each round leads to.

    Where nothing is exceeded at first, but for `enough`, a share of a limit, or the deadline has passed by then, the
    attempt itself comes alone. A round that fails is the last: slowing will do the rest.
    """
    nodes = segment.layout.shape.nodes
    dense = DensePath(segment.path, nodes, held_by(segment.ends, nodes), segment.caps)
    found = Tightened(attempt.coefficients, 0, attempt.iterations)
    for done in range(ROUNDS):
        violation = dense.violation(segment.profile(attempt.coefficients), segment.airframe, segment.limits)
        if violation.worst <= enough or deadline.passed:
            break
        problem = tightened(problem, violation, attempt.rows)
        attempt = solve(problem, attempt.coefficients, starts, deadline, attempt.multipliers)
        if rejection_reason(attempt, segment):
            break
        found = Tightened(attempt.coefficients, done + 1, found.iterations + attempt.iterations)
        yield found
    if not found.rounds:
        yield found


def tighten_until_feasible(
    attempt: Attempt, problem: Problem, segment: Segment, starts: Sequence[Start] = WARM_START,
    deadline: Deadline = NEVER, enough: float = ENOUGH,
) -> Tightened:  # fmt: skip
    """Return what the last round of tighten() leads to."""
    *_, last = tighten(attempt, problem, segment, starts, deadline, enough)
    return last
