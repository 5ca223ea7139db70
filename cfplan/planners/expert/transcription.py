"""The speed-profile problem as a nonlinear program of its free spline coefficients.

Its constraints are the kernel's rows at all points, and then what is linear in the coefficients: h where the speed
limit holds, that coefficients of h are positive, and where yaw starts.
"""

import math
from functools import partial

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.machine_code import njit
from cfplan.planners.expert import point_constraints
from cfplan.planners.expert.kernel import CompiledKernels, Kernels, derivative_rows
from cfplan.planners.expert.layout import variables_of
from cfplan.planners.expert.problem import FLOOR, Problem
from cfplan.planners.solver.barrier import bounds_of
from cfplan.planners.solver.interior_point import Linearisation, Values
from cfplan.vehicle.profile_spline import weights_at

OBJECTIVE_SCALE = 1000.0  # of the cost in seconds, so that multipliers are about 1
# Gauss-Legendre places and weights on [0, 1], for the time spent in an interval.
_PLACES = 0.5 + np.array([-0.5, 0.0, 0.5]) * np.sqrt(0.6)
_WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18.0
_AT_PLACES = np.stack(weights_at(_PLACES), axis=-1)
_FREELY = {"contract", "reassoc", "nsz"}  # freedom in the order of sums that lets NaN survive


class SplineProgram:
    """f and g by v, see interior_point.NonlinearProgram; and the way from tables of coefficients to v and back."""

    def __init__(self, problem: Problem, kernels: type[Kernels] = CompiledKernels) -> None:
        """Fix what a boundary state decides at its value in the problem's table."""
        self._variables = it = variables_of(problem.layout, problem.ends.held, problem.rests)
        self._fixed = problem.coefficients
        self._fixed_local = problem.coefficients.ravel()[it.local]
        self._linear = len(it.sparsity.linear_interval)
        self._kernels = kernels(
            problem.layout.shape.free_yaw, problem.point_data, problem.common, OBJECTIVE_SCALE * problem.penalties,
            self._linear,
        )  # fmt: skip
        # Within one call of evaluate() or linearise():
        self._local = np.empty(it.local.shape)
        self._at_points = np.empty((it.local.shape[1], problem.point_data.shape[1]))
        self._work = np.empty((derivative_rows(it.local.shape[1]), problem.point_data.shape[1]))
        self._scale = OBJECTIVE_SCALE * math.sqrt(problem.step**2 / problem.unit)  # of time in node units
        self.rows = point_constraints.ROWS
        self.bounds = self._bounds(problem)

    def _bounds(self, problem: Problem) -> NDArray:
        it, yaw = self._variables, self._variables.sparsity.of_yaw
        first_yaw = (-np.inf, np.inf) if problem.ends.start else problem.first_yaw
        lower, upper = np.full(self._linear, -np.inf), np.full(self._linear, np.inf)
        speeds = len(problem.highest)
        upper[:speeds] = problem.highest
        lower[speeds : speeds + it.positive] = FLOOR
        if yaw:
            lower[-1], upper[-1] = first_yaw
        return bounds_of(np.append(problem.lower, lower), np.append(problem.upper, upper))

    def v_of(self, coefficients: NDArray) -> NDArray:
        """Return the variables of a table; the smallest counts where several have one value."""
        return _smallest(coefficients, self._variables.slots, self._variables.size)

    def coefficients_of(self, v: NDArray) -> NDArray:
        """Return the table, (N+3, 1 or 2)."""
        slots = self._variables.slots
        return np.where(slots >= 0, v[slots], self._fixed)

    def rows_of(self, constraints: NDArray) -> NDArray:
        """Return the (ROWS, P) rows at points of constraints, (m,)."""
        return constraints[: -self._linear].reshape(self.rows, -1)

    def evaluate(self, v: NDArray) -> Values:
        """Return f and g at v."""
        it = self._variables.sparsity
        _gather(v, it.slots, it.interval, self._fixed_local, self._local, self._at_points)
        constraints, penalty = self._kernels.evaluate(self._at_points)
        return Values(_complete(constraints, penalty, self._local, it, self._scale), constraints)

    def linearise(self, v: NDArray, terms: NDArray) -> Linearisation:
        """Return the derivatives at v, where the constraints have these barrier.TERMS."""
        it = self._variables
        slots, interval = it.sparsity.slots, it.sparsity.interval
        _gather(v, slots, interval, self._fixed_local, self._local, self._at_points)
        jacobian = self._kernels.differentiate(self._at_points, terms, self._work)
        gradients, matrix = np.zeros((len(terms), it.size)), np.zeros((it.size, it.band + 1))
        _assemble(self._work, it.sparsity, terms, self._local, self._scale, gradients, matrix)
        return Linearisation(gradients, matrix, partial(_jvp, jacobian, it.sparsity))


@njit
def _smallest(table, slots, size):
    v = np.full(size, np.inf)
    for n in range(table.shape[0]):
        for column in range(table.shape[1]):
            at = slots[n, column]
            if at >= 0:
                v[at] = min(v[at], table[n, column])
    for k in range(size):
        if not np.isfinite(v[k]):
            v[k] = 0.0
    return v


@register_jitable
def _spread(v, slots, fixed, local):
    """Fill in each interval's coefficients, (N, k)."""
    for i in range(slots.shape[0]):
        for a in range(slots.shape[1]):
            local[i, a] = v[slots[i, a]] if slots[i, a] >= 0 else fixed[i, a]


