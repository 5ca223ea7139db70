"""The solvers of a problem: our own interior point method first, IPOPT as a second try."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import casadi
import numpy as np
from numpy.typing import NDArray

from cfplan.planners.expert.kernel import Backend
from cfplan.planners.expert.problem import Problem, table_of, variables_of
from cfplan.planners.expert.program import Shape, program
from cfplan.planners.expert.transcription import SplineProblem
from cfplan.planners.solver.interior_point import Search, minimise

TOLERANCE = 1e-2
# of the scaled problem: 1e-5 s in the cost's gradient
FROM_AFAR = (
    Search(iterations=60), Search(barrier=0.1, push=0.3, iterations=100)
)  # fmt: skip
# from a guess; what the first does not solve begins far inside the bounds
AGAIN = (
    Search(barrier=3e-3, push=1e-4, iterations=20), Search(barrier=0.05, push=1e-3, iterations=40), *FROM_AFAR
)  # fmt: skip
# from the answer to a problem almost the same: near the bounds from the start, and further off where that fails
NEARLY = 1.25
# the barrier, by second that an interval takes, that keeps within a few thousandths of the best
NEARLY_FEASIBLE, NEARLY_FLAT, LEFT_BY_STEP = 2e-4, 0.05, 0.2
# what then remains of the constraints is a fraction of the margin that they are tightened by; whole steps leave less
# than a tenth of the gradient


def quickly(interval: float) -> Sequence[Search]:
    """From what is nearly right to what takes a few thousandths longer than the best; `interval` takes so long, s."""
    return _nearly(NEARLY * interval, push=1e-2, iterations=40), *FROM_AFAR


def quickly_again(interval: float) -> Sequence[Search]:
    """The same, from the answer to a problem almost the same."""
    return _nearly(NEARLY * interval, push=3e-3, iterations=20), *AGAIN


def _nearly(barrier: float, push: float, iterations: int) -> Search:
    return Search(
        barrier=barrier, last_barrier=barrier, push=push, iterations=iterations,
        feasibility=NEARLY_FEASIBLE, gradient=NEARLY_FLAT, left_by_step=LEFT_BY_STEP,
    )  # fmt: skip


class Attempt(NamedTuple):
    """What a solver made of a problem."""

    solver: str
    table: NDArray
    # (N+3, 1 or 2) spline coefficients
    at_points: NDArray
    # what the rows come to, as layout.selected has them
    solved: bool
    iterations: int
    words: str
    # the solver's own, for people
    splines: SplineProblem | None = None
    # what it was solved as, to solve again with other limits


def interior_point(problem: Problem, backend: Backend | None, searches: Sequence[Search] = FROM_AFAR) -> Attempt:
    """Search from the problem's own table, as the first of `searches` that succeeds."""
    return _searched(SplineProblem(problem, backend), problem.table, searches)


def again(attempt: Attempt, problem: Problem, backend: Backend | None, searches: Sequence[Search] = AGAIN) -> Attempt:
    """Search from an attempt's answer, with the limits of `problem`, which differs in nothing else."""
    splines = attempt.splines.bounded_as(problem) if attempt.splines else SplineProblem(problem, backend)
    return _searched(splines, attempt.table, searches)


def _searched(splines: SplineProblem, table: NDArray, searches: Sequence[Search]) -> Attempt:
    v, iterations = splines.v_of(table), 0
    for search in searches:
        ended = minimise(splines, v, search)
        iterations += ended.iterations
        if ended.solved:
            break
    return Attempt(
        "interior point", splines.table_of(ended.v), splines.at_points(), ended.solved, iterations, ended.words, splines
    )


def ipopt(problem: Problem, backend: Backend | None) -> Attempt:
    """Search from the problem's own guess, by another formulation: states and controls, tied by dynamics.

    It evaluates through CasADi's virtual machine whatever `backend` says.
    """
    held = problem.lbx == problem.ubx
    x0 = np.where(held, problem.lbx, variables_of(problem.table, problem.layout))
    try:
        result = _ipopt(problem.layout.shape)(
            x0=x0, p=problem.p, lbx=problem.lbx, ubx=problem.ubx, lbg=problem.lbg, ubg=problem.ubg
        )
        said = _ipopt(problem.layout.shape).stats()
    except RuntimeError as error:
        return Attempt("ipopt", problem.table, problem.lbg, False, 0, str(error).splitlines()[0])
    x, g = np.array(result["x"]).ravel(), np.array(result["g"]).ravel()
    words = f"{said['return_status']} after {said['iter_count']} iterations"
    solved = bool(said["success"]) and bool(np.isfinite(x).all())
    at_points = g[problem.layout.point_rows]
    return Attempt("ipopt", table_of(x, problem.layout), at_points, solved, int(said["iter_count"]), words)


@lru_cache(maxsize=32)
def _ipopt(shape: Shape) -> casadi.Function:
    p = program(shape)
    options: dict[str, Any] = {
        "print_time": False, "show_eval_warnings": False, "calc_lam_p": False, "error_on_fail": False,
        "ipopt": {
            "print_level": 0, "sb": "yes", "max_iter": 400, "tol": TOLERANCE, "constr_viol_tol": 1e-6,
            "dual_inf_tol": 10 * TOLERANCE, "compl_inf_tol": TOLERANCE,
        },
        "cache": {f.name(): f for f in (p.f, p.g, p.gradient, p.jacobian, p.upper_hessian, p.multipliers)},
    }  # fmt: skip
    return casadi.nlpsol("expert", "ipopt", p.nlp, options)
