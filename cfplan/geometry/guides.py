"""Guides: points beside waypoints, on the straight lines between them, that keep a path of least snap near those.

Such a path swings out where it turns, by a share of the distance to the next points. In a room it may swing outside
though all waypoints lie inside; straight lines between them do not, as the room is convex.
"""

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

_SHARE = 1.0 / 3.0  # of a line, the farthest that a guide is from its end


def with_guides(points: ArrayLike, away: float, *, first_too: bool = True) -> tuple[NDArray, NDArray]:
    """Return points, (K, 3) m, with a guide on each side of every one, and the rows, (K,), where the points are then.

    Guides lie `away` m from their point, or a third of the line where that is shorter. Without `first_too` there is
    none behind the first point, as for a path that begins in motion.
    """
    given = np.asarray(points, dtype=float)
    rows, found = [0], [given[0]]
    for number, (begin, end) in enumerate(pairwise(given)):
        line = end - begin
        share = min(away / float(np.linalg.norm(line)), _SHARE)
        if number > 0 or first_too:
            found.append(begin + share * line)
        found += [end - share * line, end]
        rows.append(len(found) - 1)
    return np.array(found), np.array(rows)
