"""The speed-profile problem as a nonlinear program of its free spline coefficients.

Coefficients lie in a table: N+3 of h in its first column and, where yaw is free, N+2 of yaw in its second. Read row by
row it is the vector v of variables, in which an interval's coefficients lie side by side. A boundary state fixes three
coefficients of h and two of yaw; at a rest the first four of h have one value, so that h is constant in that interval,
and the first two of yaw.

Constraints are the kernel's rows at all points, followed by those that are linear in the coefficients: the speed limit,
positive coefficients of h, and the initial yaw.
"""

import math
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.machine_code import njit
from cfplan.planners.expert import point_constraints
from cfplan.planners.expert.kernel import Kernels
from cfplan.planners.expert.problem import Layout, Problem
from cfplan.planners.expert.tuning import TUNING
from cfplan.planners.solver.barrier import bounds_of
from cfplan.planners.solver.interior_point import Linearisation, Values
from cfplan.vehicle import yaw_spline
from cfplan.vehicle.profile_spline import weights_at

OBJECTIVE_SCALE = 1000.0  # factor on the cost in seconds, so that multipliers are about 1
# Gauss-Legendre places and weights on [0, 1], for the time spent in an interval.
_PLACES = 0.5 + np.array([-0.5, 0.0, 0.5]) * np.sqrt(0.6)
_WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18.0
_AT_PLACES = np.stack(weights_at(_PLACES), axis=-1)
_FIXED = -1
_FREELY = {"contract", "reassoc", "nsz"}  # freedom in the order of sums that lets NaN survive


class Sparsity(NamedTuple):
    """The relations between v, the intervals and the points, for compiled loops.

    Points, and linear rows, lie in runs over consecutive intervals. (R, 3): the first point of each run, its interval,
    and the length. So loops pass through memory in order and can be vectorised, if indices are unsigned: compiled code
    checks the sign of an index.
    """

    runs: NDArray  # of the P points
    slots: NDArray  # (k, N) entry of v of each of an interval's coefficients, -1 where it is fixed
    entries: NDArray  # (2, k(k+1)/2, N) of the flattened matrix for each pair, -1 if fixed, and how often it counts
    linear: NDArray  # (4, E) weights of four of an interval's coefficients in each linear row
    linear_runs: NDArray  # of the E rows
    of_yaw: int  # number of linear rows, the last ones, that weigh yaw's coefficients instead of those of h


@dataclass(frozen=True, slots=True, eq=False)
class Variables:
    """Which coefficients are variables."""

    slots: NDArray  # (N+3, 1 or 2) entry of v of each coefficient, -1 where it is fixed
    local: NDArray  # (k, N) where an interval's coefficients lie in the flattened table
    positive: int  # how many coefficients of h have an entry of v of their own
    size: int  # of v
    band: int  # largest distance between two coupled coefficients
    sparsity: Sparsity


@lru_cache(maxsize=128)
def variables_of(layout: Layout, held: bool, rests: tuple[bool, bool]) -> Variables:
    """Return the variables, where the start is held by a boundary state or not, and each end at rest or not."""
    nodes, free_yaw = layout.shape.nodes, layout.shape.free_yaw
    table, own = _slots(nodes, 2 if free_yaw else 1, held, rests)
    k = point_constraints.variables(free_yaw)
    local = (
        np.array([0, 1, 2, 3, 0, 1, 2][:k])[:, None] + np.arange(nodes),
        np.array([0, 0, 0, 0, 1, 1, 1][:k])[:, None],
    )
    slots = table[local]
    free = np.where(slots >= 0, slots, slots.max(axis=0))
    band = int((free.max(axis=0) - free.min(axis=0)).max())
    right, left = np.array([(a, b) for b in range(k) for a in range(b, k)]).T
    low, high = np.minimum(slots[left], slots[right]), np.maximum(slots[left], slots[right])
    entry = np.where(low >= 0, high * (band + 1) + high - low, _FIXED)
    entries = np.stack([entry, np.where((low == high) & (left != right)[:, None], 2, 1)])
    positive = np.flatnonzero(own[:, 0])
    sparsity = Sparsity(_runs(layout.interval), slots, entries, *_linear_rows(layout, positive))
    return Variables(table, local[0] * table.shape[1] + local[1], len(positive), table.size, band, sparsity)


