"""Measure how far points lie from a path."""

import numpy as np
from numpy.typing import NDArray

from cfplan.machine_code import njit

BLOCK = 32  # segments that are skipped together if the box around them is farther away than the nearest so far


def distance_to_path(points: NDArray, path: NDArray) -> NDArray:
    """Return (N,) m from each of the points (N, 3) to the polyline through path (M, 3)."""
    corners = np.ascontiguousarray(path, dtype=float)
    if len(corners) == 1:
        corners = np.repeat(corners, 2, axis=0)
    begins = np.arange(0, len(corners) - 1, BLOCK)
    firsts = np.minimum(begins[:, None] + np.arange(BLOCK + 1), len(corners) - 1)
    low, high = corners[firsts].min(axis=1), corners[firsts].max(axis=1)
    return np.sqrt(_squares(np.ascontiguousarray(points, dtype=float), corners, low, high))


@njit
def _squares(points: NDArray, path: NDArray, low: NDArray, high: NDArray) -> NDArray:
    """Search block by block; each point begins with the block that was nearest to the point before it."""
    found = np.empty(len(points))
    nearest = 0
    for row in range(len(points)):
        point = points[row]
        best, start = np.inf, nearest
        for turn in range(len(low)):
            block = start + turn if start + turn < len(low) else start + turn - len(low)
            away = 0.0
            for axis in range(3):
                aside = max(low[block, axis] - point[axis], point[axis] - high[block, axis], 0.0)
                away += aside * aside
            if away >= best:
                continue
            for first in range(block * BLOCK, min((block + 1) * BLOCK, len(path) - 1)):
                square = _to_segment(point, path[first], path[first + 1])
                if square < best:
                    best, nearest = square, block
        found[row] = best
    return found


@njit
def _to_segment(point: NDArray, begin: NDArray, end: NDArray) -> float:
    """Return m² from a point to a straight line between two others."""
    along = length = 0.0
    for axis in range(3):
        step = end[axis] - begin[axis]
        along += (point[axis] - begin[axis]) * step
        length += step * step
    share = min(max(along / length, 0.0), 1.0) if length > 0 else 0.0
    square = 0.0
    for axis in range(3):
        off = point[axis] - begin[axis] - share * (end[axis] - begin[axis])
        square += off * off
    return square
