"""The space to fly in, and the check that a path stays within it."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cfplan.errors import InfeasibleError
from cfplan.geometry.path import Path
from cfplan.numbers import coordinates

_SAMPLES = 33  # of each piece of a path
_AXES = ("x", "y", "z")
TOLERANCE = 1e-6
"""m that a position may lie beyond a wall, or a margin before it, and count as inside: a thousandth of the rounding in
packets, and far above the rounding of sums and of a path's equations. A path drawn at the margin keeps it."""
_MILLIMETRES = 30.0  # larger coordinates of a path that lies in the space when divided by 1000 are in millimetres


def inside(beyond: ArrayLike, rounding: float = 0.0) -> Any:
    """Return whether positions count as inside that are `beyond` a wall, or a margin before it, m; NaN does not.

    All comparisons with walls use this function. `rounding`, m, is by how much the positions were rounded before.
    """
    return np.asarray(beyond) <= TOLERANCE + rounding


@dataclass(frozen=True, slots=True)
class Space:
    """A box, and the distance that plans keep from its walls."""

    low: tuple[float, float, float]  # m
    high: tuple[float, float, float]  # m
    margin: float  # m, positive

    def beyond(self, positions: ArrayLike) -> NDArray:
        """Return (N, 3) m: how far each coordinate lies beyond the box less its margin; negative inside."""
        points = np.asarray(positions, dtype=float)
        return np.maximum(np.array(self.low) + self.margin - points, points - (np.array(self.high) - self.margin))

    def holds(self, positions: ArrayLike, rounding: float = 0.0) -> bool:
        """Return whether all positions, (..., 3) m, are inside the box less its margin; see inside()."""
        return bool(np.all(inside(self.beyond(positions), rounding)))


def check_space(path: Path, space: Space, *, waypoints: ArrayLike | None = None, where: str = "") -> None:
    """Refuse a path that leaves the space or its margin anywhere, at waypoints or between them.

    Raises:
        InfeasibleError: naming the first waypoint at fault, else the worst place, and by how much.
    """
    if waypoints is not None:
        points = np.asarray(waypoints, dtype=float)
        if np.abs(points).max(initial=0.0) > _MILLIMETRES and space.holds(points / 1000.0):
            x, y, z = points[0]
            raise InfeasibleError(
                f"the waypoints are in millimetres: the first, ({x:g}, {y:g}, {z:g}), is to be in metres",
                where=where,
                hint=f"divide all coordinates by 1000: the first is then [{x / 1000:g}, {y / 1000:g}, {z / 1000:g}]",
            )
        for number, point in enumerate(points, start=1):
            if not space.holds(point):
                _refuse(space, point, f"waypoint {number}", where)
    s, beyond = distances_beyond(path, space)
    worst = np.unravel_index(np.argmax(beyond), beyond.shape)
    if not inside(beyond[worst]):
        _refuse(space, path(s[worst]), f"the path at s = {s[worst]:.2f} of {path.end:.2f} m", where)


def distances_beyond(path: Path, space: Space) -> tuple[NDArray, NDArray]:
    """Return s, (M, N), along each of the M pieces, and how far the path lies beyond the space around there, (M, N) m.

    The distance is that of the worst coordinate from the box less its margin, negative inside. It holds between the
    samples too, where a coordinate exceeds both by at most step² / 8 of its second derivative.
    """
    s = path.breaks[:-1, None] + np.diff(path.breaks)[:, None] * np.linspace(0.0, 1.0, _SAMPLES)
    bend = np.abs(path(s, 2)).max(axis=1)
    step = np.diff(path.breaks) / (_SAMPLES - 1)
    between = (step[:, None] ** 2 / 8 * bend)[:, None]
    return s, (space.beyond(path(s)) + between).max(axis=-1)


def _refuse(space: Space, point: NDArray, what: str, where: str) -> None:
    beyond = space.beyond(point)
    axis = int(np.argmax(np.where(np.isfinite(beyond), beyond, np.inf)))
    low = bool(point[axis] < (space.low[axis] + space.high[axis]) / 2)
    outside = beyond[axis] - space.margin
    far = f"{outside:.3f} m beyond" if outside > 0 else f"{abs(outside):.3f} m from"
    raise InfeasibleError(
        f"{what}, {coordinates(point, '.3f')} m, is {far} {_side(space, axis, low)}, "
        f"{max(beyond[axis], 0.0):.3f} m too far with the margin of {space.margin:g} m",
        where=where,
        hint="move or place the path, or correct `space` in safety.yaml if the room is larger",
    )


def _side(space: Space, axis: int, low: bool) -> str:
    """Return what people call a side of the box."""
    name = ("the floor" if low else "the ceiling") if axis == 2 else "the wall"
    return f"{name} {_AXES[axis]} = {(space.low if low else space.high)[axis]:g} m"
