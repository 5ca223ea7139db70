"""The room of a chosen path: walls, obstacles, and the sides of a corridor along its straight lines."""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.machine_code import njit
from cfplan.safety.space import Box, Obstacle, Space

_LINK_LOSS_CLEARANCE = 0.15  # m, added to the margin of obstacles if link loss must end clear of them
_MOVED = 1e-6  # m, step of finite differences


class RoomFaces(NamedTuple):
    """The walls and obstacles of a room, for compiled code."""

    low: NDArray  # (3,) m, corners of the walls less their margin
    high: NDArray  # (3,) m
    obstacles: NDArray  # (K, 8) prisms, see safety/space.py
    clearance: float  # m, kept from obstacles


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

    @property
    def faces(self) -> RoomFaces:
        """Return the walls and obstacles."""
        space = self.space
        prisms = np.array([each.prism for each in space.obstacles]).reshape(-1, 8)
        low, high = np.array(space.low) + space.margin, np.array(space.high) - space.margin
        return RoomFaces(low, high, prisms, space.margin + self.beside)

    def penalty(self, positions: NDArray, leg: NDArray, reserve: float) -> tuple[NDArray, NDArray]:
        """Return how far each clearance falls below `reserve`, m, squared, (P,) m², and the gradient, (P, 3) m.

        `positions` is (P, 3) m, `leg`, (P,), as for aside().
        """
        squares, gradient = _penalties(np.ascontiguousarray(positions), self.faces, reserve)
        if self.corridor is None:
            return squares, gradient
        near = np.maximum(self.aside(positions, leg) + reserve, 0.0)
        for axis in range(3):
            moved = positions.copy()
            moved[:, axis] += _MOVED
            change = np.maximum(self.aside(moved, leg) + reserve, 0.0) - near
            gradient[:, axis] += 2.0 * near * change / _MOVED
        return squares + near**2, gradient


@njit(error_model="numpy")
def _penalties(positions: NDArray, faces: RoomFaces, reserve: float) -> tuple[NDArray, NDArray]:
    squares, gradient = np.empty(len(positions)), np.zeros_like(positions)
    for n in range(len(positions)):
        squares[n] = penalty_of(positions[n], gradient[n], faces, reserve)
    return squares, gradient


@njit(error_model="numpy")
def penalty_of(position: NDArray, gradient: NDArray, faces: RoomFaces, reserve: float) -> float:
    """Return how far the clearances of a position, (3,) m, fall below `reserve`, squared, m²; add its gradient."""
    squares = 0.0
    for axis in range(3):
        below, above = faces.low[axis] + reserve - position[axis], position[axis] + reserve - faces.high[axis]
        if below > 0.0:
            squares += below**2
            gradient[axis] -= 2.0 * below
        if above > 0.0:
            squares += above**2
            gradient[axis] += 2.0 * above
    for k in range(len(faces.obstacles)):
        prism = faces.obstacles[k]
        cos, sin = math.cos(prism[7]), math.sin(prism[7])
        dx, dy, z = position[0] - prism[0], position[1] - prism[1], position[2] - prism[2]
        x, y = cos * dx + sin * dy, cos * dy - sin * dx
        side, by_a, by_b = _joined(abs(x) - prism[3], abs(y) - prism[4])
        away, by_side, by_c = _joined(side - prism[6], abs(z) - prism[5])
        near = faces.clearance + reserve - away
        if near > 0.0:
            squares += near**2
            by_x, by_y = by_side * math.copysign(by_a, x), by_side * math.copysign(by_b, y)
            gradient[0] -= 2.0 * near * (cos * by_x - sin * by_y)
            gradient[1] -= 2.0 * near * (sin * by_x + cos * by_y)
            gradient[2] -= 2.0 * near * math.copysign(by_c, z)
    return squares


@njit(error_model="numpy")
def _joined(a: float, b: float) -> tuple[float, float, float]:
    """Return the distance to a corner from those to its sides, as Space has it, and its derivatives by both."""
    if a > 0.0 and b > 0.0:
        away = math.hypot(a, b)
        return away, a / away, b / away
    return (a, 1.0, 0.0) if a > b else (b, 0.0, 1.0)


def _column(obstacle: Obstacle, space: Space) -> Obstacle:
    """Return an obstacle extended from the floor to the ceiling."""
    floor, ceiling = space.low[2], space.high[2]
    if isinstance(obstacle, Box):
        return replace(obstacle, low=(*obstacle.low[:2], floor), high=(*obstacle.high[:2], ceiling))
    return replace(obstacle, low=floor, high=ceiling)