@register_jitable(fastmath=_FREELY)
def _weigh(sparsity, local, result):
    """Fill in what is linear in the coefficients, (N, k), of each interval."""
    linear, linear_interval = sparsity.linear, sparsity.linear_interval
    of_h, of_yaw = len(linear_interval) - sparsity.of_yaw, local.shape[1] - 4
    for j in range(len(linear_interval)):
        first, i = 0 if j < of_h else of_yaw, linear_interval[j]
        value = linear[0, j] * local[i, first] + linear[1, j] * local[i, first + 1]
        result[j] = value + linear[2, j] * local[i, first + 2] + linear[3, j] * local[i, first + 3]


@njit(error_model="numpy")
def _gather(v, slots, interval, fixed, local, at_points):
    """Fill in the coefficients of each interval, (N, k), and of each point, (k, P)."""
    _spread(v, slots, fixed, local)
    for a in range(local.shape[1]):
        for p in range(len(interval)):
            at_points[a, p] = local[interval[p], a]


@njit(error_model="numpy", fastmath=_FREELY)
def _complete(constraints, penalty, local, sparsity, scale):
    """Fill in the linear constraints, which the kernels left open, and return the cost: penalties and time.

    The time in node units is Σ ∫ds/√x over all intervals.
    """
    _weigh(sparsity, local, constraints[len(constraints) - len(sparsity.linear_interval) :])
    time, total = 0.0, 0.0
    for i in range(local.shape[0]):
        for q in range(len(_WEIGHTS)):
            x = 0.0
            for a in range(4):
                x += _AT_PLACES[q, a] * local[i, a]
            time += _WEIGHTS[q] / math.sqrt(max(x, point_constraints.LEAST))
    for p in range(len(penalty)):
        total += penalty[p]
    return scale * time + total


@njit(error_model="numpy", fastmath=_FREELY)
def _sum_by_interval(at_points, interval, count):
    result = np.zeros((len(at_points), count))
    for a in range(len(at_points)):
        row, summed = at_points[a], result[a]
        for p in range(len(interval)):
            summed[interval[p]] += row[p]
    return result


@register_jitable
def _entry(column, row, size):
    """Return where a lower triangle has this entry; it lies column by column."""
    return column * size - column * (column - 1) // 2 + row - column


@register_jitable(fastmath=_FREELY)
def _add_linear(sparsity, terms, k, gradients, hessian):
    """Add the linear constraints to the gradients and the Hessian of each interval."""
    linear, linear_interval = sparsity.linear, sparsity.linear_interval
    count = len(linear_interval)
    before, of_h = terms.shape[1] - count, count - sparsity.of_yaw
    for begin, end, first in ((0, of_h, 0), (of_h, count, k - 4)):
        for b in range(4):
            for kind in range(1, len(terms)):
                row = gradients[kind * k + first + b]
                for j in range(begin, end):
                    row[linear_interval[j]] += terms[kind, before + j] * linear[b, j]
            for a in range(b, 4):
                row = hessian[_entry(first + b, first + a, k)]
                for j in range(begin, end):
                    row[linear_interval[j]] += terms[0, before + j] * linear[b, j] * linear[a, j]


@register_jitable(fastmath=_FREELY)
def _add_time(local, scale, gradients, hessian):
    """Add the time spent in each interval."""
    count, k = local.shape
    slope, bend = np.empty(count), np.empty(count)  # derivatives of the time by x
    for q in range(len(_WEIGHTS)):
        weight = _AT_PLACES[q]
        for i in range(count):
            x = weight[0] * local[i, 0] + weight[1] * local[i, 1] + weight[2] * local[i, 2]
            x = max(x + weight[3] * local[i, 3], point_constraints.LEAST)
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
    count, k = local.shape
    of_gradients = _sum_by_interval(at_points[: kinds * k], sparsity.interval, count)
    of_hessian = _sum_by_interval(at_points[kinds * k :], sparsity.interval, count)
    _add_linear(sparsity, terms, k, of_gradients, of_hessian)
    _add_time(local, scale, of_gradients, of_hessian)
    flat = matrix.ravel()
    for i in range(count):
        for a in range(k):
            if slots[i, a] >= 0:
                for kind in range(kinds):
                    gradients[kind, slots[i, a]] += of_gradients[kind * k + a, i]
        for e in range(entries.shape[1]):
            if entries[i, e, 0] >= 0:
                flat[entries[i, e, 0]] += entries[i, e, 1] * of_hessian[e, i]


@njit(error_model="numpy", fastmath=_FREELY)
def _jvp(jacobian, sparsity, dv):
    """Return J dv, (m,); `jacobian` is the kernel's at points."""
    count, k = sparsity.slots.shape
    interval, points = sparsity.interval, jacobian.shape[1]
    rows = jacobian.shape[0] // k
    local, of_point = np.zeros((count, k)), np.empty(points)
    _spread(dv, sparsity.slots, local, local)
    result = np.zeros(rows * points + len(sparsity.linear_interval))
    for a in range(k):
        for p in range(points):
            of_point[p] = local[interval[p], a]
        for r in range(rows):
            for p in range(points):
                result[r * points + p] += jacobian[a * rows + r, p] * of_point[p]
    _weigh(sparsity, local, result[rows * points :])
    return result
