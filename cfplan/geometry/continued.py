"""Continued paths: curves that begin in motion, with given γ to γ'''', and end at rest.

If a path begins with the derivatives of another one at some place, in the same unit of s, a speed profile continues
across that joint by its boundary state: velocity, acceleration and jerk do not jump, and snap only with h'''.

Pieces of degree 7 can begin with any γ', γ'', γ'''. The missing part of γ'''' is added as a polynomial of degree 9 that
vanishes at its end with four derivatives. Its snap does not depend on its length, and it moves the curve less the
shorter it is.
"""

import math
from math import factorial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cfplan.errors import InputError
from cfplan.geometry.min_snap import (
    MIN_SPACING,
    centripetal_times,
    check_points,
    check_times,
    pieces_through,
)
from cfplan.geometry.path import Path
from cfplan.geometry.polynomials import hermite, padded, shifted

ORDERS = 5  # γ and four derivatives
BLEND = 0.4  # s of nominal time, over which a given γ'''' fades; at most half of the first segment
_HERMITE = hermite(ORDERS)
_FACTORIALS = np.array([factorial(order) for order in range(ORDERS)], dtype=float)[:, None]


def continued_min_snap(start: ArrayLike, waypoints: ArrayLike, times: ArrayLike | None = None) -> Path:
    """Return the path of least snap that begins with γ to γ'''' as `start`, (5, 3), has them, and ends at rest.

    It goes through the waypoints, (K, 3) m, K at least 1; `times`, (K,) s of nominal time, are those of the segments
    that end in each, by default centripetal. From a state of another minimum-snap path
    through the same waypoints, with its remaining times, the result is the rest of that path.

    Raises:
        InputError: two points in a row closer than MIN_SPACING, numbers that are not finite, times that are not
            positive.
    """
    begin, points = check_continued(start, waypoints)
    return continued_through(begin, points, centripetal_times(points) if times is None else check_times(points, times))


def continued_through(start: NDArray, points: NDArray, times: NDArray) -> Path:
    """Return the same from a start, points and segment times, (K,) s, that have been checked."""
    return _fitted(start, times, pieces_through(points, times, start=start[1:4], rest_end=True))


def check_continued(start: ArrayLike, waypoints: ArrayLike) -> tuple[NDArray, NDArray]:
    """Return the start, (5, 3), and the points, (K+1, 3), the first of which is the start's.

    Raises InputError like continued_min_snap().
    """
    begin, ahead = np.asarray(start, dtype=float), np.asarray(waypoints, dtype=float)
    if begin.shape != (ORDERS, 3) or not np.isfinite(begin).all():
        raise InputError(
            f"a path continues from finite γ to γ'''', (5, 3), not from {begin.tolist()}",
            where="start",
            hint="take them from the path that is flown",
        )
    if ahead.ndim != 2 or ahead.shape[1] != 3 or not len(ahead):
        raise InputError(
            f"each waypoint must be x, y, z; the array has shape {ahead.shape}",
            where="waypoints",
            hint="give an array (K, 3) in metres, of one waypoint at least",
        )
    points = np.concatenate([begin[:1], ahead])
    if len(ahead) > 1:
        check_points(ahead, MIN_SPACING)
    away = math.dist(points[0], points[1])
    if not away >= MIN_SPACING:
        raise InputError(
            f"the path begins {away:.4f} m from its first waypoint, less than {MIN_SPACING} m",
            where="waypoint 1",
            hint="leave it out: it has been passed",
        )
    check_points(points[:2], MIN_SPACING, lambda index: f"waypoint {index}" if index else "start")
    return begin, points


def _fitted(start: NDArray, spans: NDArray, table: NDArray) -> Path:
    """Return the path of pieces, (M, D, 3) about their left ends, with γ'''' at the start added."""
    blend = min(BLEND, spans[0] / 2)
    table = padded(table, max(2 * ORDERS, table.shape[1]))
    table = np.concatenate([table[:1], shifted(table[:1], np.array([blend])), table[1:]])
    spans = np.concatenate([[blend, spans[0] - blend], spans[1:]])

    missing = np.zeros((2 * ORDERS, 3))
    missing[4] = (start[4] - _FACTORIALS[4] * table[0, 4]) * blend**4
    table[0, : 2 * ORDERS] += (_HERMITE @ missing) / blend ** np.arange(2 * ORDERS)[:, None]
    table[0, :ORDERS] = start / _FACTORIALS  # to the last digit

    table[-1] = shifted(table[-1:], spans[-1:])[0]
    table[-1, 1:4] = 0.0
    return Path(np.concatenate([[0.0], np.cumsum(spans)]), table)
