"""A primal-dual interior point method for nonlinear programs with a banded Newton matrix.

If variables are spline coefficients there are no equality constraints, and a coefficient is coupled only to neighbours:
the Newton matrix is banded, and factoring it costs less than evaluating the functions. With slacks s for constraints,

    minimise f(v)   subject to   g(v) = s,   lower ≤ s ≤ upper,

the method is that of Wächter and Biegler, "On the implementation of an interior-point filter line-search algorithm for
large-scale nonlinear programming" (2006), without its restoration phase: log barriers, slacks and their multipliers
eliminated from the Newton step, a filter line search, the barrier lowered as its problem is solved. A matrix that is
not positive definite is made so by adding to its diagonal.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from cfplan.deadline import NEVER, Deadline
from cfplan.geometry import banded
from cfplan.machine_code import njit
from cfplan.planners.solver.barrier import (
    Errors,
    SearchDirection,
    accept_step,
    carried_over,
    errors,
    initialise,
    merit_terms,
    search_direction,
)

BOUNDARY = 0.99  # of the way to a bound that a step may go, at least
BARRIER_FACTOR, BARRIER_POWER = 0.2, 1.5  # how fast the barrier parameter falls
BARRIER_SOLVED = 10.0  # times the barrier parameter: the error at which it falls
FILTER = 1e-5  # fraction of the infeasibility by which a step must reduce it, or the cost
SWITCH_COST, SWITCH_FEASIBILITY = 2.3, 1.1
ARMIJO = 1e-4
HALVINGS = 14
OUT_OF_TIME = "out of time"


class Values(NamedTuple):
    """f and g at a point."""

    cost: float
    constraints: NDArray  # (m,)


class Linearisation(NamedTuple):
    """First and second derivatives at a point."""

    gradients: NDArray  # (4, size) of f; and J' times each of barrier.TERMS but the first
    matrix: NDArray  # (size, band + 1) the Hessian of f + y·g, plus J'ΣJ; see banded
    jvp: Callable[[NDArray], NDArray]  # J dv, (m,), of dv, (size,)


class NonlinearProgram(Protocol):
    """f, g and the bounds of g."""

    @property
    def bounds(self) -> NDArray:
        """Return the bounds, (5, m), see barrier."""

    @property
    def rows(self) -> int:
        """Return how many rows g begins with, of as many constraints each."""

    def evaluate(self, v: NDArray) -> Values:
        """Return f and g at v."""

    def linearise(self, v: NDArray, terms: NDArray) -> Linearisation:
        """Return the derivatives at v, where the constraints have these (4, m) barrier.TERMS."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Search:
    """Parameters of a search; the numbers are in the problem's own units."""

    barrier: float = 1.0  # at first
    last_barrier: float = 3e-3
    gradient: float = 1e-2  # of the Lagrangian, at the end
    feasibility: float = 1e-5  # of the constraints, at the end
    predicted_gradient_factor: float | None = None  # of the gradient, left by a full step; None: always computed
    push: float = 1e-2  # how far slacks start inside their bounds at least, of the span between them
    multipliers: float = 1.0  # at first, times those that the barrier prescribes for their slacks
    iterations: int = 100
    least_step: float = 0.0  # fraction of a Newton step; one that must be shorter is the last: there may be no solution


class Multipliers(NamedTuple):
    """Slacks and multipliers at the end of a search, to warm-start another."""

    bounds: NDArray  # (5, m) of that search
    slacks: NDArray  # (3, m) with their multipliers


class SearchResult(NamedTuple):
    """The result of a search."""

    v: NDArray
    values: Values  # there
    multipliers: Multipliers  # there
    solved: bool
    iterations: int
    message: str


@dataclass(frozen=True, slots=True)
class _Filter:
    """The filter: pairs of infeasibility and merit that a step must improve on."""

    most: float  # infeasibility
    pairs: list[tuple[float, float]] = field(default_factory=list)

    def judge(self, before: tuple[float, float], after: tuple[float, float], slope: float) -> str:
        """Return whether a step "descends" by the merit, "widens" the filter, or is refused: "".

        `before` and `after` are pairs of infeasibility and merit.
        """
        (infeasible, merit), (infeasible_after, merit_after) = before, after
        if not (math.isfinite(merit_after) and infeasible_after < self.most):
            return ""
        if any(infeasible_after >= i and merit_after >= m for i, m in self.pairs):
            return ""
        rounding = 1e-12 * abs(merit)
        # Equals (-slope)**SWITCH_COST > infeasible**SWITCH_FEASIBILITY, but a power above 1 of a huge slope overflows.
        steep = -slope > infeasible ** (SWITCH_FEASIBILITY / SWITCH_COST)
        if slope < 0 and steep and infeasible <= 1e-4 * self.most:
            return "descends" if merit_after <= merit + ARMIJO * slope + rounding else ""
        better = infeasible_after <= (1 - FILTER) * infeasible or merit_after <= merit - FILTER * infeasible + rounding
        return "widens" if better else ""


class _Here(NamedTuple):
    """The start and direction of a line search."""

    v: NDArray
    dv: NDArray
    slacks: NDArray
    infeasible: float
    merit: float
    slope: float  # of the merit along dv


class _Step(NamedTuple):
    v: NDArray
    values: Values
    alpha_primal: float  # step length
    infeasible: float
    walls: float  # the barrier's cost
    widens: bool  # the filter


