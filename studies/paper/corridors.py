"""Minimum-jerk motion through a corridor of three oriented boxes, the input that the paper gives AllocNet.

Y. Wu et al., "Deep Learning for Optimization of Trajectories for Quadrotors" (2024): safe corridors and segment times
in, the polynomial that minimises jerk within them out. The paper (see toppquad.py) fits three boxes to evenly spaced
sections of the min-snap path, aligned with each section and padded by 0.75 m; the path itself need not be followed.

A segment is a quintic Bézier curve whose control points lie in its box; position to jerk are continuous.
"""

from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import pairwise
from math import comb
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InfeasibleError
from cfplan.geometry.path import Path

BOXES = 3
PADDING = 0.75  # m from the path to any wall
CONTROL_POINTS = 6  # of a quintic
CONTINUOUS = 3  # order of the highest derivative that is continuous between segments
SPEED, ACCELERATION = 5.0, 6.0  # m/s, of the paper's simulations; m/s², of AllocNet's public weights
_SECTION_SAMPLES = 60
_SAMPLES = 40  # samples of a segment at which speed and acceleration are evaluated
_ORDER = CONTROL_POINTS - 1


@dataclass(frozen=True, slots=True, eq=False)
class Corridor:
    """A sequence of oriented boxes from a start to a goal."""

    start: NDArray  # (3,) m
    goal: NDArray  # (3,) m
    axes: NDArray  # (B, 3, 3), columns are the axes of a box
    low: NDArray  # (B, 3) m, along its axes from the world's origin
    high: NDArray  # (B, 3) m


def corridor_about(path: Path) -> Corridor:
    """Return the boxes around evenly spaced sections of a path."""
    edges = np.linspace(0.0, path.end, BOXES + 1)
    axes, low, high = [], [], []
    for begin, end in pairwise(edges):
        points = path(np.linspace(begin, end, _SECTION_SAMPLES))
        turned = np.linalg.svd(points - points.mean(axis=0), full_matrices=True)[2].T
        along = points @ turned
        axes.append(turned)
        low.append(along.min(axis=0) - PADDING)
        high.append(along.max(axis=0) + PADDING)
    return Corridor(path(0.0), path(path.end), np.array(axes), np.array(low), np.array(high))


def box_corners(corridor: Corridor) -> NDArray:
    """Return the corners of each box, (B, 8, 3) m; bit k of a corner's index selects the side along axis k."""
    sides = np.array([[corner >> axis & 1 for axis in range(3)] for corner in range(8)])
    along = np.where(sides[None], corridor.high[:, None], corridor.low[:, None])
    return np.asarray(np.einsum("bij,bcj->bci", corridor.axes, along))


def min_jerk(corridor: Corridor, times: NDArray) -> NDArray:
    """Return the control points, (B, 6, 3) m, of the motion with the least ∫|jerk|² dt for segment times, (B,) s.

    It starts and ends at rest. Raises InfeasibleError if no such motion stays in the boxes.
    """
    scale = float(np.sum(times))
    particular, free, hessian = _continuous_motions(tuple(np.round(times / scale, 12)))
    ends = np.stack([corridor.start, corridor.goal])
    offset = particular @ ends  # (18, 3)
    count, size = free.shape  # per axis
    linear = (free.T @ hessian @ offset).T.ravel()
    quadratic = np.kron(np.eye(3), free.T @ hessian @ free)
    rows = np.zeros((count * 3, 3 * size))
    low, high = np.empty(count * 3), np.empty(count * 3)
    for point in range(count):
        box = point // CONTROL_POINTS
        for side in range(3):
            axis, row = corridor.axes[box][:, side], 3 * point + side
            rows[row] = np.outer(axis, free[point]).ravel()
            low[row] = corridor.low[box, side] - axis @ offset[point]
            high[row] = corridor.high[box, side] - axis @ offset[point]
    answer = _solver(3 * size, len(rows))(h=quadratic, g=linear, a=rows, lba=low, uba=high)
    found = np.array(answer["x"]).reshape(3, size)
    points = offset + free @ found.T
    inside = rows @ found.ravel()
    if not np.isfinite(points).all() or (inside < low - 1e-5).any() or (inside > high + 1e-5).any():
        raise InfeasibleError("no motion at these times stays in the boxes", hint="give other times")
    return points.reshape(BOXES, CONTROL_POINTS, 3)