def _slots(nodes: int, columns: int, held: bool, rests: tuple[bool, bool]) -> tuple[NDArray, NDArray]:
    """Return the entry of v of each coefficient, -1 where it is fixed; and which have an entry of their own."""
    own = np.arange((nodes + 3) * columns).reshape(nodes + 3, columns)
    slots = own.copy()
    for end, (h, yaw) in enumerate((
        ([0, 1, 2, 3], [0, 1]), ([nodes + 2, nodes + 1, nodes, nodes - 1], [nodes + 1, nodes])
    )):  # fmt: skip
        if held and end == 0:
            slots[h[:3], 0] = _FIXED
            if columns == 2:
                slots[yaw, 1] = _FIXED
        elif rests[end]:
            slots[h, 0] = slots[h[3], 0]
            if columns == 2:
                slots[yaw, 1] = slots[yaw[1], 1]
    if columns == 2:
        slots[-1, 1] = _FIXED  # yaw has a coefficient less
    return slots, slots == own


def _linear_rows(layout: Layout, positive: NDArray) -> tuple[NDArray, NDArray, int]:
    """Return (weights (4, E), runs, how many of yaw): h where the speed limit holds, its coefficients, yaw's start."""
    of_positive = np.clip(positive - 1, 0, layout.shape.nodes - 1)
    weights = [np.stack(weights_at(layout.speed_place)), np.eye(4)[positive - of_positive].T]
    interval = [layout.speed_interval, of_positive]
    if layout.shape.free_yaw:
        weights.append(np.append(0.0, yaw_spline.AT_NODE[0])[:, None])
        interval.append(np.zeros(1, dtype=int))
    linear = np.ascontiguousarray(np.concatenate(weights, axis=1))
    return linear, _runs(np.concatenate(interval)), int(layout.shape.free_yaw)


def _runs(interval: NDArray) -> NDArray:
    """Return the runs, (R, 3), in which these intervals follow one another."""
    first = np.flatnonzero(np.diff(interval, prepend=-2) != 1)
    return np.stack([first, interval[first], np.diff(first, append=len(interval))], axis=1).astype(np.uint64)


class SplineProgram:
    """f and g as functions of v (interior_point.NonlinearProgram), and conversions between coefficients and v."""

    def __init__(self, problem: Problem) -> None:
        """Fix the coefficients that boundary states decide at their values in the problem's table."""
        self._variables = it = variables_of(problem.layout, problem.ends.held, problem.rests)
        self._fixed = problem.coefficients
        self._fixed_local = problem.coefficients.ravel()[it.local]
        self._linear = it.sparsity.linear.shape[1]
        self._kernels = Kernels(
            problem.layout.shape.free_yaw, problem.point_data, problem.common, OBJECTIVE_SCALE * problem.penalties,
            self._linear,
        )  # fmt: skip
        self._local = np.empty(it.local.shape)  # within one call of evaluate() or linearise()
        self._scale = OBJECTIVE_SCALE * math.sqrt(problem.step**2 / problem.unit)  # of time in node units
        self.rows = point_constraints.ROWS
        self.bounds = self._bounds(problem)

    def _bounds(self, problem: Problem) -> NDArray:
        """Return the bounds of all constraints, with those of the linear ones behind those at points."""
        positive, of_yaw = self._variables.positive, self._variables.sparsity.of_yaw
        yaw = [(-np.inf, np.inf) if problem.ends.start else problem.first_yaw] * of_yaw
        least, most = np.reshape(yaw, (of_yaw, 2)).T
        open_below, floor = np.full(len(problem.highest), -np.inf), np.full(positive, TUNING.floor)
        lower = np.concatenate([problem.lower.ravel(), open_below, floor, least])
        upper = np.concatenate([problem.upper.ravel(), problem.highest, np.full(positive, np.inf), most])
        return bounds_of(lower, upper)

    def v_of(self, coefficients: NDArray) -> NDArray:
        """Return the variables of a table; the smallest counts if several share one value."""
        slots = self._variables.slots
        v = np.full(self._variables.size, np.inf)
        np.minimum.at(v, slots[slots >= 0], coefficients[slots >= 0])
        return np.where(np.isfinite(v), v, 0.0)

    def coefficients_of(self, v: NDArray) -> NDArray:
        """Return the table, (N+3, 1 or 2)."""
        slots = self._variables.slots
        return np.where(slots >= 0, v[slots], self._fixed)

    def rows_of(self, constraints: NDArray) -> NDArray:
        """Return the (ROWS, P) rows at points of constraints, (m,)."""
        return constraints[: -self._linear].reshape(self.rows, -1)

    def evaluate(self, v: NDArray) -> Values:
        """Return f and g at v."""
        self._go_to(v)
        constraints, penalty = self._kernels.evaluate()
        return Values(_complete(constraints, penalty, self._local, self._variables.sparsity, self._scale), constraints)

    def linearise(self, v: NDArray, terms: NDArray) -> Linearisation:
        """Return the derivatives at v, where the constraints have these barrier.TERMS; jvp holds until the next."""
        it, kernels = self._variables, self._kernels
        self._go_to(v)
        jacobian = kernels.differentiate(terms)
        gradients, matrix = np.zeros((len(terms), it.size)), np.zeros((it.size, it.band + 1))
        _assemble(kernels.work, it.sparsity, terms, self._local, self._scale, gradients, matrix)
        return Linearisation(gradients, matrix, partial(_jvp, jacobian, it.sparsity))

    def _go_to(self, v: NDArray) -> None:
        """Pass the coefficients at v to the kernels."""
        it = self._variables.sparsity
        _gather(v, it.slots, it.runs, self._fixed_local, self._local, self._kernels.coefficients)


