"""The problem of a speed profile in spline coefficients, for the interior point method.

Coefficients lie in a table: N+3 of h, a cubic B-spline on the grid, in its first column and, where yaw is free, N+2 of
yaw, a quadratic one, in its second. Read row by row it is the vector v of variables, in which an interval's
coefficients lie side by side. A boundary state fixes three coefficients of h and two of yaw; at a rest the first four
of h have one value, so that h is constant in that interval, and the first two of yaw.
"""

import math
from copy import copy
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.machine_code import njit
from cfplan.planners.expert import point_constraints
from cfplan.planners.expert.kernel import H_SPLINE, YAW_SPLINE, Backend, Points, coefficients
from cfplan.planners.expert.llvm_emitter import LANES
from cfplan.planners.expert.problem import FLOOR, Problem
from cfplan.planners.expert.program import OBJECTIVE_SCALE, Layout
from cfplan.planners.solver.barrier import PULLS, bounds_of


def h_weights(place: NDArray) -> NDArray:
    """(…, 4) weights of an interval's coefficients in x, at places from 0 to 1 in it."""
    return np.stack([np.ones_like(place), place, place**2 / 2, place**3 / 6], axis=-1) @ H_SPLINE


_GAUSS = h_weights(point_constraints.GAUSS_PLACES)
_NOBODY = -1


class SplineProblem:
    """f and g by v, see interior_point.Functions; and the way from tables to v and back.

    The constraints are the kernel's rows at all points, where those that nothing asks for have no bounds, and then
    what is linear in the coefficients.
    """

    def __init__(self, problem: Problem, backend: Backend | None = None) -> None:
        """What is fixed has its value from the problem's table."""
        self._structure = it = _structure(problem.layout, *_kinds(problem))
        layout, points = problem.layout, len(problem.layout.interval)
        self._fixed = problem.table
        self._local = self._fixed.ravel()[it.coefficients]

        data = _by_quantity(
            problem.p[: points * point_constraints.POINT_DATA].reshape(points, point_constraints.POINT_DATA), it.order
        )
        common = problem.p[-3 - point_constraints.COMMON_DATA : -3]
        weights = OBJECTIVE_SCALE * problem.p[-3:]
        self._points = Points(layout.shape.free_yaw, data, common, weights, backend, spare=len(it.linear_interval))
        self._scale = OBJECTIVE_SCALE / math.sqrt(common[14])
        self.rows = point_constraints.ROWS
        self.g, self.pulls = self._points.rows, self._points.pulls
        self.bounds = self._bounds(problem)
        self.gradients = np.empty((len(PULLS), it.size))
        self.matrix = np.empty((it.size, it.band + 1))
        self._along = np.empty(len(self.g))

    def bounded_as(self, problem: Problem) -> "SplineProblem":
        """The same but for the limits, which are those of `problem`. Both share their arrays: use one at a time."""
        other = copy(self)
        other.bounds = other._bounds(problem)
        return other

    def _bounds(self, problem: Problem) -> NDArray:
        it, layout = self._structure, problem.layout
        lower, upper = _limits(
            problem.lbx, problem.ubx, problem.lbg, problem.ubg, it.point_rows, it.selected, layout.speed_rows,
            layout.block, len(it.positive), it.of_yaw, problem.ends.start is not None, len(self.g),
        )  # fmt: skip
        return bounds_of(lower, upper)

    def v_of(self, table: NDArray) -> NDArray:
        """The variables of a table of coefficients; the smallest counts where several have one value."""
        return _smallest(table, self._structure.of, self._structure.size)

    def table_of(self, v: NDArray) -> NDArray:
        """(N+3, 1 or 2)"""
        of = self._structure.of
        return np.where(of >= 0, v[of], self._fixed)

    def at_points(self) -> NDArray:
        """What the kernel's rows come to at the last v, in the order of layout.selected."""
        return self.g[self._structure.selected]

    def values(self, v: NDArray) -> float:
        """f; and g."""
        at, it = self._points, self._structure
        time = _place(
            v, it.slots, it.interval, self._local, at.coefficients, it.linear, it.linear_interval, it.of_yaw, self.g,
            _GAUSS, point_constraints.GAUSS_WEIGHTS,
        )  # fmt: skip
        at.evaluate()
        return float(self._scale * time + at.penalty.sum())

    def expand(self) -> None:
        """Gradients and matrix, around the last v."""
        at, it = self._points, self._structure
        at.differentiate()
        _assemble(
            at.gradients, at.hessian, it.interval, it.slots, it.entries, it.linear, it.linear_interval, it.of_yaw,
            self.pulls, self._local, self._scale, _GAUSS, point_constraints.GAUSS_WEIGHTS, self.gradients, self.matrix,
        )  # fmt: skip

    def along(self, dv: NDArray) -> NDArray:
        """(m,) J dv, J of the last expand(). Overwritten by the next call."""
        it = self._structure
        _along(self._points.jacobian, it.interval, it.slots, it.linear, it.linear_interval, it.of_yaw, dv, self._along)
        return self._along


