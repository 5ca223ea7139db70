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

from cfplan.expert import banded, slacks

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
REGULARISED = 1e-4
# added to the diagonal where it must, at first
REGULARISED_MOST = 1e14


class Functions(Protocol):
    """f and g of a problem, with the arrays in which numbers go to and fro."""

    bounds: NDArray
    # (5, m) of the constraints, see slacks
    rows: int
    # g begins with so many rows of as many constraints each
    g: NDArray
    # (m,) by values()
    multipliers: NDArray
    # (m,) y, for expand()
    stiffness: NDArray
    # (m,) Σ, for expand()
    gradient: NDArray
    # (size,) of f, by expand()
    matrix: NDArray
    # (size, band + 1) the Hessian of f + y·g, plus J'ΣJ, see banded; by expand()

    def values(self, v: NDArray) -> float:
        """f; and g."""

    def expand(self) -> None:
        """Gradient and matrix, around the last v."""

    def transposed(self, w: NDArray) -> NDArray:
        """(size,) J'w, J of the last expand()."""

    def along(self, dv: NDArray) -> NDArray:
        """(m,) J dv, likewise. Overwritten by the next call."""


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
    g, multipliers, stiffness = functions.g, functions.multipliers, functions.stiffness
    state, step = np.empty((3, len(g))), np.zeros((3, len(g)))
    force, pull, factor = np.empty(len(g)), np.empty(len(g)), np.empty_like(functions.matrix)
    cost = functions.values(v)
    slacks.first(g, bounds, barrier, search.push, state, multipliers, stiffness)
    infeasible, walls = slacks.standing(g, bounds, state, step, 0.0, barrier, rows)
    most_infeasible, regularised = 1e4 * max(1.0, infeasible), 0.0
    filtered: list[tuple[float, float]] = []
    for iteration in range(search.iterations):
        functions.expand()
        off_gradient = float(np.abs(functions.gradient + functions.transposed(multipliers)).max())
        if not math.isfinite(infeasible + off_gradient + cost):
            return Ended(v, False, iteration, "met what is not a number")
        lowered = False
        while True:
            if _error(g, bounds, state, barrier, off_gradient, search) > BARRIER_SOLVED * barrier:
                break
            if barrier <= search.last_barrier:
                return Ended(v, True, iteration, f"solved in {iteration} iterations")
            barrier = max(search.last_barrier, min(BARRIER_FACTOR * barrier, barrier**BARRIER_POWER))
            lowered = True
        if lowered:
            filtered.clear()
            infeasible, walls = slacks.standing(g, bounds, state, step, 0.0, barrier, rows)

        slacks.forces(g, bounds, state, stiffness, barrier, force, pull)
        dv = -functions.gradient - functions.transposed(pull)
        added = _factorise(functions.matrix, regularised, factor)
        if added > REGULARISED_MOST:
            return Ended(v, False, iteration, "no direction to go")
        regularised = added if added > 0.0 else regularised / 3.0
        banded.solve(factor, dv)
        slope = float(functions.gradient @ dv)
        if not math.isfinite(slope):
            return Ended(v, False, iteration, "no direction to go")
        of_walls, share, share_dual = slacks.steps(
            g, functions.along(dv), bounds, state, force, barrier, max(BOUNDARY, 1 - barrier), step
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
        slacks.advance(bounds, state, step, share, share_dual, barrier, multipliers, stiffness)
        if search.left_by_step is not None and share == share_dual == 1.0 and barrier <= search.last_barrier:
            left = search.left_by_step * off_gradient
            if _error(g, bounds, state, barrier, left, search) <= BARRIER_SOLVED * barrier:
                return Ended(v, True, iteration + 1, f"solved in {iteration + 1} iterations")
    return Ended(v, False, search.iterations, f"not solved in {search.iterations} iterations")


def _error(g: NDArray, bounds: NDArray, state: NDArray, barrier: float, off_gradient: float, search: Search) -> float:
    """How far this is from the barrier's solution, in units of the barrier."""
    off_constraints, off_complementary = slacks.errors(g, bounds, state, barrier)
    return float(
        max(
            off_constraints / search.feasibility * search.last_barrier,
            off_gradient / search.gradient * search.last_barrier,
            off_complementary,
        )
    )


def _factorise(matrix: NDArray, regularised: float, factor: NDArray) -> float:
    """What had to be added to the diagonal, more than REGULARISED_MOST where nothing helps."""
    added = 0.0
    while added <= REGULARISED_MOST and not banded.factorise(matrix, added, factor):
        added = 8.0 * added or max(REGULARISED, regularised / 3.0)
    return added


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
