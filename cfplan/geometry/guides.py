"""Guides: points beside waypoints, on the straight lines between them, that keep a path of least snap near those.

Such a path swings out where it turns, by a share of the distance to the next points. In a room it may swing outside
though all waypoints lie inside; straight lines between them do not, as the room is convex. Where the lines turn back,
or almost, guides on them would let the path stop at the waypoint: there they lie apart, and it turns in a loop.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

_SHARE = 1.0 / 3.0  # of a line, the farthest that a guide is from its end
_APART = math.radians(40.0)  # between the directions to the guides of a waypoint, at least
_ASIDE = 1e-3  # rad between them, from which on they show to which side they are turned apart


def with_guides(points: ArrayLike, away: float, *, first_too: bool = True) -> tuple[NDArray, NDArray]:
    """Return points, (K, 3) m, with a guide on each side of every one, and the rows, (K,), where the points are then.

    Guides lie `away` m from their point, or a third of the line where that is shorter. Without `first_too` there is
    none behind the first point, as for a path that begins in motion.
    """
    given = np.asarray(points, dtype=float)
    lines = np.diff(given, axis=0)
    lengths = np.linalg.norm(lines, axis=1)
    distances = np.minimum(away, _SHARE * lengths)
    ahead = lines / lengths[:, None]  # towards the guide behind each point but the last
    back = -ahead  # towards the guide before each point but the first
    for number in range(1, len(given) - 1):
        back[number - 1], ahead[number] = _apart(back[number - 1], ahead[number])
    rows, found = [0], [given[0]]
    for number, distance in enumerate(distances):
        if number > 0 or first_too:
            found.append(given[number] + distance * ahead[number])
        found += [given[number + 1] + distance * back[number], given[number + 1]]
        rows.append(len(found) - 1)
    return np.array(found), np.array(rows)


def _apart(one: NDArray, other: NDArray) -> tuple[NDArray, NDArray]:
    """Return two directions, (3,) of length 1, turned away from each other until they are _APART."""
    across = other - (other @ one) * one
    sine = float(np.linalg.norm(across))
    angle = math.atan2(sine, float(other @ one))
    if angle >= _APART:
        return one, other
    if sine > _ASIDE:
        across /= sine
    else:  # to a side, so that the height stays
        across = np.array([-one[1], one[0], 0.0]) if abs(one[2]) < 1.0 - _ASIDE else np.array([1.0, 0.0, 0.0])
        across -= (across @ one) * one
        across /= np.linalg.norm(across)
    turn = (_APART - angle) / 2.0
    return (
        math.cos(turn) * one - math.sin(turn) * across,
        math.cos(angle + turn) * one + math.sin(angle + turn) * across,
    )
