"""The problem of a speed profile in spline coefficients, for the interior point method.

Coefficients lie in a table: N+3 of h, a cubic B-spline on the grid, in its first column and, where yaw is free, N+2 of
yaw, a quadratic one, in its second. Read row by row it is the vector v of variables, in which an interval's
coefficients lie side by side. A boundary state fixes three coefficients of h and two of yaw; at a rest the first four
of h have one value, so that h is constant in that interval, and the first two of yaw.
"""

import math
from copy import copy

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cfplan.expert import stage
from cfplan.expert.compiled import Backend
from cfplan.expert.interior_point import Expansion, Rows
from cfplan.expert.kernel import H_SPLINE, LANES, YAW_SPLINE, Points, coefficients
from cfplan.expert.problem import FLOOR, Problem
from cfplan.expert.program import OBJECTIVE_SCALE


def h_weights(place: NDArray) -> NDArray:
    """(…, 4) weights of an interval's coefficients in x, at places from 0 to 1 in it."""
    return np.stack([np.ones_like(place), place, place**2 / 2, place**3 / 6], axis=-1) @ H_SPLINE


_GAUSS = h_weights(stage.GAUSS_PLACES)
_NOBODY = -1


class SplineProblem:
    """f and g by v, see interior_point.Functions; and the way from tables to v and back."""

    def __init__(self, problem: Problem, backend: Backend | None = None) -> None:
        """What is fixed has its value from the problem's table."""
        layout = problem.layout
        nodes, points = layout.shape.nodes, len(layout.interval)
        self._fixed = problem.table
        self._of, own = _slots(problem)
        k = coefficients(layout.shape.free_yaw)
        local = np.arange(nodes)[:, None] + np.array([0, 1, 2, 3, 0, 1, 2][:k]), np.array([0, 0, 0, 0, 1, 1, 1][:k])
        self._fixed_local = np.ascontiguousarray(self._fixed[local])

        spare = -points % LANES
        self._interval = np.append(layout.interval, np.repeat(layout.interval[-1], spare))
        data = problem.p[: points * stage.POINT_DATA].reshape(points, stage.POINT_DATA)
        data = np.pad(data, ((0, spare), (0, 0)), mode="edge").T
        data[13, points:] = 0.0  # what is there to fill the lanes costs nothing
        common = problem.p[-3 - stage.COMMON_DATA : -3]
        self._points = Points(layout.shape.free_yaw, data, common, OBJECTIVE_SCALE * problem.p[-3:], backend)
        self._scale = OBJECTIVE_SCALE / math.sqrt(common[14])
        self._point, self._row = np.divmod(layout.selected, stage.ROWS)
        self._positive = np.flatnonzero(own[:, 0])
        self._linear, linear_interval = _linear_rows(problem, self._positive)
        interval = np.concatenate([layout.interval[self._point], linear_interval])
        self.rows = Rows(self._of[local], interval, *_bounds(problem, len(self._positive)))

    def bounded_as(self, problem: Problem) -> "SplineProblem":
        """The same but for the limits, which are those of `problem`. Both share their arrays: use one at a time."""
        other = copy(self)
        other.rows = Rows(self.rows.slots, self.rows.interval, *_bounds(problem, len(self._positive)))
        return other

    def v_of(self, table: NDArray) -> NDArray:
        """The variables of a table of coefficients; the smallest counts where several have one value."""
        v = np.full(table.size, np.inf)
        free = self._of >= 0
        np.minimum.at(v, self._of[free], table[free])
        return np.where(np.isfinite(v), v, 0.0)

    def table_of(self, v: NDArray) -> NDArray:
        """(N+3, 1 or 2)"""
        return np.where(self._of >= 0, v[self._of], self._fixed)

    def at_points(self, g: NDArray) -> NDArray:
        """What the kernel's rows come to, in the order of layout.selected."""
        return g[: len(self._row)]

    def values(self, v: NDArray) -> tuple[float, NDArray]:
        """f, and g (m,)."""
        at = self._points
        local = _place(v, self.rows.slots, self._fixed_local, self._interval, at.coefficients)
        at.evaluate()
        return _valued(
            at.rows, at.penalty, self._row, self._point, self._linear, self.rows.interval, local, self._scale,
            _GAUSS, stage.GAUSS_WEIGHTS,
        )  # fmt: skip

    def expand(self, v: NDArray, y: NDArray, stiffness: NDArray) -> Expansion:
        """Around v; see Functions."""
        at = self._points
        local = _place(v, self.rows.slots, self._fixed_local, self._interval, at.coefficients)
        _spread(y, stiffness, self._row, self._point, at.multipliers, at.stiffness)
        at.differentiate()
        return _expanded(
            at.rows, at.jacobian, at.gradient, at.hessian, self._row, self._point, self._interval, self._linear,
            self.rows.interval, stiffness, local, self._scale, _GAUSS, stage.GAUSS_WEIGHTS,
        )  # fmt: skip