def timed_path(points: NDArray, times: NDArray) -> Path:
    """Return the motion as a path whose parameter s is time, s; at ds/dt = 1 it is flown with its own timing."""
    breaks = np.concatenate([[0.0], np.cumsum(times)])
    powers = np.stack([_powers() @ own for own in points])  # (B, 6, 3) of u = t / T
    powers /= times[:, None, None] ** np.arange(CONTROL_POINTS)[:, None]
    ended = np.stack([_about_end(powers[-1, :, axis], times[-1]) for axis in range(3)], axis=1)
    return Path(breaks, np.concatenate([powers[:-1], ended[None]]))


def least_time(points: NDArray, times: NDArray) -> float:
    """Return the least factor on times that keeps SPEED and ACCELERATION along a motion of unchanged shape."""
    speed, acceleration = 0.0, 0.0
    for own, seconds in zip(points, times, strict=True):
        first = _ORDER * np.diff(own, axis=0) / seconds
        second = (_ORDER - 1) * np.diff(first, axis=0) / seconds
        speed = max(speed, float(np.linalg.norm(_bernstein(_ORDER - 1) @ first, axis=1).max()))
        acceleration = max(acceleration, float(np.linalg.norm(_bernstein(_ORDER - 2) @ second, axis=1).max()))
    return max(speed / SPEED, (acceleration / ACCELERATION) ** 0.5)


@lru_cache(maxsize=64)
def _continuous_motions(times: tuple[float, ...]) -> tuple[NDArray, NDArray, NDArray]:
    """Return a basis of the continuous motions of one axis, and their cost.

    A motion is particular @ ends + free @ x: `particular`, (18, 2), has one end at 1 and the other at 0; `free`,
    (18, F), is zero at both ends. All are at rest at both ends. The cost matrix, (18, 18), gives ∫|jerk|² dt.
    """
    count = BOXES * CONTROL_POINTS
    rows, wanted = [], []
    for index, end in ((0, 0), (1, 0), (2, 0), (count - 1, 1), (count - 2, 1), (count - 3, 1)):
        row = np.zeros(count)
        row[index] = 1.0
        rows.append(row)
        wanted.append(np.eye(2)[end])
    for k in range(BOXES - 1):
        for order in range(CONTINUOUS + 1):
            row = np.zeros(count)
            signs = np.array([(-1) ** (order - j) * comb(order, j) for j in range(order + 1)], dtype=float)
            end = (k + 1) * CONTROL_POINTS
            row[end - order - 1 : end] = signs / times[k] ** order
            row[end : end + order + 1] -= signs / times[k + 1] ** order
            rows.append(row)
            wanted.append(np.zeros(2))
    equations = np.array(rows)
    particular = np.linalg.lstsq(equations, np.array(wanted), rcond=None)[0]
    free = np.linalg.svd(equations)[2][len(rows) :].T
    hessian = np.zeros((count, count))
    for k, seconds in enumerate(times):
        own = slice(k * CONTROL_POINTS, (k + 1) * CONTROL_POINTS)
        hessian[own, own] = _jerk() / seconds**5
    return particular, free, hessian


@cache
def _jerk() -> NDArray:
    """Return (6, 6): ∫₀¹ of the square of the third derivative of a quintic, by its control points."""
    third = np.diff(np.eye(CONTROL_POINTS), n=3, axis=0) * 60.0
    products = [[comb(2, i) * comb(2, j) / (comb(4, i + j) * 5) for j in range(3)] for i in range(3)]
    return np.asarray(third.T @ np.array(products) @ third)


@cache
def _bernstein(order: int) -> NDArray:
    u = np.linspace(0.0, 1.0, _SAMPLES)[:, None]
    j = np.arange(order + 1)
    return np.asarray(np.array([comb(order, k) for k in j]) * u**j * (1 - u) ** (order - j))


@cache
def _powers() -> NDArray:
    """Return (6, 6): from control points to coefficients of ascending powers of u in [0, 1]."""
    table = np.zeros((CONTROL_POINTS, CONTROL_POINTS))
    for power in range(CONTROL_POINTS):
        for j in range(power + 1):
            table[power, j] = comb(_ORDER, power) * comb(power, j) * (-1) ** (power - j)
    return table


def _about_end(coefficients: NDArray, seconds: float) -> NDArray:
    """Return the coefficients of p(t) in powers of t − seconds."""
    polynomial = np.polynomial.Polynomial(coefficients)
    found = polynomial(np.polynomial.Polynomial([seconds, 1.0])).coef
    return np.pad(found, (0, len(coefficients) - len(found)))


@cache
def _solver(size: int, rows: int) -> Any:
    import casadi

    shapes = {"h": casadi.Sparsity.dense(size, size), "a": casadi.Sparsity.dense(rows, size)}
    return casadi.conic("corridor", "daqp", shapes, {"error_on_fail": False})
