"""The space to fly in, its obstacles, and the check that a path stays clear of its faces.

A face is a wall, the floor, the ceiling, or the surface of an obstacle; plans keep the same margin from each.
"""

import itertools
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cfplan.errors import InfeasibleError
from cfplan.geometry.path import Path
from cfplan.numbers import coordinates, shown

_SAMPLES = 33  # of each piece of a path
_AXES = ("x", "y", "z")
FLOOR = 2  # its number among the faces
SIDES = 6  # faces of the room itself, with floor and ceiling; obstacles follow
TOLERANCE = 1e-6
"""m, tolerance of walls and margins: a thousandth of the rounding in packets, far above the rounding of sums and of a
path's equations. A path drawn at the margin keeps it."""
_MILLIMETRES = 30.0  # larger coordinates count as millimetres if a thousandth of the path lies in the space
_BLOCK = 16  # consecutive positions whose bounding box is checked first
_ROUND = 33  # points of a cylinder's outline in drawings
_AT_ONCE = 1 << 14  # most distances between positions and obstacles computed at once
_PARTS, _LEVELS = 8, 6  # parts into which an undecided stretch of a path is cut, and most repetitions
_WORST = 1e-4  # m, largest error of the least distance between a path and the obstacles


def inside(beyond: ArrayLike, rounding: float = 0.0) -> Any:
    """Return whether positions `beyond` a face or its margin by this much, m, count as inside; NaN does not.

    All comparisons with walls and obstacles use this function. `rounding`, m, is the rounding of the positions.
    """
    return np.asarray(beyond) <= TOLERANCE + rounding


@dataclass(frozen=True, slots=True)
class Box:
    """An obstacle between two corners, turned by `yaw` about the vertical through its middle."""

    low: tuple[float, float, float]  # m
    high: tuple[float, float, float]  # m
    yaw: float = 0.0  # rad
    name: str = ""

    @property
    def prism(self) -> tuple[float, ...]:
        """Return its row in the table of prisms."""
        middle, half = np.add(self.low, self.high) / 2, np.subtract(self.high, self.low) / 2
        return (*middle.tolist(), *half.tolist(), 0.0, self.yaw)


@dataclass(frozen=True, slots=True)
class Cylinder:
    """A vertical, round obstacle."""

    x: float  # m
    y: float  # m
    radius: float  # m
    low: float  # m, z of its foot
    high: float  # m, z of its top
    name: str = ""

    @property
    def prism(self) -> tuple[float, ...]:
        """Return its row in the table of prisms."""
        return (self.x, self.y, (self.low + self.high) / 2, 0.0, 0.0, (self.high - self.low) / 2, self.radius, 0.0)


Obstacle = Box | Cylinder


def outline(obstacle: Obstacle) -> NDArray:
    """Return the outline of an obstacle from above, (N, 2) m, as a closed polygon."""
    x, y, _, a, b, _, radius, yaw = obstacle.prism
    turn = np.linspace(0.0, 2.0 * np.pi, _ROUND) if radius else np.pi * (np.arange(5) / 2 + 0.25)
    flat = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    own = radius * flat if radius else np.sign(flat) * (a, b)
    return np.array([x, y]) + own @ np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])