@register_jitable
def _spread(v, slots, fixed, local):
    """Fill in each interval's coefficients, (k, N)."""
    for a in range(slots.shape[0]):
        for i in range(slots.shape[1]):
            local[a, i] = v[slots[a, i]] if slots[a, i] >= 0 else fixed[a, i]


@register_jitable(fastmath=_FREELY)
def _weigh(sparsity, local, result):
    """Fill in the constraints that are linear in the coefficients, (k, N), of each interval."""
    linear, of_h = sparsity.linear, len(result) - sparsity.of_yaw
    runs = sparsity.linear_runs
    for r in range(len(runs)):
        row, interval, count = runs[r, 0], runs[r, 1], runs[r, 2]
        first = 0 if row < of_h else len(local) - 4
        for n in range(count):
            j, i = row + n, interval + n
            value = linear[0, j] * local[first, i] + linear[1, j] * local[first + 1, i]
            result[j] = value + linear[2, j] * local[first + 2, i] + linear[3, j] * local[first + 3, i]


@njit(error_model="numpy")
def _gather(v, slots, runs, fixed, local, at_points):
    """Fill in the coefficients of each interval, (k, N), and of each point, (k, P)."""
    _spread(v, slots, fixed, local)
    for r in range(len(runs)):
        point, interval, count = runs[r, 0], runs[r, 1], runs[r, 2]
        for a in range(len(local)):
            to, of = at_points[a], local[a]
            for n in range(count):
                to[point + n] = of[interval + n]


@njit(error_model="numpy", fastmath=_FREELY)
def _complete(constraints, penalty, local, sparsity, scale):
    """Fill in the linear constraints, which the kernels left open, and return the cost: penalties and time.

    The time in node units is Σ ∫ds/√x over all intervals.
    """
    _weigh(sparsity, local, constraints[len(constraints) - sparsity.linear.shape[1] :])
    time, total = 0.0, 0.0
    for q in range(len(_WEIGHTS)):
        for i in range(local.shape[1]):
            time += _WEIGHTS[q] / math.sqrt(_x_at(_AT_PLACES[q], local, i))
    for p in range(len(penalty)):
        total += penalty[p]
    return scale * time + total


@register_jitable(forceinline=True, fastmath=_FREELY)
def _x_at(weights, local, i):
    """Return x in interval i, from these four weights of its coefficients, (k, N)."""
    x = weights[0] * local[0, i] + weights[1] * local[1, i] + weights[2] * local[2, i]
    return max(x + weights[3] * local[3, i], point_constraints.LEAST)


@register_jitable(fastmath=_FREELY)
def _sum_by_interval(at_points, runs, count):
    result = np.zeros((len(at_points), count))
    for r in range(len(runs)):
        point, interval, length = runs[r, 0], runs[r, 1], runs[r, 2]
        for a in range(len(at_points)):
            row, summed = at_points[a], result[a]
            for n in range(length):
                summed[interval + n] += row[point + n]
    return result