class _Structure(NamedTuple):
    """What follows from the layout and from how the ends are held."""

    of: NDArray
    # (N+3, 1 or 2) entry of v of each coefficient, -1 where it is fixed
    slots: NDArray
    # (N, k) entry of v of each of an interval's coefficients, likewise
    coefficients: NDArray
    # (N, k) where those lie in a flattened table
    entries: NDArray
    # (N, k(k+1)/2, 2) entry of the flattened matrix of each pair, -1 where one is fixed, and how often it counts there
    order: NDArray
    # (P,) which of the layout's points each is: the first of all intervals, then the second of all, and so on
    interval: NDArray
    # (P,) of each point
    selected: NDArray
    # (G,) entry of g of each of the layout's rows at points
    point_rows: NDArray
    # (G,) where those lie in the problem's constraints
    positive: NDArray
    # coefficients of h of their own
    linear: NDArray
    # (4, E) weights of four of an interval's coefficients: the first, but the last in rows of yaw, which come last
    linear_interval: NDArray
    # (E,)
    of_yaw: int
    # how many those are
    size: int
    # of v
    band: int
    # how far apart two coefficients that meet can be


def _kinds(problem: Problem) -> tuple[tuple[bool, bool], ...]:
    """Whether each end is held, and whether it is at rest."""
    return (problem.ends.start is not None, problem.ends.end is not None), problem.rests


@lru_cache(maxsize=32)
def _structure(layout: Layout, held: tuple[bool, bool], rests: tuple[bool, bool]) -> _Structure:
    nodes = layout.shape.nodes
    of, own = _slots(layout, held, rests)
    k = coefficients(layout.shape.free_yaw)
    local = np.arange(nodes)[:, None] + np.array([0, 1, 2, 3, 0, 1, 2][:k]), np.array([0, 0, 0, 0, 1, 1, 1][:k])
    slots = of[local]
    free = np.where(slots >= 0, slots, slots.max(axis=1, keepdims=True))
    band = int((free.max(axis=1) - free.min(axis=1)).max())
    right, left = np.array([(a, b) for b in range(k) for a in range(b, k)]).T
    low, high = np.minimum(slots[:, left], slots[:, right]), np.maximum(slots[:, left], slots[:, right])
    entry = np.where(low >= 0, high * (band + 1) + high - low, _NOBODY)
    entries = np.stack([entry, np.where((low == high) & (left != right), 2, 1)], axis=-1)
    of_its_interval = np.arange(len(layout.interval)) - np.searchsorted(layout.interval, layout.interval)
    order = np.lexsort((layout.interval, of_its_interval))
    position = np.argsort(order)
    order = np.append(order, np.repeat(order[-1], -len(order) % LANES))
    positive = np.flatnonzero(own[:, 0])
    return _Structure(
        of, slots, local[0] * of.shape[1] + local[1], entries, order, layout.interval[order],
        layout.row * len(order) + position[layout.point], layout.point_rows, positive, *_linear_rows(layout, positive),
        of.size, band,
    )  # fmt: skip


def _slots(layout: Layout, held: tuple[bool, bool], rests: tuple[bool, bool]) -> tuple[NDArray, NDArray]:
    """(N+3, 1 or 2) entry of v of each coefficient, -1 where it is fixed; and which have an entry of their own."""
    nodes, columns = layout.shape.nodes, 2 if layout.shape.free_yaw else 1
    own = np.arange((nodes + 3) * columns).reshape(nodes + 3, columns)
    of = own.copy()
    for end, (h, yaw) in enumerate((
        ([0, 1, 2, 3], [0, 1]), ([nodes + 2, nodes + 1, nodes, nodes - 1], [nodes + 1, nodes])
    )):  # fmt: skip
        if held[end]:
            of[h[:3], 0] = _NOBODY
            of[yaw, columns - 1] = _NOBODY if columns == 2 else of[yaw, 0]
        elif rests[end]:
            of[h, 0] = of[h[3], 0]
            of[yaw, columns - 1] = of[yaw[1], 1] if columns == 2 else of[yaw, 0]
    if columns == 2:
        of[-1, 1] = _NOBODY  # yaw has a coefficient less
    return of, of == own


