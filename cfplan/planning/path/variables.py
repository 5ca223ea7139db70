"""The variables of a chosen path: segment times, points between waypoints, and points within regions.

All variables are free of bounds. A segment time is an exponential; where a point may move within a ball or a gate, the
variables are mapped onto it by q / √(1 + q²) (after Wang et al., 2022). All laps share their variables.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.geometry.continued import continued_through
from cfplan.geometry.min_snap import REST, least_snap
from cfplan.geometry.path import Path
from cfplan.geometry.waypoints import Gate, Region, Within

TIME_UNIT = 0.3  # of the logarithm of a segment time, a variable's unit
POINT_UNIT, LARGEST_POINT_UNIT = 0.15, 0.2  # of the distance to the nearer neighbour, and, m, at most: of a free point


class Knots(NamedTuple):
    """Times and points of a minimum-snap path."""

    times: NDArray  # (M,) s
    points: NDArray  # (M+1, 3) m
    waypoint: NDArray  # (K,) the numbers of the waypoints among the points
    start: NDArray | None = None  # (5, 3) γ to γ'''' if the path begins in motion; None: at rest

    @property
    def path(self) -> Path:
        """Return the path of least snap through the points. Raises InputError if there is none."""
        if self.start is None:
            return least_snap(self.points, self.times)
        return continued_through(self.start, self.points, self.times)

    @property
    def breaks(self) -> NDArray:
        """Return s at each point, (M+1,)."""
        return np.concatenate([[0.0], np.cumsum(self.times)])

    @property
    def start_derivatives(self) -> NDArray:
        """Return γ', γ'', γ''' at the start, (3, 3)."""
        return REST if self.start is None else self.start[1:4]


@dataclass(frozen=True, slots=True, eq=False)
class ChoiceVariables:
    """The variables of a choice, x, (n,), with the map to times and points, and its transpose for gradients."""

    start: Knots  # with all variables 0 except those of times
    axes: NDArray  # (P, 3, 3) m, rows: axes of motion of each point of a lap
    bounded: NDArray  # (P,) 0: unbounded, 1: within a ball, 2: within a box
    time_of: NDArray  # (M,) the number of each segment's variable
    point_of: NDArray  # (M+1,) the number of each point within its lap
    moving: NDArray  # (Q,) the points of a lap that may move

    @property
    def first(self) -> NDArray:
        """Return the variables of the start."""
        count = int(self.time_of.max()) + 1
        logs = np.log(self.start.times[:count])
        return np.concatenate([(logs - logs.mean()) / TIME_UNIT, np.zeros(3 * len(self.moving))])

    def knots(self, x: NDArray) -> Knots:
        """Return the times, scaled to the start's total, and the points of variables."""
        offsets, _ = self._offsets(x)
        points = self.start.points + offsets[self.point_of]
        return self.start._replace(times=self._times(x), points=points)

    def gradient(self, x: NDArray, by_times: NDArray, by_points: NDArray) -> NDArray:
        """Return the gradient by the variables, from those by times, (M,), and by points, (M+1, 3)."""
        times = self._times(x)
        by_logs = times * (by_times - by_times @ times / times.sum()) * TIME_UNIT
        of_lap = np.zeros((len(self.axes), 3))
        np.add.at(of_lap, self.point_of, by_points)
        _, slopes = self._offsets(x)
        by_moves = (slopes @ of_lap[self.moving, :, None])[..., 0]
        return np.concatenate([np.bincount(self.time_of, by_logs), by_moves.ravel()])

    def _times(self, x: NDArray) -> NDArray:
        logs = TIME_UNIT * x[self.time_of]
        times = np.exp(logs - logs.max())
        return np.asarray(times * (self.start.times.sum() / times.sum()))

    def _offsets(self, x: NDArray) -> tuple[NDArray, NDArray]:
        """Return how far the points of a lap moved, (P, 3) m, and the derivatives by their variables, (Q, 3, 3)."""
        q = x[int(self.time_of.max()) + 1 :].reshape(-1, 3)
        axes, bounded = self.axes[self.moving], self.bounded[self.moving, None]
        offsets = np.zeros((len(self.axes), 3))
        if not bounded.any():
            offsets[self.moving] = (q[:, None] @ axes)[:, 0]
            return offsets, axes
        squares = np.where(bounded == 1, (q**2).sum(axis=1, keepdims=True), q**2) * (bounded > 0)
        root = np.sqrt(1.0 + squares)
        offsets[self.moving] = np.einsum("pq,pqc->pc", q / root, axes)
        slopes = np.eye(3) / root[:, None]
        slopes -= np.where(bounded == 1, 1.0, 0.0)[..., None] * q[:, :, None] * q[:, None] / root[..., None] ** 3
        slopes -= np.where(bounded == 2, 1.0, 0.0)[..., None] * np.eye(3) * (q**2 / root**3)[:, None]
        return offsets, np.einsum("pqr,prc->pqc", slopes, axes)


def variables_of(knots: Knots, regions: tuple[Region, ...], laps: int, margin: float) -> ChoiceVariables:
    """Return the variables of a start: of its times, of points between waypoints, and of waypoints with regions.

    `regions` has one for each waypoint; `margin`, m, is kept from the sides of gates.
    """
    count, of_lap = len(knots.points), len(knots.times) // laps
    point_of = np.arange(count) if laps == 1 else np.arange(count) % of_lap
    points = knots.points[: point_of.max() + 1]
    steps = np.linalg.norm(np.diff(knots.points, axis=0), axis=1)
    near = np.minimum(np.append(steps, steps[-1]), np.append(steps[0], steps))[: len(points)]
    units = np.minimum(POINT_UNIT * near, LARGEST_POINT_UNIT)
    axes = units[:, None, None] * np.eye(3)
    bounded = np.zeros(len(points), dtype=int)
    moves = np.ones(len(points), dtype=bool)
    for point, region in zip(knots.waypoint, regions, strict=True):
        if point >= len(points):
            continue  # a later lap
        match region:
            case Within(radius):
                axes[point], bounded[point] = radius * np.eye(3), 1
            case Gate():
                axes[point], bounded[point] = np.vstack([region.half_axes(margin), np.zeros(3)]), 2
            case None:
                moves[point] = False
    return ChoiceVariables(knots, axes, bounded, np.arange(len(knots.times)) % of_lap, point_of, np.flatnonzero(moves))


def with_points_between(knots: Knots) -> Knots:
    """Return knots with one more between each two, where the path of least snap is half-way in time."""
    path, breaks = knots.path, knots.breaks
    points = np.empty((2 * len(knots.points) - 1, 3))
    points[::2], points[1::2] = knots.points, path((breaks[:-1] + breaks[1:]) / 2)
    return Knots(np.repeat(knots.times / 2, 2), points, 2 * knots.waypoint, knots.start)