@register_jitable
def _entry(column, row, size):
    """Return where a lower triangle has this entry; it lies column by column."""
    return column * size - column * (column - 1) // 2 + row - column


@register_jitable(fastmath=_FREELY)
def _add_linear(sparsity, terms, k, gradients, hessian):
    """Add the linear constraints to the gradients and the Hessian of each interval."""
    linear, rows = sparsity.linear, sparsity.linear.shape[1]
    of_rows = terms[:, terms.shape[1] - rows :]
    runs = sparsity.linear_runs
    for r in range(len(runs)):
        begin, interval, count = runs[r, 0], runs[r, 1], runs[r, 2]
        first = 0 if begin < rows - sparsity.of_yaw else k - 4
        for b in range(4):
            for kind in range(1, len(terms)):
                row = gradients[kind * k + first + b]
                for n in range(count):
                    row[interval + n] += of_rows[kind, begin + n] * linear[b, begin + n]
            for a in range(b, 4):
                row = hessian[_entry(first + b, first + a, k)]
                for n in range(count):
                    both = linear[b, begin + n] * linear[a, begin + n]
                    row[interval + n] += of_rows[0, begin + n] * both


@register_jitable(fastmath=_FREELY)
def _add_time(local, scale, gradients, hessian):
    """Add the time spent in each interval."""
    k, count = local.shape
    slope, bend = np.empty(count), np.empty(count)  # derivatives of the time by x
    for q in range(len(_WEIGHTS)):
        weight = _AT_PLACES[q]
        for i in range(count):
            x = _x_at(weight, local, i)
            slope[i] = -0.5 * scale * _WEIGHTS[q] / (x * math.sqrt(x))
            bend[i] = -1.5 * slope[i] / x
        for b in range(4):
            for i in range(count):
                gradients[b, i] += slope[i] * weight[b]
            for a in range(b, 4):
                both, row = weight[b] * weight[a], hessian[_entry(b, a, k)]
                for i in range(count):
                    row[i] += bend[i] * both


@njit(error_model="numpy", fastmath=_FREELY)
def _assemble(at_points, sparsity, terms, local, scale, gradients, matrix):
    """Add up gradients and matrix, zero at first, from the kernel's at points, the linear constraints and the time."""
    slots, entries, kinds = sparsity.slots, sparsity.entries, len(terms)
    k, count = local.shape
    of_gradients = _sum_by_interval(at_points[: kinds * k], sparsity.runs, count)
    of_hessian = _sum_by_interval(at_points[kinds * k :], sparsity.runs, count)
    _add_linear(sparsity, terms, k, of_gradients, of_hessian)
    _add_time(local, scale, of_gradients, of_hessian)
    flat = matrix.ravel()
    for a in range(k):
        for i in range(count):
            if slots[a, i] >= 0:
                for kind in range(kinds):
                    gradients[kind, slots[a, i]] += of_gradients[kind * k + a, i]
    for e in range(entries.shape[1]):
        for i in range(count):
            if entries[0, e, i] >= 0:
                flat[entries[0, e, i]] += entries[1, e, i] * of_hessian[e, i]


@njit(error_model="numpy", fastmath=_FREELY)
def _jvp(jacobian, sparsity, dv):
    """Return J dv, (m,); `jacobian` is the kernel's at points."""
    k, points = len(sparsity.slots), jacobian.shape[1]
    rows = jacobian.shape[0] // k
    local, of_point = np.zeros(sparsity.slots.shape), np.empty(points)
    _spread(dv, sparsity.slots, local, local)
    result = np.zeros(rows * points + sparsity.linear.shape[1])
    for a in range(k):
        row = local[a]
        for r in range(len(sparsity.runs)):
            point, interval, count = sparsity.runs[r, 0], sparsity.runs[r, 1], sparsity.runs[r, 2]
            for n in range(count):
                of_point[point + n] = row[interval + n]
        for r in range(rows):
            for p in range(points):
                result[r * points + p] += jacobian[a * rows + r, p] * of_point[p]
    _weigh(sparsity, local, result[rows * points :])
    return result
