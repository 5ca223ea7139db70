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
from numba import njit
from numpy.typing import NDArray

BOUNDARY = 0.99
# of the way to a bound that a step may go, at least
BARRIER_FACTOR, BARRIER_POWER = 0.2, 1.5
# how fast the barrier parameter falls
BARRIER_SOLVED = 10.0
# times the barrier parameter: the error at which it falls
COMPLEMENTARY = 1e10
# how far a multiplier may be from what the barrier makes of its slack, as a factor
FILTER = 1e-5
# share of the infeasibility by which a step must better it, or the cost
SWITCH_COST, SWITCH_FEASIBILITY = 2.3, 1.1
ARMIJO = 1e-4
HALVINGS = 14
LEAST_ROOM = 1e-6
# of the span between bounds: what starts nearer to a bound, or beyond, is moved inside
REGULARISED = 1e-4
# added to the diagonal where it must, at first
REGULARISED_MOST = 1e14


@dataclass(frozen=True, slots=True)
class Rows:
    """Constraints by interval, and the coefficients that they, and the cost of that interval, are made of."""

    slots: NDArray
    # (N, k) entry of v of each of an interval's coefficients, -1 where that one is fixed
    interval: NDArray
    # (m,) of each constraint, ascending
    lower: NDArray
    # (m,) -inf where there is none
    upper: NDArray
    # (m,)


class Expansion(NamedTuple):
    """A problem around a point, interval by interval."""

    g: NDArray
    # (m,)
    jacobian: NDArray
    # (m, k)
    gradient: NDArray
    # (N, k) of f
    hessian: NDArray
    # (N, k, k) of f + y·g plus J'ΣJ, Σ the diagonal of the stiffness; lower triangle


class Functions(Protocol):
    """f and g of a problem."""

    def values(self, v: NDArray) -> tuple[float, NDArray]:
        """f, and g (m,)."""

    def expand(self, v: NDArray, y: NDArray, stiffness: NDArray) -> Expansion:
        """Around v, with multipliers y (m,) and the stiffness of the slacks (m,)."""


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
    push: float = 1e-2
    # how far slacks start inside their bounds, of the span between them
    iterations: int = 100


class Ended(NamedTuple):
    """Where the search ended."""

    v: NDArray
    g: NDArray
    solved: bool
    iterations: int
    words: str


class _Slacks(NamedTuple):
    """Slacks of the constraints and the multipliers of their bounds, (m,) each; multipliers are 0 where no bound is."""

    s: NDArray
    low: NDArray
    high: NDArray


def minimise(functions: Functions, rows: Rows, v: NDArray, search: Search) -> Ended:
    """Search from v, where the functions must be defined."""
    barrier = search.barrier
    cost, g = functions.values(v)
    slacks = _first_slacks(g, rows, barrier, search.push)
    regularised, band = 0.0, _band(rows.slots)
    filtered: list[tuple[float, float]] = []
    most_infeasible = 1e4 * max(1.0, float(np.abs(g - slacks.s).sum()))
    stiffness = _stiffness(rows.lower, rows.upper, slacks)
    for iteration in range(search.iterations):
        at = functions.expand(v, slacks.high - slacks.low, stiffness)
        infeasible, off_gradient, off_complementary = _errors(
            rows.slots, rows.interval, rows.lower, rows.upper, at.g, at.jacobian, at.gradient, slacks, barrier, len(v)
        )
        if not math.isfinite(infeasible + off_gradient + cost):
            return Ended(v, at.g, False, iteration, "met what is not a number")
        while True:
            error = max(
                infeasible / search.feasibility * search.last_barrier,
                off_gradient / search.gradient * search.last_barrier,
                off_complementary,
            )
            if error > BARRIER_SOLVED * barrier:
                break
            if barrier <= search.last_barrier:
                return Ended(v, at.g, True, iteration, f"solved in {iteration} iterations")
            barrier = max(search.last_barrier, min(BARRIER_FACTOR * barrier, barrier**BARRIER_POWER))
            off_complementary = _complementarity(rows.lower, rows.upper, slacks, barrier)
            filtered.clear()

        direction = _direction(
            band, rows.slots, rows.interval, rows.lower, rows.upper, at, stiffness, slacks, barrier, regularised,
            len(v), max(BOUNDARY, 1 - barrier),
        )  # fmt: skip
        dv, step, slope, regularised, share, dual_share, infeasible, walls = direction
        if not math.isfinite(slope):
            return Ended(v, at.g, False, iteration, "no direction to go")
        merit = cost + walls
        for _ in range(HALVINGS):
            there, s = v + share * dv, slacks.s + share * step.s
            cost_there, g_there = functions.values(there)
            infeasible_there, walls = _standing(rows.lower, rows.upper, g_there, s, barrier)
            merit_there = cost_there + walls
            verdict = _judge(infeasible, merit, infeasible_there, merit_there, share * slope, most_infeasible, filtered)
            if verdict:
                break
            share /= 2
        else:
            return Ended(v, at.g, False, iteration, "no step makes it better")
        if verdict == "widens":
            filtered.append(((1 - FILTER) * infeasible, merit - FILTER * infeasible))
        v, cost = there, cost_there
        slacks, stiffness = _stepped(rows.lower, rows.upper, slacks, step, share, dual_share, barrier)
    return Ended(v, at.g, False, search.iterations, f"not solved in {search.iterations} iterations")