def _slots(problem: Problem) -> tuple[NDArray, NDArray]:
    """(N+3, 1 or 2) entry of v of each coefficient, -1 where it is fixed; and which have an entry of their own."""
    layout, ends = problem.layout, problem.ends
    nodes, columns = layout.shape.nodes, 2 if layout.shape.free_yaw else 1
    own = np.arange((nodes + 3) * columns).reshape(nodes + 3, columns)
    of = own.copy()
    for boundary, rests, h, yaw in (
        (ends.start, problem.rests[0], [0, 1, 2, 3], [0, 1]),
        (ends.end, problem.rests[1], [nodes + 2, nodes + 1, nodes, nodes - 1], [nodes + 1, nodes]),
    ):
        if boundary:
            of[h[:3], 0] = _NOBODY
            of[yaw, columns - 1] = _NOBODY if columns == 2 else of[yaw, 0]
        elif rests:
            of[h, 0] = of[h[3], 0]
            of[yaw, columns - 1] = of[yaw[1], 1] if columns == 2 else of[yaw, 0]
    if columns == 2:
        of[-1, 1] = _NOBODY  # yaw has a coefficient less
    return of, of == own


def _linear_rows(problem: Problem, positive: NDArray) -> tuple[NDArray, NDArray]:
    """(weights (E, k), interval): speeds at nodes and between, the coefficients of h, and where yaw starts."""
    layout, nodes = problem.layout, problem.layout.shape.nodes
    k = coefficients(layout.shape.free_yaw)
    node = np.arange(nodes + 1)
    between = np.array(layout.shape.speed_places)
    of_positive = np.clip(positive - 1, 0, nodes - 1)
    weights = [
        h_weights((node == nodes) * 1.0),
        np.tile(h_weights(between), (nodes, 1)),
        np.eye(4)[positive - of_positive],
    ]
    rows = np.pad(np.concatenate(weights), ((0, 0), (0, k - 4)))
    interval = np.concatenate([np.minimum(node, nodes - 1), np.repeat(node[:-1], len(between)), of_positive])
    if layout.shape.free_yaw:
        start = np.pad(YAW_SPLINE[:1], ((0, 0), (4, 0)))
        rows, interval = np.concatenate([rows, start]), np.append(interval, 0)
    return rows, interval


def _bounds(problem: Problem, positive: int) -> tuple[NDArray, NDArray]:
    """(lower, upper) of all constraints, in their order."""
    layout = problem.layout
    nodes = np.arange(layout.shape.nodes + 1) * layout.block
    speeds = problem.ubg[layout.speed_rows].ravel()
    free = problem.lbx[nodes] < problem.ubx[nodes]
    never = np.full(len(nodes) + len(speeds), -np.inf)
    lower = [problem.lbg[layout.point_rows], never, np.full(positive, FLOOR)]
    upper = [
        problem.ubg[layout.point_rows], np.where(free, problem.ubx[nodes], np.inf), speeds, np.full(positive, np.inf)
    ]  # fmt: skip
    if layout.shape.free_yaw:
        held = problem.ends.start is not None
        lower.append(np.array([-np.inf]) if held else problem.lbx[3:4])
        upper.append(np.array([np.inf]) if held else problem.ubx[3:4])
    return np.concatenate(lower), np.concatenate(upper)


@njit(cache=True, error_model="numpy")
def _place(v, slots, fixed, interval, at_points):
    """(N, k) each interval's coefficients, written out at its points too."""
    local = fixed.copy()
    for i in range(slots.shape[0]):
        for a in range(slots.shape[1]):
            if slots[i, a] >= 0:
                local[i, a] = v[slots[i, a]]
    for a in range(slots.shape[1]):
        for p in range(len(interval)):
            at_points[a, p] = local[interval[p], a]
    return local


