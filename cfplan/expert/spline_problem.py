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
from numba import njit
from numpy.typing import NDArray

from cfplan.expert import stage
from cfplan.expert.compiled import Backend
from cfplan.expert.kernel import H_SPLINE, LANES, YAW_SPLINE, Points, coefficients
from cfplan.expert.problem import FLOOR, Problem
from cfplan.expert.program import OBJECTIVE_SCALE, Layout
from cfplan.expert.slacks import bounds_of


def h_weights(place: NDArray) -> NDArray:
    """(…, 4) weights of an interval's coefficients in x, at places from 0 to 1 in it."""
    return np.stack([np.ones_like(place), place, place**2 / 2, place**3 / 6], axis=-1) @ H_SPLINE


_GAUSS = h_weights(stage.GAUSS_PLACES)
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

        given = problem.p[: points * stage.POINT_DATA].reshape(points, stage.POINT_DATA)
        data = np.empty((stage.POINT_DATA, len(it.interval)))
        data[:, :points], data[:, points:] = given.T, given[-1:].T
        data[13, points:] = 0.0  # what is there to fill the lanes costs nothing
        common = problem.p[-3 - stage.COMMON_DATA : -3]
        weights = OBJECTIVE_SCALE * problem.p[-3:]
        self._points = Points(layout.shape.free_yaw, data, common, weights, backend, spare=len(it.linear))
        self._scale = OBJECTIVE_SCALE / math.sqrt(common[14])
        self.rows = stage.ROWS
        self.g, self.multipliers, self.stiffness = self._points.rows, self._points.multipliers, self._points.stiffness
        self.bounds = self._bounds(problem)
        self.gradient = np.empty(it.size)
        self.matrix = np.empty((it.size, it.band + 1))
        self._along = np.empty(len(self.g))

    def bounded_as(self, problem: Problem) -> "SplineProblem":
        """The same but for the limits, which are those of `problem`. Both share their arrays: use one at a time."""
        other = copy(self)
        other.bounds = other._bounds(problem)
        return other

    def _bounds(self, problem: Problem) -> NDArray:
        it = self._structure
        low, high = _linear_bounds(problem, len(it.positive))
        return bounds_of(
            _spread(problem.lbg, it.point_rows, it.selected, low, len(self.g), -np.inf),
            _spread(problem.ubg, it.point_rows, it.selected, high, len(self.g), np.inf),
        )

    def v_of(self, table: NDArray) -> NDArray:
        """The variables of a table of coefficients; the smallest counts where several have one value."""
        it = self._structure
        v = np.full(it.size, np.inf)
        free = it.of >= 0
        np.minimum.at(v, it.of[free], table[free])
        return np.where(np.isfinite(v), v, 0.0)

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
        _place(v, it.slots, it.interval, self._local, at.coefficients)
        at.evaluate()
        _linear_values(it.linear, it.linear_interval, self._local, self.g)
        return float(self._scale * _time(self._local, _GAUSS, stage.GAUSS_WEIGHTS) + at.penalty.sum())

    def expand(self) -> None:
        """Gradient and matrix, around the last v."""
        at, it = self._points, self._structure
        at.differentiate()
        _assemble(
            at.gradient, at.hessian, it.begins, it.slots, it.entries, it.linear, it.linear_interval, self.stiffness,
            self._local, self._scale, _GAUSS, stage.GAUSS_WEIGHTS, self.gradient, self.matrix,
        )  # fmt: skip

    def transposed(self, w: NDArray) -> NDArray:
        """(size,) J'w, J of the last expand()."""
        it, result = self._structure, np.zeros(len(self.gradient))
        _transposed(self._points.jacobian, it.begins, it.slots, it.linear, it.linear_interval, w, result)
        return result

    def along(self, dv: NDArray) -> NDArray:
        """(m,) J dv, likewise. Overwritten by the next call."""
        it = self._structure
        _along(self._points.jacobian, it.interval, it.slots, it.linear, it.linear_interval, dv, self._along)
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
    interval: NDArray
    # (P,) of each point
    begins: NDArray
    # (N+1,) first point of each interval
    selected: NDArray
    # (G,) entry of g of each of the layout's rows at points
    point_rows: NDArray
    # (G,) where those lie in the problem's constraints
    positive: NDArray
    # coefficients of h of their own
    linear: NDArray
    # (E, k)
    linear_interval: NDArray
    # (E,)
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
    interval = np.append(layout.interval, np.repeat(layout.interval[-1], -len(layout.interval) % LANES))
    positive = np.flatnonzero(own[:, 0])
    return _Structure(
        of, slots, local[0] * of.shape[1] + local[1], entries, interval,
        np.searchsorted(interval, np.arange(nodes + 1)),
        layout.row * len(interval) + layout.point, layout.point_rows, positive, *_linear_rows(layout, positive),
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


def _linear_rows(layout: Layout, positive: NDArray) -> tuple[NDArray, NDArray]:
    """(weights (E, k), interval): speeds at nodes and between, the coefficients of h, and where yaw starts."""
    nodes = layout.shape.nodes
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


def _linear_bounds(problem: Problem, positive: int) -> tuple[NDArray, NDArray]:
    """(lower, upper) of what _linear_rows has."""
    layout = problem.layout
    nodes = np.arange(layout.shape.nodes + 1) * layout.block
    speeds = problem.ubg[layout.speed_rows].ravel()
    free = problem.lbx[nodes] < problem.ubx[nodes]
    never = np.full(len(nodes) + len(speeds), -np.inf)
    lower = [never, np.full(positive, FLOOR)]
    upper = [np.where(free, problem.ubx[nodes], np.inf), speeds, np.full(positive, np.inf)]
    if layout.shape.free_yaw:
        held = problem.ends.start is not None
        lower.append(np.array([-np.inf]) if held else problem.lbx[3:4])
        upper.append(np.array([np.inf]) if held else problem.ubx[3:4])
    return np.concatenate(lower), np.concatenate(upper)


@njit(cache=True)
def _spread(limits, point_rows, selected, linear, count, nothing):
    """(count,) those of the kernel's rows, where something asks for them, and those of the linear ones behind."""
    spread = np.full(count, nothing)
    for k in range(len(selected)):
        spread[selected[k]] = limits[point_rows[k]]
    spread[count - len(linear) :] = linear
    return spread


_FREELY = {"contract", "reassoc", "nsz"}  # what is not a number survives


@njit(cache=True, error_model="numpy")
def _place(v, slots, interval, local, at_points):
    """Each interval's coefficients, (N, k), where they are free; and all of them at its points."""
    for i in range(slots.shape[0]):
        for a in range(slots.shape[1]):
            if slots[i, a] >= 0:
                local[i, a] = v[slots[i, a]]
    for a in range(slots.shape[1]):
        for p in range(len(interval)):
            at_points[a, p] = local[interval[p], a]


@njit(cache=True, error_model="numpy", fastmath=_FREELY)
def _linear_values(linear, interval, local, g):
    before = len(g) - len(linear)
    for j in range(len(linear)):
        value = 0.0
        for a in range(linear.shape[1]):
            value += linear[j, a] * local[interval[j], a]
        g[before + j] = value


@njit(cache=True, error_model="numpy", fastmath=_FREELY)
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


@njit(cache=True, error_model="numpy", fastmath=_FREELY)
def _sum_by_interval(at_points, begins, by_interval):
    for a in range(by_interval.shape[0]):
        row, result = at_points[a], by_interval[a]
        for i in range(len(result)):
            value = 0.0
            for p in range(begins[i], begins[i + 1]):
                value += row[p]
            result[i] = value


@njit(cache=True, error_model="numpy", fastmath=_FREELY)
def _assemble(
    at_gradient, at_hessian, begins, slots, entries, linear, linear_interval, stiffness, local, scale, places, weights,
    gradient, matrix,
):  # fmt: skip
    """Gradient and matrix from what the kernel gives at points, the linear constraints, and the time spent."""
    count, k = slots.shape
    of_gradient, of_hessian = np.zeros((k, count)), np.zeros((entries.shape[1], count))
    _sum_by_interval(at_gradient, begins, of_gradient)
    _sum_by_interval(at_hessian, begins, of_hessian)
    before = len(stiffness) - len(linear)
    for j in range(len(linear)):
        of_yaw = linear[j, 0] + linear[j, 1] + linear[j, 2] + linear[j, 3] == 0.0
        for b in range(4 if of_yaw else 0, k if of_yaw else 4):
            pull = stiffness[before + j] * linear[j, b]
            e = b * k - b * (b - 1) // 2
            for a in range(b, k if of_yaw else 4):
                of_hessian[e + a - b, linear_interval[j]] += pull * linear[j, a]
    first, second = np.empty(count), np.empty(count)  # derivatives of the time by x
    for q in range(len(weights)):
        for i in range(count):
            x = places[q, 0] * local[i, 0] + places[q, 1] * local[i, 1] + places[q, 2] * local[i, 2]
            x = max(x + places[q, 3] * local[i, 3], stage.LEAST)
            first[i] = -0.5 * scale * weights[q] / (x * math.sqrt(x))
            second[i] = -1.5 * first[i] / x
        e = 0
        for b in range(4):
            for i in range(count):
                of_gradient[b, i] += first[i] * places[q, b]
            for a in range(b, 4):
                both, row = places[q, b] * places[q, a], of_hessian[e]
                for i in range(count):
                    row[i] += second[i] * both
                e += 1
            e += k - 4
    gradient[:] = 0.0
    flat = matrix.ravel()
    flat[:] = 0.0
    for i in range(count):
        for a in range(k):
            if slots[i, a] >= 0:
                gradient[slots[i, a]] += of_gradient[a, i]
        for e in range(entries.shape[1]):
            if entries[i, e, 0] >= 0:
                flat[entries[i, e, 0]] += entries[i, e, 1] * of_hessian[e, i]


@njit(cache=True, error_model="numpy", fastmath=_FREELY)
def _transposed(jacobian, begins, slots, linear, linear_interval, w, result):
    count, k = slots.shape
    points = jacobian.shape[1]
    rows = jacobian.shape[0] // k
    of_point, local = np.empty(points), np.zeros((count, k))
    for a in range(k):
        of_point[:] = 0.0
        for r in range(rows):
            for p in range(points):
                of_point[p] += w[r * points + p] * jacobian[a * rows + r, p]
        for i in range(count):
            value = 0.0
            for p in range(begins[i], begins[i + 1]):
                value += of_point[p]
            local[i, a] = value
    for j in range(len(linear)):
        for a in range(k):
            local[linear_interval[j], a] += w[rows * points + j] * linear[j, a]
    for i in range(count):
        for a in range(k):
            if slots[i, a] >= 0:
                result[slots[i, a]] += local[i, a]


@njit(cache=True, error_model="numpy", fastmath=_FREELY)
def _along(jacobian, interval, slots, linear, linear_interval, dv, result):
    count, k = slots.shape
    points = jacobian.shape[1]
    rows = jacobian.shape[0] // k
    local, of_point = np.zeros((count, k)), np.empty(points)
    for i in range(count):
        for a in range(k):
            if slots[i, a] >= 0:
                local[i, a] = dv[slots[i, a]]
    result[:] = 0.0
    for a in range(k):
        for p in range(points):
            of_point[p] = local[interval[p], a]
        for r in range(rows):
            for p in range(points):
                result[r * points + p] += jacobian[a * rows + r, p] * of_point[p]
    for j in range(len(linear)):
        for a in range(k):
            result[rows * points + j] += linear[j, a] * local[linear_interval[j], a]
