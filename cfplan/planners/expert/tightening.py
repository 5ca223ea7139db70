"""From limits kept at points to limits kept between them: lower them where they are exceeded, and search again."""

from collections.abc import Sequence
from typing import NamedTuple

from numpy.typing import NDArray

from cfplan.deadline import NEVER, Deadline
from cfplan.planners.expert.intersample import ALLOWANCE, DensePath
from cfplan.planners.expert.problem import Problem, Segment, held_by, tightened
from cfplan.planners.expert.search import WARM_START, Attempt, Start, rejection_reason, solve

ROUNDS = 5  # of tightening, at most
ENOUGH = ALLOWANCE / 3  # violation of the allowance that ends them


class Tightened(NamedTuple):
    """A solution that keeps its limits between the points, as far as tightening led."""

    coefficients: NDArray  # (N+3, 1 or 2)
    rounds: int
    iterations: int  # of the attempt and of all rounds


def tighten_until_feasible(
    attempt: Attempt, problem: Problem, segment: Segment, starts: Sequence[Start] = WARM_START,
    deadline: Deadline = NEVER,
) -> Tightened:  # fmt: skip
    """Lower limits and solve again until none is exceeded between points, or the deadline passes.

    A round that fails leaves the solution of the one before: slowing will do the rest.
    """
    nodes = segment.layout.shape.nodes
    dense = DensePath(segment.path, nodes, held_by(segment.ends, nodes), segment.caps)
    iterations = attempt.iterations
    for done in range(ROUNDS):
        violation = dense.violation(segment.profile(attempt.coefficients), segment.airframe, segment.limits)
        if violation.worst <= ENOUGH or deadline.passed:
            return Tightened(attempt.coefficients, done, iterations)
        problem = tightened(problem, violation, attempt.rows)
        following = solve(problem, attempt.coefficients, starts, deadline)
        iterations += following.iterations
        if rejection_reason(following, segment):
            return Tightened(attempt.coefficients, done, iterations)
        attempt = following
    return Tightened(attempt.coefficients, ROUNDS, iterations)
