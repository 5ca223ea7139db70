"""A primal-dual interior point method for problems along a path.

Variables are spline coefficients, so there are no equations to keep, and a coefficient meets only its neighbours: the
Newton matrix is banded, and factoring it costs less than evaluating the functions. With slacks s for the constraints,

    minimise f(v)   subject to   g(v) = s,   lower ≤ s ≤ upper,

the method is that of Wächter and Biegler, "On the implementation of an interior-point filter line-search algorithm for
large-scale nonlinear programming" (2006), without its restoration phase: log barriers, slacks and their multipliers
eliminated from the Newton step, a filter line search, the barrier lowered as its problem is solved. A matrix that is
not positive definite is made so by adding to its diagonal.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from cfplan.planners.solver import banded
from cfplan.planners.solver import barrier as slacks

BOUNDARY = 0.99
# of the way to a bound that a step may go, at least
BARRIER_FACTOR, BARRIER_POWER = 0.2, 1.5
# how fast the barrier parameter falls
BARRIER_SOLVED = 10.0
# times the barrier parameter: the error at which it falls
FILTER = 1e-5
# share of the infeasibility by which a step must better it, or the cost
SWITCH_COST, SWITCH_FEASIBILITY = 2.3, 1.1
ARMIJO = 1e-4
HALVINGS = 14


class Functions(Protocol):
    """f and g of a problem, with the arrays in which numbers go to and fro."""

    bounds: NDArray
    # (5, m) of the constraints, see slacks
    rows: int
    # g begins with so many rows of as many constraints each
    g: NDArray
    # (m,) by values()
    pulls: NDArray
    # (4, m) barrier.PULLS, for expand()
    gradients: NDArray
    # (4, size) of f, and J' times each of the pulls but the first; by expand()
    matrix: NDArray
    # (size, band + 1) the Hessian of f + y·g, plus J'ΣJ, see banded; by expand()

    def values(self, v: NDArray) -> float:
        """f; and g."""

    def expand(self) -> None:
        """Gradients and matrix, around the last v."""

    def along(self, dv: NDArray) -> NDArray:
        """(m,) J dv, J of the last expand(). Overwritten by the next call."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Search:
    """How to search; the numbers are in the problem's own units."""

    barrier: float = 1.0
    # at first
    last_barrier: float = 3e-3
    gradient: float = 1e-2
    # of the Lagrangian, at the end
    feasibility: float = 1e-5
    # of the constraints, at the end
    left_by_step: float | None = None
    # share of that gradient which a whole step is taken to leave; else it is computed anew before the search ends
    push: float = 1e-2
    # how far slacks start inside their bounds at least, of the span between them
    iterations: int = 100


class Ended(NamedTuple):
    """Where the search ended."""

    v: NDArray
    solved: bool
    iterations: int
    words: str


def minimise(functions: Functions, v: NDArray, search: Search) -> Ended:
    """Search from v, where the functions must be defined. They are left at the end of the search."""
    barrier, bounds, rows = search.barrier, functions.bounds, functions.rows
    g, pulls = functions.g, functions.pulls
    gradient, by_multipliers, by_walls, by_missing = functions.gradients
    state, step = np.empty((3, len(g))), np.zeros((3, len(g)))
    factor = np.empty_like(functions.matrix)
    cost = functions.values(v)
    slacks.first(g, bounds, barrier, search.push, state, pulls)
    errors = slacks.errors(g, bounds, state, barrier)
    infeasible, walls = slacks.standing(g, bounds, state, step, 0.0, barrier, rows)
    most_infeasible, regularised = 1e4 * max(1.0, infeasible), 0.0
    filtered: list[tuple[float, float]] = []
    for iteration in range(search.iterations):
        functions.expand()
        off_gradient = float(np.abs(gradient + by_multipliers).max())
        if not math.isfinite(infeasible + off_gradient + cost):
            return Ended(v, False, iteration, "met what is not a number")
        lowered = False
        while _error(errors, off_gradient, search) <= BARRIER_SOLVED * barrier:
            if barrier <= search.last_barrier:
                return Ended(v, True, iteration, f"solved in {iteration} iterations")
            barrier = max(search.last_barrier, min(BARRIER_FACTOR * barrier, barrier**BARRIER_POWER))
            errors = slacks.errors(g, bounds, state, barrier)
            lowered = True
        if lowered:
            filtered.clear()
            infeasible, walls = slacks.standing(g, bounds, state, step, 0.0, barrier, rows)

        dv = -(gradient + barrier * by_walls + by_missing)
        added = banded.solve_regularised(functions.matrix, regularised, factor, dv)
        regularised = added if added > 0.0 else regularised / 3.0
        slope = float(gradient @ dv)
        if not math.isfinite(slope):
            return Ended(v, False, iteration, "no direction to go")
        of_walls, share, share_dual = slacks.steps(
            g, functions.along(dv), bounds, state, barrier, max(BOUNDARY, 1 - barrier), step
        )
        slope += of_walls
        merit = cost + walls
        for _ in range(HALVINGS):
            there = v + share * dv
            cost_there = functions.values(there)
            infeasible_there, walls = slacks.standing(g, bounds, state, step, share, barrier, rows)
            merit_there = cost_there + walls
            verdict = _judge(infeasible, merit, infeasible_there, merit_there, share * slope, most_infeasible, filtered)
            if verdict:
                break
            share /= 2
        else:
            functions.values(v)
            return Ended(v, False, iteration, "no step makes it better")
        if verdict == "widens":
            filtered.append(((1 - FILTER) * infeasible, merit - FILTER * infeasible))
        v, cost, infeasible = there, cost_there, infeasible_there
        errors = slacks.advance(g, bounds, state, step, share, share_dual, barrier, pulls)
        if search.left_by_step is not None and share == share_dual == 1.0 and barrier <= search.last_barrier:
            left = search.left_by_step * off_gradient
            if _error(errors, left, search) <= BARRIER_SOLVED * barrier:
                return Ended(v, True, iteration + 1, f"solved in {iteration + 1} iterations")
    return Ended(v, False, search.iterations, f"not solved in {search.iterations} iterations")


def _error(errors: tuple[float, float], off_gradient: float, search: Search) -> float:
    """How far this is from the barrier's solution, in units of the barrier."""
    off_constraints, off_complementary = errors
    return max(
        off_constraints / search.feasibility * search.last_barrier,
        off_gradient / search.gradient * search.last_barrier,
        off_complementary,
    )


def _judge(
    infeasible: float, merit: float, infeasible_there: float, merit_there: float, slope: float,
    most_infeasible: float, filtered: list[tuple[float, float]],
) -> str:  # fmt: skip
    """Whether a step is taken: "descends" by the merit, "widens" the filter, or "" where it is refused."""
    if not (math.isfinite(merit_there) and infeasible_there < most_infeasible):
        return ""
    if any(infeasible_there >= i and merit_there >= m for i, m in filtered):
        return ""
    slack = 1e-12 * abs(merit)  # of rounding
    if slope < 0 and (-slope) ** SWITCH_COST > infeasible**SWITCH_FEASIBILITY and infeasible <= 1e-4 * most_infeasible:
        return "descends" if merit_there <= merit + ARMIJO * slope + slack else ""
    better = infeasible_there <= (1 - FILTER) * infeasible or merit_there <= merit - FILTER * infeasible + slack
    return "widens" if better else ""