def _linear_rows(layout: Layout, positive: NDArray) -> tuple[NDArray, NDArray, int]:
    """(weights (4, E), interval, how many of yaw): speeds at nodes and between, the coefficients of h, and where yaw
    starts."""
    nodes = layout.shape.nodes
    node = np.arange(nodes + 1)
    between = np.array(layout.shape.speed_places)
    of_positive = np.clip(positive - 1, 0, nodes - 1)
    weights = [
        h_weights((node == nodes) * 1.0),
        np.repeat(h_weights(between), nodes, axis=0),
        np.eye(4)[positive - of_positive],
    ]
    interval = [np.minimum(node, nodes - 1), np.tile(node[:-1], len(between)), of_positive]
    if layout.shape.free_yaw:
        weights.append(np.pad(YAW_SPLINE[:1], ((0, 0), (1, 0))))
        interval.append(np.zeros(1, dtype=int))
    return np.ascontiguousarray(np.concatenate(weights).T), np.concatenate(interval), int(layout.shape.free_yaw)


@njit
def _by_quantity(of_points, order):
    """(POINT_DATA, P) from (points, POINT_DATA). What is there to fill the lanes costs nothing."""
    data = np.empty((of_points.shape[1], len(order)))
    for row in range(len(data)):
        for p in range(len(order)):
            data[row, p] = of_points[order[p], row]
    data[13, len(of_points) :] = 0.0
    return data


@njit
def _smallest(table, of, size):
    v = np.full(size, np.inf)
    for n in range(table.shape[0]):
        for column in range(table.shape[1]):
            at = of[n, column]
            if at >= 0:
                v[at] = min(v[at], table[n, column])
    for k in range(size):
        if not np.isfinite(v[k]):
            v[k] = 0.0
    return v


@njit
def _limits(
    lbx, ubx, lbg, ubg, point_rows, selected, speed_rows, block, positive, of_yaw, yaw_held, count
):  # fmt: skip
    """(2, count) of the kernel's rows, where something asks for them, and of what _linear_rows has behind."""
    limits = np.empty((2, count))
    limits[0], limits[1] = -np.inf, np.inf
    for k in range(len(selected)):
        limits[0, selected[k]], limits[1, selected[k]] = lbg[point_rows[k]], ubg[point_rows[k]]
    nodes, between = speed_rows.shape
    at = count - (nodes + 1 + nodes * between + positive + of_yaw)
    for n in range(nodes + 1):
        if lbx[n * block] < ubx[n * block]:
            limits[1, at + n] = ubx[n * block]
    at += nodes + 1
    for k in range(nodes):
        for q in range(between):
            limits[1, at + q * nodes + k] = ubg[speed_rows[k, q]]
    at += nodes * between
    limits[0, at : at + positive] = FLOOR
    if of_yaw and not yaw_held:
        limits[0, at + positive], limits[1, at + positive] = lbx[3], ubx[3]
    return limits


_FREELY = {"contract", "reassoc", "nsz"}  # what is not a number survives


@register_jitable(fastmath=_FREELY)
def _weigh(linear, linear_interval, of_yaw, local, result):
    """What is linear in the coefficients, (N, k), of each interval."""
    of_h, later = len(result) - of_yaw, local.shape[1] - 4
    for j in range(len(result)):
        first, i = 0 if j < of_h else later, linear_interval[j]
        value = linear[0, j] * local[i, first] + linear[1, j] * local[i, first + 1]
        result[j] = value + linear[2, j] * local[i, first + 2] + linear[3, j] * local[i, first + 3]


