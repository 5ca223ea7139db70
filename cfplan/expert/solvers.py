"""The solvers of a program: fatrop first, which knows its stages, and IPOPT as a second try."""

from functools import lru_cache
from typing import Any, NamedTuple

import casadi
import numpy as np
from numpy.typing import NDArray

from cfplan.expert.compiled import Backend
from cfplan.expert.problem import Problem
from cfplan.expert.program import Shape, program

QUIET = {"print_time": False, "show_eval_warnings": False, "calc_lam_p": False, "error_on_fail": False}
TOLERANCE = 1e-2
# of the scaled problem: 1e-5 s in the cost's gradient

# From an answer to a problem almost the same: near the bounds from the start, so 3 to 8 iterations instead of 17.
NEARBY = {"mu_init": 3e-3, "bound_push": 1e-5, "bound_frac": 1e-5, "max_iter": 40}
NEARBY_NODES = 1000
# beyond, setting up a second solver (quadratic in the nodes, in CasADi's interface) takes longer than it saves


class Attempt(NamedTuple):
    """What a solver made of a problem."""

    solver: str
    x: NDArray
    g: NDArray
    # what the constraints come to
    solved: bool
    iterations: int
    words: str
    # the solver's own, for people


def fatrop(shape: Shape, problem: Problem, backend: Backend | None, x: NDArray | None = None) -> Attempt:
    """Solve from the problem's own guess, or from `x`, the answer to a problem almost the same."""
    nearby = x is not None and shape.nodes <= NEARBY_NODES
    return _run("fatrop", _fatrop(shape, backend, nearby), problem, problem.x0 if x is None else x)


def ipopt(shape: Shape, problem: Problem, backend: Backend | None) -> Attempt:
    """Solve from the problem's own guess."""
    return _run("ipopt", _ipopt(shape, backend), problem, problem.x0)


@lru_cache(maxsize=32)
def _fatrop(shape: Shape, backend: Backend | None, nearby: bool) -> casadi.Function:
    p = program(shape, backend)
    n, layout = shape.nodes, p.layout
    equality = np.zeros(layout.constraints, dtype=bool)
    equality[layout.dynamics_rows] = True
    options: dict[str, Any] = {
        **QUIET,
        "structure_detection": "manual",
        "N": n,
        "nx": [layout.states] * (n + 1),
        "nu": [layout.controls] * n + [0],
        "ng": list(layout.counts),
        "equality": equality.tolist(),
        "fatrop": {"print_level": 0, "max_iter": 200, "tol": TOLERANCE, **(NEARBY if nearby else {})},
        "cache": {f.name(): f for f in (p.f, p.g, p.gradient_only, p.jacobian, p.hessian, p.multipliers)},
    }
    return casadi.nlpsol("expert", "fatrop", p.nlp, options)


@lru_cache(maxsize=32)
def _ipopt(shape: Shape, backend: Backend | None) -> casadi.Function:
    p = program(shape, backend)
    options: dict[str, Any] = {
        **QUIET,
        "ipopt": {
            "print_level": 0, "sb": "yes", "max_iter": 400, "tol": TOLERANCE, "constr_viol_tol": 1e-6,
            "dual_inf_tol": 10 * TOLERANCE, "compl_inf_tol": TOLERANCE,
            # Taking fixed variables out makes it read numbers that nobody wrote.
            "fixed_variable_treatment": "make_constraint",
        },
        "cache": {f.name(): f for f in (p.f, p.g, p.gradient, p.jacobian, p.upper_hessian, p.multipliers)},
    }  # fmt: skip
    return casadi.nlpsol("expert", "ipopt", p.nlp, options)


def _run(name: str, solver: casadi.Function, problem: Problem, x0: NDArray) -> Attempt:
    try:
        result = solver(x0=x0, p=problem.p, lbx=problem.lbx, ubx=problem.ubx, lbg=problem.lbg, ubg=problem.ubg)
        said = solver.stats()
    except RuntimeError as error:
        return Attempt(name, x0, problem.lbg, False, 0, str(error).splitlines()[0])
    words = f"{said['return_status']} after {said['iter_count']} iterations"
    x, g = np.array(result["x"]).ravel(), np.array(result["g"]).ravel()
    return Attempt(name, x, g, bool(said["success"]) and bool(np.isfinite(x).all()), int(said["iter_count"]), words)
