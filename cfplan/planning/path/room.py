"""What a chosen path keeps clear of: walls, obstacles, and the sides of a corridor along its straight lines."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.safety.space import Space

_MOVED = 1e-6  # m, to find in which direction a position lies further inside


@dataclass(frozen=True, slots=True, eq=False)
class Room:
    """The space, and how far from the straight lines between waypoints a path may lead."""

    space: Space
    waypoints: NDArray  # (K, 3) m
    corridor: float | None  # m

    def beyond(self, positions: NDArray, leg: NDArray) -> NDArray:
        """Return how far positions, (P, 3) m, lie beyond each wall, obstacle and side, (P, F) m; negative inside.

        `leg`, (P,), is which straight line each position belongs to; near a waypoint the next or last one counts too.
        """
        beyond = self.space.beyond(positions)
        if self.corridor is None:
            return beyond
        lines = np.clip(leg[:, None] + [-1, 0, 1], 0, len(self.waypoints) - 2)
        begin, step = self.waypoints[lines], self.waypoints[lines + 1] - self.waypoints[lines]
        away = positions[:, None] - begin
        along = np.clip((away * step).sum(axis=-1) / (step**2).sum(axis=-1), 0.0, 1.0)
        aside = np.linalg.norm(away - along[..., None] * step, axis=-1).min(axis=1)
        return np.concatenate([beyond, (aside - self.corridor)[:, None]], axis=1)

    def penalty(self, positions: NDArray, leg: NDArray, reserve: float) -> tuple[float, NDArray]:
        """Return the sum of squares, m², by which positions come nearer than `reserve`, m, and its gradient, (P, 3) m.

        `positions` is (P, 3) m.
        """
        near = np.maximum(self.beyond(positions, leg) + reserve, 0.0)
        gradient = np.zeros_like(positions)
        rows = np.flatnonzero(near.any(axis=1))
        for axis in range(3):
            moved = positions[rows]
            moved[:, axis] += _MOVED
            change = np.maximum(self.beyond(moved, leg[rows]) + reserve, 0.0) - near[rows]
            gradient[rows, axis] = 2.0 * (near[rows] * change).sum(axis=1) / _MOVED
        return float((near**2).sum()), gradient