@njit(cache=True, error_model="numpy")
def _spread(y, stiffness, row, point, y_at_points, stiffness_at_points):
    for j in range(len(row)):
        y_at_points[row[j], point[j]] = y[j]
        stiffness_at_points[row[j], point[j]] = stiffness[j]


@njit(cache=True, error_model="numpy")
def _constraints(rows, row, point, linear, interval, local):
    count = len(row)
    g = np.zeros(count + len(linear))
    for j in range(count):
        g[j] = rows[row[j], point[j]]
    for j in range(len(linear)):
        for a in range(linear.shape[1]):
            g[count + j] += linear[j, a] * local[interval[count + j], a]
    return g


@njit(cache=True, error_model="numpy")
def _chosen(at_points, row, point, linear):
    """(m, k) the Jacobian of the kernel's rows that are constraints, and of the linear ones."""
    k = linear.shape[1]
    jacobian = np.empty((len(row) + len(linear), k))
    for a in range(k):
        for j in range(len(row)):
            jacobian[j, a] = at_points[a * stage.ROWS + row[j], point[j]]
    jacobian[len(row) :] = linear
    return jacobian


@njit(cache=True, error_model="numpy")
def _by_interval(gradient, hessian, interval, count):
    k = gradient.shape[0]
    of_gradient, of_hessian = np.zeros((count, k)), np.zeros((count, k, k))
    entry = 0
    for b in range(k):
        for p in range(len(interval)):
            of_gradient[interval[p], b] += gradient[b, p]
        for a in range(b, k):
            for p in range(len(interval)):
                of_hessian[interval[p], a, b] += hessian[entry, p]
            entry += 1
    return of_gradient, of_hessian


@njit(cache=True, error_model="numpy")
def _add_linear(weights, interval, stiffness, hessian):
    before = len(interval) - len(weights)
    for j in range(len(weights)):
        for a in range(weights.shape[1]):
            for b in range(a + 1):
                hessian[interval[before + j], a, b] += stiffness[before + j] * weights[j, a] * weights[j, b]


@njit(cache=True, error_model="numpy")
def _time(local, places, weights):
    """Σ ∫ds/√x over all intervals, in node units."""
    total = 0.0
    for i in range(local.shape[0]):
        for q in range(len(weights)):
            x = 0.0
            for a in range(4):
                x += places[q, a] * local[i, a]
            total += weights[q] / math.sqrt(max(x, stage.LEAST))
    return total


@njit(cache=True, error_model="numpy")
def _add_time(local, places, weights, scale, gradient, hessian):
    for i in range(local.shape[0]):
        for q in range(len(weights)):
            x = 0.0
            for a in range(4):
                x += places[q, a] * local[i, a]
            x = max(x, stage.LEAST)
            first = -0.5 * scale * weights[q] * x**-1.5
            second = -1.5 * first / x
            for a in range(4):
                gradient[i, a] += first * places[q, a]
                for b in range(a + 1):
                    hessian[i, a, b] += second * places[q, a] * places[q, b]


@njit(cache=True, error_model="numpy")
def _valued(rows, penalty, row, point, linear, interval, local, scale, places, weights):
    """f and g from what the kernel gives."""
    return scale * _time(local, places, weights) + penalty.sum(), _constraints(
        rows, row, point, linear, interval, local
    )


@njit(cache=True, error_model="numpy")
def _expanded(
    rows,
    jacobian,
    gradient,
    hessian,
    row,
    point,
    points_interval,
    linear,
    interval,
    stiffness,
    local,
    scale,
    places,
    weights,
):
    """The expansion from what the kernel gives."""
    g = _constraints(rows, row, point, linear, interval, local)
    of_rows = _chosen(jacobian, row, point, linear)
    of_gradient, of_hessian = _by_interval(gradient, hessian, points_interval, len(local))
    _add_linear(linear, interval, stiffness, of_hessian)
    _add_time(local, places, weights, scale, of_gradient, of_hessian)
    return Expansion(g, of_rows, of_gradient, of_hessian)