@njit(error_model="numpy", fastmath=_FREELY)
def _place(v, slots, interval, local, at_points, linear, linear_interval, of_yaw, g, places, weights):
    """Each interval's coefficients, (N, k), where they are free; all of them at its points; and what is linear in them.

    Gives Σ ∫ds/√x over all intervals, in node units.
    """
    for i in range(slots.shape[0]):
        for a in range(slots.shape[1]):
            if slots[i, a] >= 0:
                local[i, a] = v[slots[i, a]]
    for a in range(slots.shape[1]):
        for p in range(len(interval)):
            at_points[a, p] = local[interval[p], a]
    _weigh(linear, linear_interval, of_yaw, local, g[len(g) - len(linear_interval) :])
    total = 0.0
    for i in range(local.shape[0]):
        for q in range(len(weights)):
            x = 0.0
            for a in range(4):
                x += places[q, a] * local[i, a]
            total += weights[q] / math.sqrt(max(x, point_constraints.LEAST))
    return total


@njit(error_model="numpy", fastmath=_FREELY)
def _sum_by_interval(at_points, interval, by_interval):
    for a in range(len(by_interval)):
        row, result = at_points[a], by_interval[a]
        for p in range(len(interval)):
            result[interval[p]] += row[p]


@register_jitable
def _entry(column, row, size):
    """Of a lower triangle, which lies column by column."""
    return column * size - column * (column - 1) // 2 + row - column


@njit(error_model="numpy", fastmath=_FREELY)
def _assemble(
    at_gradients, at_hessian, interval, slots, entries, linear, linear_interval, of_yaw, pulls, local, scale, places,
    weights, gradients, matrix,
):  # fmt: skip
    """Gradients and matrix from what the kernel gives at points, the linear constraints, and the time spent."""
    count, k = slots.shape
    kinds = len(gradients)
    of_gradients, of_hessian = np.zeros((kinds * k, count)), np.zeros((entries.shape[1], count))
    _sum_by_interval(at_gradients, interval, of_gradients)
    _sum_by_interval(at_hessian, interval, of_hessian)
    before, of_h = pulls.shape[1] - len(linear_interval), len(linear_interval) - of_yaw
    for begin, end, first in ((0, of_h, 0), (of_h, len(linear_interval), k - 4)):
        for b in range(4):
            for kind in range(1, kinds):
                row = of_gradients[kind * k + first + b]
                for j in range(begin, end):
                    row[linear_interval[j]] += pulls[kind, before + j] * linear[b, j]
            for a in range(b, 4):
                row = of_hessian[_entry(first + b, first + a, k)]
                for j in range(begin, end):
                    row[linear_interval[j]] += pulls[0, before + j] * linear[b, j] * linear[a, j]
    slope, bend = np.empty(count), np.empty(count)  # derivatives of the time by x
    for q in range(len(weights)):
        for i in range(count):
            x = places[q, 0] * local[i, 0] + places[q, 1] * local[i, 1] + places[q, 2] * local[i, 2]
            x = max(x + places[q, 3] * local[i, 3], point_constraints.LEAST)
            slope[i] = -0.5 * scale * weights[q] / (x * math.sqrt(x))
            bend[i] = -1.5 * slope[i] / x
        for b in range(4):
            for i in range(count):
                of_gradients[b, i] += slope[i] * places[q, b]
            for a in range(b, 4):
                both, row = places[q, b] * places[q, a], of_hessian[_entry(b, a, k)]
                for i in range(count):
                    row[i] += bend[i] * both
    gradients[:] = 0.0
    flat = matrix.ravel()
    flat[:] = 0.0
    for i in range(count):
        for a in range(k):
            if slots[i, a] >= 0:
                for kind in range(kinds):
                    gradients[kind, slots[i, a]] += of_gradients[kind * k + a, i]
        for e in range(entries.shape[1]):
            if entries[i, e, 0] >= 0:
                flat[entries[i, e, 0]] += entries[i, e, 1] * of_hessian[e, i]


@njit(error_model="numpy", fastmath=_FREELY)
def _along(jacobian, interval, slots, linear, linear_interval, of_yaw, dv, result):
    count, k = slots.shape
    points = jacobian.shape[1]
    rows = jacobian.shape[0] // k
    local, of_point = np.zeros((count, k)), np.empty(points)
    for i in range(count):
        for a in range(k):
            if slots[i, a] >= 0:
                local[i, a] = dv[slots[i, a]]
    result[: rows * points] = 0.0
    for a in range(k):
        for p in range(points):
            of_point[p] = local[interval[p], a]
        for r in range(rows):
            for p in range(points):
                result[r * points + p] += jacobian[a * rows + r, p] * of_point[p]
    _weigh(linear, linear_interval, of_yaw, local, result[rows * points :])