def minimise(
    program: NonlinearProgram, v: NDArray, search: Search, deadline: Deadline = NEVER,
    known: Multipliers | None = None,
) -> SearchResult:  # fmt: skip
    """Search from v, where the functions must be defined, until the deadline.

    With the multipliers `known` from a search of a problem that differs at most in its bounds, it continues that
    search; else it begins with the multipliers that the barrier prescribes.
    """
    barrier, bounds, rows = search.barrier, program.bounds, program.rows
    values = program.evaluate(v)
    slacks, terms = _begun(values.constraints, bounds, search, known)

    def ended(solved: bool, iterations: int, message: str) -> SearchResult:
        return SearchResult(v, values, Multipliers(bounds, slacks), solved, iterations, message)

    off = errors(values.constraints, bounds, slacks, barrier)
    infeasible, walls = merit_terms(values.constraints, bounds, slacks, slacks, 0.0, barrier, rows)
    filtered, regularised = _Filter(1e4 * max(1.0, infeasible)), 0.0
    for iteration in range(search.iterations):
        near = program.linearise(v, terms)
        off_gradient = _largest_gradient(near.gradients)
        if deadline.passed:
            return ended(False, iteration, f"{OUT_OF_TIME} after {iteration} iterations")
        if not math.isfinite(infeasible + off_gradient + values.cost):
            return ended(False, iteration, "a value is not a number")
        before = barrier
        while _error(off, off_gradient, search) <= BARRIER_SOLVED * barrier:
            if barrier <= search.last_barrier:
                return ended(True, iteration, f"solved in {iteration} iterations")
            barrier = max(search.last_barrier, min(BARRIER_FACTOR * barrier, barrier**BARRIER_POWER))
            off = errors(values.constraints, bounds, slacks, barrier)
        if barrier < before:
            filtered.pairs.clear()
            infeasible, walls = merit_terms(values.constraints, bounds, slacks, slacks, 0.0, barrier, rows)

        dv, added, slope = _newton_step(near.matrix, near.gradients, barrier, regularised)
        regularised = added if added > 0.0 else regularised / 3.0
        if not math.isfinite(slope):
            return ended(False, iteration, "no direction of descent")
        dg = near.jvp(dv)
        direction = search_direction(values.constraints, dg, bounds, slacks, barrier, max(BOUNDARY, 1 - barrier))
        del near, dg  # so that the next ones get their memory, which the processor's cache still holds
        here = _Here(v, dv, slacks, infeasible, values.cost + walls, slope + direction.slope)
        step = _line_search(program, here, direction, barrier, filtered)
        if step is None or step.alpha_primal < search.least_step:
            return ended(False, iteration, "no step improves the solution")
        if step.widens:
            filtered.pairs.append(((1 - FILTER) * infeasible, here.merit - FILTER * infeasible))
        v, values, infeasible, walls = step.v, step.values, step.infeasible, step.walls
        slacks, terms, off = accept_step(values.constraints, bounds, slacks, direction, step.alpha_primal, barrier)
        full = step.alpha_primal == direction.alpha_dual == 1.0
        del here, direction
        if search.predicted_gradient_factor is not None and full and barrier <= search.last_barrier:
            left = search.predicted_gradient_factor * off_gradient
            if _error(off, left, search) <= BARRIER_SOLVED * barrier:
                return ended(True, iteration + 1, f"solved in {iteration + 1} iterations")
    return ended(False, search.iterations, f"not solved in {search.iterations} iterations")


def _begun(g: NDArray, bounds: NDArray, search: Search, known: Multipliers | None) -> tuple[NDArray, NDArray]:
    """Return (slacks, terms) where a search begins."""
    if known is None:
        return initialise(g, bounds, search.multipliers * search.barrier, search.push)
    return carried_over(g, known.bounds, known.slacks, bounds)


@njit(error_model="numpy")
def _largest_gradient(gradients):
    """Return the largest entry of the gradient of the Lagrangian; not finite where one is not."""
    largest, total = 0.0, 0.0
    for k in range(gradients.shape[1]):
        value = abs(gradients[0, k] + gradients[1, k])
        largest, total = max(largest, value), total + value
    return largest if math.isfinite(total) else total


@njit(error_model="numpy")
def _newton_step(matrix, gradients, barrier, regularised):
    """Return the step of v, what was added to the diagonal of the matrix, and the slope of f along the step."""
    right = np.empty(gradients.shape[1])
    for k in range(len(right)):
        right[k] = -(gradients[0, k] + barrier * gradients[2, k] + gradients[3, k])
    dv, added = banded.solve_regularised(matrix, right, regularised)
    slope = 0.0
    for k in range(len(dv)):
        slope += gradients[0, k] * dv[k]
    return dv, added, slope


def _line_search(
    program: NonlinearProgram, here: _Here, direction: SearchDirection, barrier: float, filtered: _Filter
) -> _Step | None:
    """Halve the step until the filter takes it; None where it never does."""
    alpha = direction.alpha_primal
    for _ in range(HALVINGS):
        there = here.v + alpha * here.dv
        values = program.evaluate(there)
        infeasible, walls = merit_terms(
            values.constraints, program.bounds, here.slacks, direction.step, alpha, barrier, program.rows
        )
        if verdict := filtered.judge(
            (here.infeasible, here.merit), (infeasible, values.cost + walls), alpha * here.slope
        ):
            return _Step(there, values, alpha, infeasible, walls, verdict == "widens")
        alpha /= 2
    return None


def _error(off: Errors, off_gradient: float, search: Search) -> float:
    """Return the distance from the barrier's solution, in units of the barrier."""
    return max(
        off.infeasibility / search.feasibility * search.last_barrier,
        off_gradient / search.gradient * search.last_barrier,
        off.complementarity,
    )