def _band(slots: NDArray) -> int:
    """How far apart two coefficients that meet can be."""
    free = np.where(slots >= 0, slots, slots.max(axis=1, keepdims=True))
    return int((slots.max(axis=1) - free.min(axis=1)).max())


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


def _first_slacks(g: NDArray, rows: Rows, barrier: float, push: float) -> _Slacks:
    return _Slacks(*_first(g, rows.lower, rows.upper, barrier, push))


@njit(cache=True, error_model="numpy")
def _first(g, lower, upper, barrier, push):
    s, low, high = g.copy(), np.zeros(len(g)), np.zeros(len(g))
    for j in range(len(g)):
        span = min(upper[j] - lower[j], 2.0)
        if g[j] - lower[j] < LEAST_ROOM * span:
            s[j] = lower[j] + push * span
        if upper[j] - g[j] < LEAST_ROOM * span:
            s[j] = upper[j] - push * span
        if lower[j] > -np.inf:
            low[j] = barrier / (s[j] - lower[j])
        if upper[j] < np.inf:
            high[j] = barrier / (upper[j] - s[j])
    return s, low, high


@njit(cache=True, error_model="numpy")
def _errors(slots, interval, lower, upper, g, jacobian, gradient, slacks, barrier, size):
    """The largest |g - s|, entry of the Lagrangian's gradient, and difference of a slack's product from the barrier."""
    local, infeasible = gradient.copy(), 0.0
    for j in range(len(g)):
        infeasible = max(infeasible, abs(g[j] - slacks.s[j]))
        y, i = slacks.high[j] - slacks.low[j], interval[j]
        for a in range(slots.shape[1]):
            local[i, a] += y * jacobian[j, a]
    of_v = np.zeros(size)
    for i in range(slots.shape[0]):
        for a in range(slots.shape[1]):
            if slots[i, a] >= 0:
                of_v[slots[i, a]] += local[i, a]
    return infeasible, np.abs(of_v).max(), _complementarity(lower, upper, slacks, barrier)


@njit(cache=True, error_model="numpy")
def _complementarity(lower, upper, slacks, barrier):
    worst = 0.0
    for j in range(len(lower)):
        if lower[j] > -np.inf:
            worst = max(worst, abs(slacks.low[j] * (slacks.s[j] - lower[j]) - barrier))
        if upper[j] < np.inf:
            worst = max(worst, abs(slacks.high[j] * (upper[j] - slacks.s[j]) - barrier))
    return worst


@njit(cache=True, error_model="numpy")
def _stiffness(lower, upper, slacks):
    stiffness = np.zeros(len(lower))
    for j in range(len(lower)):
        if lower[j] > -np.inf:
            stiffness[j] += slacks.low[j] / (slacks.s[j] - lower[j])
        if upper[j] < np.inf:
            stiffness[j] += slacks.high[j] / (upper[j] - slacks.s[j])
    return stiffness


@njit(cache=True, error_model="numpy")
def _newton(band, slots, interval, lower, upper, at, stiffness, slacks, barrier, regularised, size):
    """(dv, steps of slacks and multipliers, slope of the merit along them, what was added to the diagonal)."""
    count, k = slots.shape
    rows = len(interval)
    force, gradient = np.zeros(rows), at.gradient.copy()
    for j in range(rows):
        if lower[j] > -np.inf:
            force[j] -= barrier / (slacks.s[j] - lower[j])
        if upper[j] < np.inf:
            force[j] += barrier / (upper[j] - slacks.s[j])
        pull = force[j] + stiffness[j] * (at.g[j] - slacks.s[j])
        for a in range(k):
            gradient[interval[j], a] += pull * at.jacobian[j, a]
    matrix, right = np.zeros((size, band + 1)), np.zeros(size)  # matrix[r, d] is the entry (r, r - d)
    for i in range(count):
        for a in range(k):
            r = slots[i, a]
            if r < 0:
                continue
            right[r] -= gradient[i, a]
            for b in range(a + 1):
                c = slots[i, b]
                if c >= 0:
                    matrix[max(r, c), abs(r - c)] += at.hessian[i, a, b] * (2.0 if r == c and a != b else 1.0)

    added = 0.0
    factor = matrix.copy()
    while not _factorise(factor, added):
        if added == 0.0:
            added = max(REGULARISED, regularised / 3.0)
        else:
            added *= 8.0
        if added > REGULARISED_MOST:
            right[:] = np.nan
            break
        factor[:] = matrix
    dv = _solve(factor, right)
    slope, local = 0.0, np.zeros((count, k))  # dv, interval by interval
    for i in range(count):
        for a in range(k):
            if slots[i, a] >= 0:
                local[i, a] = dv[slots[i, a]]
                slope += at.gradient[i, a] * local[i, a]
    ds, dlow, dhigh = at.g - slacks.s, np.zeros(rows), np.zeros(rows)
    for j in range(rows):
        for a in range(k):
            ds[j] += at.jacobian[j, a] * local[interval[j], a]
        slope += force[j] * ds[j]
        if lower[j] > -np.inf:
            dlow[j] = (barrier - slacks.low[j] * ds[j]) / (slacks.s[j] - lower[j]) - slacks.low[j]
        if upper[j] < np.inf:
            dhigh[j] = (barrier + slacks.high[j] * ds[j]) / (upper[j] - slacks.s[j]) - slacks.high[j]
    return dv, _Slacks(ds, dlow, dhigh), slope, added if added > 0.0 else regularised / 3.0


