"""Sets of waypoints of many kinds, from a seed, rooms with obstacles, and tracks with published coordinates."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cfplan.geometry.min_snap import spaced
from cfplan.geometry.random_paths import generator
from cfplan.safety.space import SIDES, Box, Cylinder, Obstacle, Space

ROOM = np.array([[-2.0, -3.5, 0.3], [2.0, 3.5, 1.7]])  # m, low and high corner of the waypoints in the shipped room
HALL = np.array([[-4.8, -4.8, 0.3], [4.8, 4.8, 4.7]])  # m, likewise in a hall of 10 × 10 × 5 m
COUNTS = (3, 15)  # of waypoints
GRAZED = 0.05  # m
_CLEAR = 0.1  # m, between waypoints and the margins of walls and obstacles

Random = np.random.Generator


def _uniform(random: Random) -> NDArray:
    return random.uniform(ROOM[0], ROOM[1], (int(random.integers(*COUNTS, endpoint=True)), 3))


def _in_hall(random: Random) -> NDArray:
    return random.uniform(HALL[0], HALL[1], (int(random.integers(*COUNTS, endpoint=True)), 3))


def _lawn_mower(random: Random) -> NDArray:
    rows, length, z = int(random.integers(2, 8)), random.uniform(1.0, 3.5), random.uniform(0.5, 1.5)
    y = np.arange(rows) * min(random.uniform(0.1, 0.8), 6.5 / rows)
    x = np.where(np.arange(rows) % 2 == 0, -1, 1)[:, None] * [length / 2, -length / 2]
    return np.stack([x.ravel(), np.repeat(y - y.mean(), 2), np.full(2 * rows, z)], axis=1)


def _rectangle(random: Random) -> NDArray:
    x, y = random.uniform(0.3, 3.5) / 2, random.uniform(0.2, 3.0) / 2
    corners = np.array([[-x, -y], [x, -y], [x, y], [-x, y], [-x, -y]])
    return np.column_stack([corners, np.full(5, random.uniform(0.5, 1.5))])


def _star(random: Random) -> NDArray:
    points, radius = int(random.choice([5, 7])), random.uniform(0.6, 1.8)
    angle = np.arange(points + 1) * (2.0 * np.pi * (points // 2) / points)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.ones(points + 1)], axis=1)


def _slalom(random: Random) -> NDArray:
    count, along, aside = int(random.integers(4, 10)), random.uniform(0.4, 0.8), random.uniform(0.2, 1.0)
    x = aside * (-1.0) ** np.arange(count)
    x[[0, -1]] = 0.0
    y = along * np.arange(count)
    return np.stack([x, y - y.mean(), np.ones(count)], axis=1)


def _tower(random: Random) -> NDArray:
    count = int(random.integers(4, 11))
    return np.column_stack([random.uniform(-0.5, 0.5, (count, 2)), np.linspace(0.4, 1.6, count)])


def _spiral(random: Random) -> NDArray:
    count = int(random.integers(6, 16))
    angle, radius = np.linspace(0.0, random.uniform(2.0, 4.0) * np.pi, count), np.linspace(0.3, 1.7, count)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.linspace(0.5, 1.5, count)], axis=1)


def _gates_in_pairs(random: Random) -> NDArray:
    centre = random.uniform(ROOM[0] + 0.3, ROOM[1] - 0.3, (int(random.integers(2, 6)), 3))
    angle = random.uniform(0.0, 2.0 * np.pi, len(centre))
    aside = 0.2 * np.stack([np.cos(angle), np.sin(angle), np.zeros(len(centre))], axis=1)
    return np.stack([centre - aside, centre + aside], axis=1).reshape(-1, 3)


def _nearly_equal(random: Random) -> NDArray:
    points = random.uniform(ROOM[0], ROOM[1], (int(random.integers(2, 7)), 3))
    near = np.clip(points + 0.03 * random.normal(size=points.shape), ROOM[0], ROOM[1])
    return np.stack([points, near], axis=1).reshape(-1, 3)


def _on_a_line(random: Random) -> NDArray:
    first, last = random.uniform(ROOM[0], ROOM[1], (2, 3))
    along = np.sort(np.concatenate([[0.0, 1.0], random.uniform(size=int(random.integers(1, 13)))]))
    return first + (last - first) * along[:, None]


def _there_and_back(random: Random) -> NDArray:
    first, last, elsewhere = random.uniform(ROOM[0], ROOM[1], (3, 3))
    fraction = random.uniform(0.1, 1.0)
    turned = [first, last, last + (first - last) * fraction]
    return np.array([*turned, elsewhere] if random.random() < 0.5 else turned)


KINDS: Mapping[str, Callable[[Random], NDArray]] = MappingProxyType(
    {
        "uniform in the room": _uniform,
        "uniform in a hall": _in_hall,
        "lawn mower": _lawn_mower,
        "rectangle": _rectangle,
        "star": _star,
        "slalom": _slalom,
        "tower": _tower,
        "spiral": _spiral,
        "gates in pairs": _gates_in_pairs,
        "nearly equal points": _nearly_equal,
        "points on a line": _on_a_line,
        "there and back": _there_and_back,
    }
)


def waypoint_set(seed: int) -> tuple[str, NDArray]:
    """Return the kind of the set with that seed, and its waypoints, (K, 3) m; kinds take turns."""
    kind = list(KINDS)[seed % len(KINDS)]
    random = generator(seed)
    while len(points := spaced(KINDS[kind](random))) < COUNTS[0]:
        pass
    return kind, points


_UZH = [
    [-1.1, -1.6, 3.6], [9.2, 6.6, 1.0], [9.2, -4.0, 1.2], [-4.5, -6.0, 3.5], [-4.5, -6.0, 0.8], [4.75, -0.9, 1.2],
    [-2.8, 6.8, 1.2],
]  # fmt: skip
TRACKS: Mapping[str, NDArray] = MappingProxyType(
    {
        "lawn mower": np.array([[-1.5, -1, 1], [1.5, -1, 1], [1.5, -0.7, 1], [-1.5, -0.7, 1], [-1.5, -0.4, 1],
                                [1.5, -0.4, 1], [1.5, -0.1, 1]]),
        "lsy, level 0": np.array([[-1.5, 0.75, 0.7], [0.5, 0.25, 0.7], [1.05, 0.75, 1.2], [-1.0, -0.25, 0.7],
                                  [0.0, -0.75, 1.2], [1.5, -0.75, 1.2]]),
        "split S": np.array([_UZH[2], _UZH[3], _UZH[4], _UZH[5]]),
        "CPC, 19 gates": np.array([[-5.0, 4.5, 1.2], *_UZH, *_UZH, *_UZH[:5], [4.75, -0.9, 1.2]]),
    }
)  # fmt: skip
"""Waypoints, (K, 3) m: gates of lsy_drone_racing (level0.toml, from above its drone's place on, with an end added), and
of rpg_time_optimal (track.yaml; Foehn et al., "Time-optimal planning for quadrotor waypoint flight", 2021)."""


def furnished_room(seed: int, room: Space) -> tuple[Space, NDArray]:
    """Return a room with 1 to 8 boxes and poles, and 2 to 6 clear waypoints, (K, 3) m, that these stand between.

    At least one straight line between waypoints is blocked, or passes an obstacle's margin by less than GRAZED.
    """
    random = generator(seed)
    low, high = np.array(room.low) + room.margin, np.array(room.high) - room.margin
    while True:
        furnished = replace(room, obstacles=tuple(_obstacle(random, low, high) for _ in range(random.integers(1, 9))))
        points = random.uniform(low + _CLEAR, high - _CLEAR, (100, 3))
        points = points[furnished.nearest(points)[0] < -_CLEAR]
        points = points[: random.integers(2, 7)]
        if len(points) < 2 or np.linalg.norm(np.diff(points, axis=0), axis=1).min() < 0.5:
            continue
        lines = np.concatenate([np.linspace(a, b, 200) for a, b in pairwise(points)])
        if furnished.beyond(lines)[:, SIDES:].max() > -GRAZED:
            return furnished, points


def _obstacle(random: Random, low: NDArray, high: NDArray) -> Obstacle:
    x, y = random.uniform(low[:2], high[:2]).tolist()
    if random.random() < 0.5:
        return Cylinder(x, y, random.uniform(0.03, 0.25), 0.0, random.uniform(0.6, 2.0))
    a, b, top = random.uniform(0.1, 0.5), random.uniform(0.1, 0.5), random.uniform(0.3, 2.0)
    return Box((x - a, y - b, 0.0), (x + a, y + b, top), random.uniform(0.0, np.pi))


def clearance(position: NDArray, obstacles: tuple[Obstacle, ...]) -> float:
    """Return the least distance, m, between positions, (N, 3) m, and obstacles; 0 in one.

    It is computed apart from the space's own, as positions less the nearest places of the obstacles.
    """
    least = np.inf
    for each in obstacles:
        if isinstance(each, Cylinder):
            flat = position[:, :2] - [each.x, each.y]
            radius = np.linalg.norm(flat, axis=1, keepdims=True)
            nearest = flat * np.minimum(1.0, each.radius / np.maximum(radius, 1e-12))
            away = np.column_stack([flat - nearest, position[:, 2] - np.clip(position[:, 2], each.low, each.high)])
        else:
            middle = (np.array(each.low) + each.high) / 2.0
            turn = Rotation.from_euler("z", each.yaw)
            own = turn.inv().apply(position - middle)
            half = (np.array(each.high) - each.low) / 2.0
            away = own - np.clip(own, -half, half)
        least = min(least, float(np.linalg.norm(away, axis=1).min()))
    return least