@dataclass(frozen=True, slots=True)
class Space:
    """A box, its obstacles, and the margin that plans keep from walls and obstacles."""

    low: tuple[float, float, float]  # m
    high: tuple[float, float, float]  # m
    margin: float  # m, positive
    obstacles: tuple[Obstacle, ...] = ()

    def beyond(self, positions: ArrayLike, half: ArrayLike = 0.0) -> NDArray:
        """Return (..., 6 + K) m: how far positions, (..., 3) m, are beyond each face less its margin; negative: clear.

        The faces are in the order of `faces`. For an obstacle it is the margin less the distance from it, which is
        negative within it. With `half`, (..., 3) m, each position is the middle of a box with these half-sizes.
        """
        points, half = np.asarray(positions, dtype=float), np.asarray(half, dtype=float)
        walls = [
            np.array(self.low) + self.margin - (points - half),
            points + half - (np.array(self.high) - self.margin),
        ]
        if not self.obstacles:
            return np.concatenate(walls, axis=-1)
        around = half[..., None, :] if half.ndim else half
        return np.concatenate(
            [*walls, self.margin - _distances(_prisms(self.obstacles), points[..., None, :], around)], axis=-1
        )

    def nearest(self, positions: ArrayLike, half: ArrayLike = 0.0, *, floor: bool = True) -> tuple[NDArray, NDArray]:
        """Return how far positions, (N, 3) m, are beyond their worst face, (N,) m, and its number, (N,).

        This is the largest of beyond(), but faster and with less memory for many obstacles. The floor may be left out.
        """
        points = np.asarray(positions, dtype=float)
        sizes = np.broadcast_to(np.asarray(half, dtype=float), points.shape)
        room = replace(self, obstacles=()).beyond(points, sizes)
        if not floor:
            room[:, FLOOR] = -np.inf
        most, face = room.max(axis=1), room.argmax(axis=1)
        if not self.obstacles:
            return most, face
        prisms, together = _prisms(self.obstacles), max(_AT_ONCE // len(self.obstacles), 1)
        for begin in range(0, len(points), together):
            some = slice(begin, begin + together)
            near = _near(prisms, points[some], sizes[some])
            away = _distances(prisms.only(near), points[some, None], sizes[some, None])
            which = away.argmin(axis=1)
            beyond = self.margin - away[np.arange(len(away)), which]
            closer = ~(beyond <= most[some])  # NaN is the worst
            most[some] = np.where(closer, beyond, most[some])
            face[some] = np.where(closer, SIDES + near[which], face[some])
        return most, face

    def farthest(self, positions: NDArray) -> float:
        """Return how far the worst of positions, (N, 3) m, is beyond a face less its margin, m.

        For many positions along a way. If all are clear, obstacles may be farther away than the result.
        """
        low, high = positions.min(axis=0), positions.max(axis=0)
        beyond = self.beyond((low + high) / 2, (high - low) / 2)  # of a box around all
        near = ~(beyond[SIDES:] <= 0.0)
        clear = float(np.where(near, -np.inf, beyond[SIDES:]).max(initial=-np.inf))
        if not near.any():
            return max(float(beyond[:SIDES].max()), clear)
        close = replace(self, obstacles=tuple(itertools.compress(self.obstacles, near)))
        begins = np.arange(0, len(positions), _BLOCK)
        low, high = np.minimum.reduceat(positions, begins), np.maximum.reduceat(positions, begins)
        bound, _ = close.nearest((low + high) / 2, (high - low) / 2)
        open_ = ~(bound <= 0.0)
        exact, _ = close.nearest(positions[np.repeat(open_, np.diff(begins, append=len(positions)))])
        return float(max(exact.max(initial=-np.inf), bound[~open_].max(initial=-np.inf), clear))

    def above_floor(self, positions: NDArray) -> tuple[NDArray, NDArray]:
        """Return, like nearest(), how far the columns between the floor and positions, (N, 3) m, are beyond a face."""
        half = 0.5 * (positions[:, 2] - self.low[2])
        columns = np.stack([positions[:, 0], positions[:, 1], positions[:, 2] - half], axis=1)
        return self.nearest(columns, np.stack([0.0 * half, 0.0 * half, half], axis=1), floor=False)

    def swept(self, boxes: NDArray) -> tuple[NDArray, NDArray]:
        """Return how far vehicles come beyond their worst face without its margin, (N,) m, and its number, (N,).

        `boxes`, (N, S, 2, 3) m, are swept in S parts of each way to the floor; the floor itself does not count.
        """
        low, high = boxes[:, :, 0].reshape(-1, 3), boxes[:, :, 1].reshape(-1, 3)
        beyond, face = (
            each.reshape(boxes.shape[:2]) for each in self.nearest((low + high) / 2, (high - low) / 2, floor=False)
        )
        number, worst = np.arange(len(boxes)), beyond.argmax(axis=1)
        return beyond[number, worst] - self.margin, face[number, worst]

    def describe(self, beyond: float, face: int) -> str:
        """Describe a place that is `beyond`, m, a face: "0.12 m beyond the wall x = 2 m"."""
        clear, past = ("from", "into") if face >= SIDES else ("inside", "beyond")
        return f"{abs(beyond):.2f} m {clear if inside(beyond) else past} {self.faces[face]}"

    def too(self, face: int) -> str:
        """Return how messages describe a place beyond a face or its margin: "far out", "near the obstacle 'table'"."""
        return f"near {self.faces[face]}" if face >= SIDES else "far out"

    def holds(self, positions: ArrayLike, rounding: float = 0.0) -> bool:
        """Return whether all positions, (..., 3) m, keep the margin from all faces; see inside()."""
        return bool(np.all(inside(self.beyond(positions), rounding)))

    @property
    def faces(self) -> tuple[str, ...]:
        """Return the name of each of the 6 + K faces in messages: "the wall x = 2 m", "the obstacle 'table'"."""
        named = (
            f"the obstacle {each.name!r}" if each.name else f"obstacle {number}"
            for number, each in enumerate(self.obstacles, start=1)
        )
        return (*_walls(self.low, "floor"), *_walls(self.high, "ceiling"), *named)


def _walls(corner: tuple[float, float, float], level: str) -> list[str]:
    kinds = ("wall", "wall", level)
    return [f"the {kind} {axis} = {shown(at, 'g')} m" for kind, axis, at in zip(kinds, _AXES, corner, strict=True)]


class _Prisms(NamedTuple):
    """Upright prisms: rectangles whose sides are pushed out by a radius, from z - half to z + half."""

    middle: NDArray  # (K, 3) m
    half: NDArray  # (K, 3) m
    radius: NDArray  # (K,) m
    cos: NDArray  # (K,) of the yaw
    sin: NDArray  # (K,)

    def only(self, numbers: NDArray) -> "_Prisms":
        """Return the prisms with these numbers."""
        return _Prisms(*(values[numbers] for values in self))

    def of_rows(self, numbers: NDArray) -> "_Prisms":
        """Return one prism for each of P rows of points, (P, N, 3)."""
        return _Prisms(*(values[numbers][:, None] for values in self))


@lru_cache(maxsize=8)
def _prisms(obstacles: tuple[Obstacle, ...]) -> _Prisms:
    """Return obstacles as prisms: a box has radius 0, and the rectangle of a cylinder is a point."""
    table = np.array([each.prism for each in obstacles])
    return _Prisms(table[:, :3], table[:, 3:6], table[:, 6], np.cos(table[:, 7]), np.sin(table[:, 7]))


def _offsets(prisms: _Prisms, points: NDArray, half: ArrayLike = 0.0) -> tuple[NDArray, NDArray]:
    """Return places in each prism's own axes, and how far they are beyond its rectangle and its height, (..., K, 3)."""
    x, y, z = np.moveaxis(points - prisms.middle, -1, 0)
    own = np.stack([prisms.cos * x + prisms.sin * y, prisms.cos * y - prisms.sin * x, z], axis=-1)
    a, b, c = np.moveaxis(np.broadcast_to(half, (*np.shape(half)[:-1], 3)), -1, 0)
    cos, sin = np.abs(prisms.cos), np.abs(prisms.sin)
    size = np.stack(np.broadcast_arrays(cos * a + sin * b, cos * b + sin * a, c), axis=-1)
    return own, np.abs(own) - (prisms.half + size)


def _joined(a: NDArray, b: NDArray) -> NDArray:
    """Return the distance to a corner from those to its sides: Euclidean outside, that of the nearer side inside."""
    return np.hypot(np.maximum(a, 0.0), np.maximum(b, 0.0)) + np.minimum(np.maximum(a, b), 0.0)


def _distances(prisms: _Prisms, points: NDArray, half: ArrayLike = 0.0) -> NDArray:
    """Return the signed distance, m, of points, (..., 1, 3) or (..., K, 3), from each prism, (..., K).

    It is a convex function of the position. With `half`, half the size of boxes about the points, it is the distance of
    the boxes, or less if the prism is turned.
    """
    _, over = _offsets(prisms, points, half)
    return _joined(_joined(over[..., 0], over[..., 1]) - prisms.radius, over[..., 2])


def _near(prisms: _Prisms, points: NDArray, half: NDArray) -> NDArray:
    """Return the numbers of the prisms that may be the nearest to one of the points, (N, 3)."""
    low, high = (points - half).min(axis=0), (points + half).max(axis=0)
    reach = float(np.linalg.norm(high - low)) / 2
    away = _distances(prisms, (low + high) / 2)
    return np.flatnonzero(~(away > away.min() + 2.0 * reach))


def _distances_with_slopes(prisms: _Prisms, points: NDArray) -> tuple[NDArray, NDArray]:
    """Return signed distances and their gradients, (..., K, 3); at a corner, the gradient of one side."""
    own, over = _offsets(prisms, points)
    sign = np.sign(own)
    flat, to_sides = _slope(over[..., 0], over[..., 1])
    distance, to_ends = _slope(flat - prisms.radius, over[..., 2])
    u, v = (to_ends[0] * side * sign[..., axis] for axis, side in enumerate(to_sides))
    out = [prisms.cos * u - prisms.sin * v, prisms.sin * u + prisms.cos * v, to_ends[1] * sign[..., 2]]
    return distance, np.stack(out, axis=-1)


def _slope(a: NDArray, b: NDArray) -> tuple[NDArray, tuple[NDArray, NDArray]]:
    """Return _joined(), and its derivatives."""
    joined, outside = _joined(a, b), np.maximum(a, b) > 0.0
    size = np.where(outside, joined, 1.0)
    by_a = np.where(outside, np.maximum(a, 0.0) / size, a >= b)
    return joined, (by_a, np.where(outside, np.maximum(b, 0.0) / size, a < b))


def check_space(path: Path, space: Space, *, waypoints: ArrayLike | None = None, where: str = "") -> None:
    """Refuse a path that leaves the space, or comes within the margin of a face, anywhere.

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
    """Return s, (M, N), along each of the M pieces, and how far the path is beyond the space around there, (M, N) m.

    The distance is that of the worst face less its margin, negative inside. It holds between the samples too, where a
    coordinate exceeds both by at most step² / 8 of its second derivative; s is about where it is worst.
    """
    s = _samples(path)
    places, bend = path(s), np.abs(path(s, 2)).max(axis=1)
    step = np.diff(path.breaks) / (_SAMPLES - 1)
    between = (step[:, None] ** 2 / 8 * bend)[:, None]
    room = replace(space, obstacles=())
    beyond = (room.beyond(places) + np.concatenate([between, between], axis=-1)).max(axis=-1)
    if not space.obstacles:
        return s, beyond
    at, near = beyond_obstacles(path, space)
    return np.where(near > beyond, at, s), np.maximum(near, beyond)


class _Stretches(NamedTuple):
    """Stretches of a path beside one obstacle each."""

    cell: NDArray  # (C,) int: index of the result that each belongs to
    piece: NDArray  # (C,) int
    obstacle: NDArray  # (C,) int
    ends: NDArray  # (C, 2): s
    least: NDArray  # (C,) m, lower bound on how far it comes beyond that obstacle less its margin
    most: NDArray  # (C,) m, upper bound on the same
    worst: NDArray  # (C,) s, about where it is worst

    def some(self, which: NDArray) -> "_Stretches":
        """Return some of the stretches."""
        return _Stretches(*(values[which] for values in self))


def _samples(path: Path) -> NDArray:
    """Return (M, N) s, of each piece."""
    return np.asarray(path.breaks[:-1, None] + np.diff(path.breaks)[:, None] * np.linspace(0.0, 1.0, _SAMPLES))


@lru_cache(maxsize=16)
def beyond_obstacles(path: Path, space: Space) -> tuple[NDArray, NDArray]:
    """Return s, (M, N), and a bound on how far the path is beyond an obstacle less its margin around there, (M, N) m.

    Like distances_beyond(), for a space that has obstacles. Along a chord of the path a distance is convex, so it is
    nowhere below its tangents at both ends, and the path is no farther from the chord than step² / 8 of its second
    derivative. Where that does not decide, a stretch is cut into shorter ones.
    """
    s = _samples(path)
    places, bend = path(s), np.linalg.norm(path(s, 2), axis=-1).max(axis=1)
    prisms, count = _prisms(space.obstacles), s.shape[1]
    middle = places[:, count // 2]
    around = np.linalg.norm(places - middle[:, None], axis=-1).max(axis=1)
    around += (np.diff(path.breaks) / (count - 1)) ** 2 / 8 * bend
    seen = space.margin - _distances(prisms, middle[:, None])
    most = seen + around[:, None]  # distances change no faster than positions
    close = ~(most <= min(seen.max(), 0.0))
    at = s.copy()
    beyond = np.repeat(np.where(close, -np.inf, most).max(axis=1)[:, None], count, axis=1)
    piece, obstacle = np.nonzero(close)
    cell = piece[:, None] * count + np.arange(count)
    stretches = _cut(path, space, prisms, s[piece], cell=cell[:, :-1], piece=piece, obstacle=obstacle, bend=bend)
    reached = seen.max()
    for level in range(_LEVELS):
        reached = max(reached, stretches.least.max(initial=-np.inf))
        open_ = ~inside(stretches.most) & inside(stretches.least) | (stretches.most > reached + _WORST)
        open_ &= level < _LEVELS - 1
        _raise(at, beyond, stretches.some(~open_))
        if not open_.any():
            break
        coarse = stretches.some(open_)
        nodes = coarse.ends[:, :1] + np.diff(coarse.ends, axis=1) * np.linspace(0.0, 1.0, _PARTS + 1)
        cell = np.repeat(coarse.cell[:, None], _PARTS, axis=1)
        stretches = _cut(path, space, prisms, nodes, cell=cell, piece=coarse.piece, obstacle=coarse.obstacle, bend=bend)
    at[:, -1], beyond[:, -1] = at[:, -2], beyond[:, -2]
    for each in (at, beyond):
        each.setflags(write=False)
    return at, beyond


def _cut(
    path: Path,
    space: Space,
    prisms: _Prisms,
    nodes: NDArray,
    *,
    cell: NDArray,
    piece: NDArray,
    obstacle: NDArray,
    bend: NDArray,
) -> _Stretches:
    """Return the stretches between nodes, (P, n) s, for `cell`, (P, n - 1), beside the obstacle of each row."""
    places = path(nodes)
    distance, slope = _distances_with_slopes(prisms.of_rows(obstacle), places)
    way = np.diff(places, axis=1)
    begin, end = distance[:, :-1], distance[:, 1:]
    falls, rises = (slope[:, :-1] * way).sum(axis=-1), (slope[:, 1:] * way).sum(axis=-1)
    dips = (falls < 0.0) & (rises > 0.0)  # between the ends, where the tangents meet
    share = np.clip((end - rises - begin) / np.where(dips, falls - rises, 1.0), 0.0, 1.0)
    share = np.where(dips, share, falls < 0.0)
    lowest = np.where(dips, begin + share * falls, np.where(falls < 0.0, end, begin))
    step = np.diff(nodes, axis=1)
    most = space.margin - lowest + step**2 / 8 * bend[piece][:, None]
    least = space.margin - np.minimum(begin, end)
    worst = nodes[:, :-1] + share * step
    ends = np.stack([nodes[:, :-1], nodes[:, 1:]], axis=-1)
    across = np.ones(step.shape[1], dtype=int)
    return _Stretches(
        cell.ravel(), np.outer(piece, across).ravel(), np.outer(obstacle, across).ravel(), ends.reshape(-1, 2),
        least.ravel(), most.ravel(), worst.ravel(),
    )  # fmt: skip


def _raise(at: NDArray, beyond: NDArray, stretches: _Stretches) -> None:
    """Raise `beyond`, (M, N) m, to the bounds of stretches where these are larger, and set `at`, (M, N) s, there."""
    order = np.argsort(stretches.most)  # of several in one cell, the last one stays
    cell, most = stretches.cell[order], stretches.most[order]
    more = most > beyond.ravel()[cell]
    np.put(at, cell[more], stretches.worst[order][more])
    np.put(beyond, cell[more], most[more])


def _refuse(space: Space, point: NDArray, what: str, where: str) -> None:
    beyond = space.beyond(point)
    face = int(np.argmax(np.where(np.isfinite(beyond), beyond, np.inf)))
    outside = beyond[face] - space.margin
    obstacle = face >= SIDES
    past, too = ("inside", "near") if obstacle else ("beyond", "far")
    far = f"{outside:.3f} m {past}" if outside > 0 else f"{abs(outside):.3f} m from"
    hint = "move or place the path, or correct `space` in safety.yaml if the room is larger"
    raise InfeasibleError(
        f"{what}, {coordinates(point, '.3f')} m, is {far} {space.faces[face]}, "
        f"{max(beyond[face], 0.0):.3f} m too {too} with the margin of {space.margin:g} m",
        where=where,
        hint="lead the path around it, or correct `space.obstacles` in safety.yaml" if obstacle else hint,
    )