@njit(cache=True, error_model="numpy")
def _factorise(matrix, added):
    """The banded Cholesky factor, in place, of the matrix plus `added` on its diagonal; False where there is none.

    A slot that nothing touches counts as 1.
    """
    size, width = matrix.shape
    for r in range(size):
        reach = min(width - 1, r)
        for d in range(reach, -1, -1):
            value, row, column = matrix[r, d], matrix[r], matrix[r - d]
            for e in range(d + 1, reach + 1):  # the columns to the left that both rows reach
                value -= row[e] * column[e - d]
            if d > 0:
                matrix[r, d] = value * matrix[r - d, 0]
            else:
                if row[0] == 0.0 and value == 0.0:
                    value = 1.0
                value += added
                if not value > 1e-12:
                    return False
                matrix[r, 0] = 1.0 / math.sqrt(value)  # the diagonal is kept inverted: dividing takes long
    return True


@njit(cache=True, error_model="numpy")
def _solve(factor, right):
    size, width = factor.shape
    x = right.copy()
    for r in range(size):
        for d in range(1, min(width - 1, r) + 1):
            x[r] -= factor[r, d] * x[r - d]
        x[r] *= factor[r, 0]
    for r in range(size - 1, -1, -1):
        x[r] *= factor[r, 0]
        for d in range(1, min(width - 1, r) + 1):
            x[r - d] -= factor[r, d] * x[r]
    return x


@njit(cache=True, error_model="numpy")
def _to_boundary(lower, upper, slacks, step, most):
    """The longest shares of the steps, of slacks and of multipliers, that leave (1 - most) of the room."""
    ds, dlow, dhigh = step.s, step.low, step.high
    share, dual = 1.0, 1.0
    for j in range(len(lower)):
        if lower[j] > -np.inf:
            room = slacks.s[j] - lower[j]
            if -ds[j] * share > most * room:
                share = most * room / -ds[j]
            if -dlow[j] * dual > most * slacks.low[j]:
                dual = most * slacks.low[j] / -dlow[j]
        if upper[j] < np.inf:
            room = upper[j] - slacks.s[j]
            if ds[j] * share > most * room:
                share = most * room / ds[j]
            if -dhigh[j] * dual > most * slacks.high[j]:
                dual = most * slacks.high[j] / -dhigh[j]
    return share, dual


@njit(cache=True, error_model="numpy")
def _barrier(lower, upper, s, barrier):
    total, product = 0.0, 1.0
    for j in range(len(lower)):
        if lower[j] > -np.inf:
            product *= s[j] - lower[j]
        if upper[j] < np.inf:
            product *= upper[j] - s[j]
        if not 1e-100 < product < 1e100:  # a logarithm of many takes less time than many of one
            total += math.log(product)
            product = 1.0
    return -barrier * (total + math.log(product))


@njit(cache=True, error_model="numpy")
def _stepped(lower, upper, slacks, step, share, dual, barrier):
    """Slacks and multipliers after the step, and their stiffness."""
    s = slacks.s + share * step.s
    low, high = slacks.low + dual * step.low, slacks.high + dual * step.high
    for j in range(len(lower)):
        if lower[j] > -np.inf:
            middle = barrier / (s[j] - lower[j])
            low[j] = min(max(low[j], middle / COMPLEMENTARY), middle * COMPLEMENTARY)
        if upper[j] < np.inf:
            middle = barrier / (upper[j] - s[j])
            high[j] = min(max(high[j], middle / COMPLEMENTARY), middle * COMPLEMENTARY)
    after = _Slacks(s, low, high)
    return after, _stiffness(lower, upper, after)


@njit(cache=True, error_model="numpy")
def _standing(lower, upper, g, s, barrier):
    """How infeasible it is, and what the barrier adds to the cost."""
    return np.abs(g - s).sum(), _barrier(lower, upper, s, barrier)


@njit(cache=True, error_model="numpy")
def _direction(band, slots, interval, lower, upper, at, stiffness, slacks, barrier, regularised, size, most):
    """What _newton gives, how far to go along it, and how things stand before."""
    dv, step, slope, regularised = _newton(
        band, slots, interval, lower, upper, at, stiffness, slacks, barrier, regularised, size
    )
    share, dual = _to_boundary(lower, upper, slacks, step, most)
    infeasible, walls = _standing(lower, upper, at.g, slacks.s, barrier)
    return dv, step, slope, regularised, share, dual, infeasible, walls
