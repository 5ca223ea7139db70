"""Corners of a short way around obstacles, where the straight way between two waypoints is blocked.

The way is the shortest on a grid of the free space, without corners that can be skipped in a straight line. The search
for a path begins with it; it determines the side on which the path passes each obstacle.
"""

import itertools
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from cfplan.safety.space import Space, inside

FINEST, MOST_PLACES = 0.1, 60_000  # m between places of the grid at least, and places at most
_SIGHT = 0.02  # m between places on a straight way, at most


def with_corners(waypoints: NDArray, space: Space) -> tuple[NDArray, NDArray]:
    """Return waypoints, (K, 3) m, with corners on blocked ways between them, and the rows of the waypoints, (K,).

    A way without a detour is left unchanged.
    """
    found, rows = [waypoints[0]], [0]
    for begin, end in itertools.pairwise(waypoints):
        if space.obstacles and not _in_sight(begin, end, space):
            found += _grid(space).corners(begin, end)
        found.append(end)
        rows.append(len(found) - 1)
    return np.array(found), np.array(rows)


def _in_sight(begin: NDArray, end: NDArray, space: Space) -> bool:
    """Return whether the straight way between two places is clear."""
    count = 2 + int(np.linalg.norm(end - begin) / _SIGHT)
    return bool(inside(space.farthest(np.linspace(begin, end, count))))


@lru_cache(maxsize=2)  # in flight the same room is queried repeatedly
def _grid(space: Space) -> "_Grid":
    return _Grid(space)


class _Grid:
    """A grid of places in a space, which of them are clear, and the edges between neighbours."""

    def __init__(self, space: Space) -> None:
        from scipy.sparse import coo_array  # slow to import

        low, high = np.array(space.low) + space.margin, np.array(space.high) - space.margin
        self.space = space
        spacing = max(FINEST, float(np.prod(high - low) / MOST_PLACES) ** (1 / 3))
        shape = np.maximum(np.ceil((high - low) / spacing).astype(int), 1) + 1
        axes = [np.linspace(a, b, count) for a, b, count in zip(low, high, shape, strict=True)]
        self.places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        self.clear = inside(space.nearest(self.places)[0])
        number = np.arange(len(self.places)).reshape(shape)
        rows, columns = [], []
        for step in itertools.product((-1, 0, 1), repeat=3):
            if step > (0, 0, 0):  # the other half are the same edges reversed
                here = tuple(slice(max(-each, 0), min(n - each, n)) for each, n in zip(step, shape, strict=True))
                there = tuple(slice(max(each, 0), min(n + each, n)) for each, n in zip(step, shape, strict=True))
                rows.append(number[here].ravel())
                columns.append(number[there].ravel())
        one, other = np.concatenate(rows), np.concatenate(columns)
        both = self.clear[one] & self.clear[other]
        one, other = one[both], other[both]
        length = np.linalg.norm(self.places[one] - self.places[other], axis=1)
        self.ways = coo_array((length, (one, other)), shape=(len(self.places),) * 2).tocsr()

    def corners(self, begin: NDArray, end: NDArray) -> list[NDArray]:
        """Return the corners of a short way between two places; none if there is no way."""
        from scipy.sparse.csgraph import dijkstra

        first, last = self._nearest(begin), self._nearest(end)
        if first is None or last is None:
            return []
        _, before = dijkstra(self.ways, directed=False, indices=first, return_predecessors=True)
        way = [end]
        at = last
        while at >= 0:
            way.append(self.places[at])
            at = int(before[at])
        if len(way) == 2 and first != last:
            return []
        way = [*way, begin][::-1]
        corners, at = [], 0
        while not _in_sight(way[at], end, self.space):
            further = (n for n in range(len(way) - 1, at + 1, -1) if _in_sight(way[at], way[n], self.space))
            at = next(further, at + 1)
            if at == len(way) - 1:
                break
            corners.append(way[at])
        return corners

    def _nearest(self, place: NDArray) -> int | None:
        """Return the number of the nearest clear place; None if there is none."""
        if not self.clear.any():
            return None
        away = np.where(self.clear, ((self.places - place) ** 2).sum(axis=1), np.inf)
        return int(np.argmin(away))
