"""The room of a chosen path: walls, obstacles, and the sides of a corridor along its straight lines."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cfplan.safety.space import SIDES, Box, Obstacle, Space

_LINK_LOSS_CLEARANCE = 0.15  # m, added to the margin of obstacles if link loss must end clear of them
_MOVED = 1e-6  # m, step of finite differences


@dataclass(frozen=True, slots=True, eq=False)
class Room:
    """The space, and how far from the straight lines between waypoints a path may lead."""

    space: Space
    waypoints: NDArray  # (K, 3) m
    corridor: float | None  # m
    beside: float = 0.0  # m, added to the margin of obstacles where possible

    def to_come_down(self) -> "Room":
        """Return the room for a vehicle that must come down clear of obstacles wherever it loses link.

        Obstacles are extended from the floor to the ceiling, unless a waypoint is above, below or too near.
        """
        columns = []
        for each in self.space.obstacles:
            column = _column(each, self.space)
            alone = replace(self.space, obstacles=(column,))
            columns.append(column if alone.holds(self.waypoints) else each)
        return replace(self, space=replace(self.space, obstacles=tuple(columns)), beside=_LINK_LOSS_CLEARANCE)

    def beyond(self, positions: NDArray, leg: NDArray) -> NDArray:
        """Return how far positions, (P, 3) m, are beyond each face and side, (P, F) m; negative inside."""
        beyond = self.space.beyond(positions)
        return beyond if self.corridor is None else np.append(beyond, self.aside(positions, leg)[:, None], axis=1)

    def aside(self, positions: NDArray, leg: NDArray) -> NDArray:
        """Return how far positions, (P, 3) m, are outside the corridor, (P,) m; negative inside.

        `leg`, (P,), is the number of the straight line of each; the lines before and after it count too.
        """
        lines = np.clip(leg[:, None] + [-1, 0, 1], 0, len(self.waypoints) - 2)
        begin, step = self.waypoints[lines], self.waypoints[lines + 1] - self.waypoints[lines]
        away = positions[:, None] - begin
        along = np.clip((away * step).sum(axis=-1) / (step**2).sum(axis=-1), 0.0, 1.0)
        aside = np.linalg.norm(away - along[..., None] * step, axis=-1).min(axis=1)
        return np.asarray(aside - (np.inf if self.corridor is None else self.corridor))

    def penalty(self, positions: NDArray, leg: NDArray, reserve: float) -> tuple[NDArray, NDArray]:
        """Return how far each clearance falls below `reserve`, m, squared, (P,) m², and the gradient, (P, 3) m.

        `positions` is (P, 3) m.
        """
        near = np.maximum(self._wanted(positions, leg, reserve), 0.0)
        gradient = np.zeros_like(positions)
        rows = np.flatnonzero(near.any(axis=1))
        for axis in range(3 if len(rows) else 0):
            moved = positions[rows]
            moved[:, axis] += _MOVED
            change = np.maximum(self._wanted(moved, leg[rows], reserve), 0.0) - near[rows]
            gradient[rows, axis] = 2.0 * (near[rows] * change).sum(axis=1) / _MOVED
        return (near**2).sum(axis=1), gradient

    def _wanted(self, positions: NDArray, leg: NDArray, reserve: float) -> NDArray:
        beyond = self.beyond(positions, leg) + reserve
        beyond[:, SIDES : SIDES + len(self.space.obstacles)] += self.beside
        return beyond


def _column(obstacle: Obstacle, space: Space) -> Obstacle:
    """Return an obstacle extended from the floor to the ceiling."""
    floor, ceiling = space.low[2], space.high[2]
    if isinstance(obstacle, Box):
        return replace(obstacle, low=(*obstacle.low[:2], floor), high=(*obstacle.high[:2], ceiling))
    return replace(obstacle, low=floor, high=ceiling)
