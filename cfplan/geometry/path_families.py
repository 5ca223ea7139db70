"""Path families: random waypoints of typical kinds of paths, each from a seed."""

import math
from collections.abc import Callable
from enum import StrEnum
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from cfplan.geometry.path import rotation_about_z
from cfplan.geometry.random_paths import SPACING, generator, random_waypoints

BOXES = ((10.0, 10.0, 10.0), (4.5, 8.0, 2.0))  # m, sides of the boxes for half of the random paths
WAYPOINTS = (3, 6)  # fewest and most of a random path
POINTS_A_TURN = 8  # of spirals


class Family(StrEnum):
    """The families by name."""

    RANDOM = "random"  # waypoints uniform in a box, of many sizes
    LINE = "line"  # straight, in any direction
    LEGS = "legs"  # long straights with corners between
    HAIRPIN = "hairpin"  # back and forth, slightly displaced each time
    SPIRAL = "spiral"  # round, up or down, wider or narrower
    LAPS = "laps"  # a closed loop, several times
    VERTICAL = "vertical"  # up and down, with little sideways motion


# The families with their frequencies: every other path has random waypoints.
USUAL = (
    Family.RANDOM, Family.LINE, Family.RANDOM, Family.LEGS, Family.RANDOM, Family.HAIRPIN,
    Family.RANDOM, Family.SPIRAL, Family.RANDOM, Family.LAPS, Family.RANDOM, Family.VERTICAL,
)  # fmt: skip


def family_waypoints(family: Family, seed: int | np.random.SeedSequence) -> NDArray:
    """Return waypoints of a family, (K, 3) m, from a seed, turned about z by a random angle."""
    random = generator(seed)
    points = _DRAW[family](random)
    return np.asarray(points @ rotation_about_z(random.uniform(-math.pi, math.pi)).T)


def _logarithmic(random: np.random.Generator, low: float, high: float) -> float:
    """Draw a number whose logarithm is uniform."""
    return math.exp(random.uniform(math.log(low), math.log(high)))


def _random(random: np.random.Generator) -> NDArray:
    if random.uniform() < 0.5:
        sides = np.array(BOXES[int(random.integers(len(BOXES)))])
    else:
        sides = np.array([_logarithmic(random, 1.0, 12.0), _logarithmic(random, 1.0, 12.0), random.uniform(0.3, 6.0)])
    seed = np.random.SeedSequence(int(random.integers(2**63)))
    spacing = min(SPACING, 0.3 * float(np.linalg.norm(sides)))
    return random_waypoints(seed, np.stack([-sides / 2, sides / 2]), WAYPOINTS, spacing=spacing)


def _line(random: np.random.Generator) -> NDArray:
    climb = 0.0 if random.uniform() < 0.5 else random.uniform(-math.pi / 2, math.pi / 2)
    along = np.array([math.cos(climb), 0.0, math.sin(climb)])
    return np.stack([np.zeros(3), _logarithmic(random, 0.3, 30.0) * along])


def _legs(random: np.random.Generator) -> NDArray:
    points, heading = [np.zeros(3)], 0.0
    for _ in range(int(random.integers(2, 4, endpoint=True))):
        leg = _logarithmic(random, 1.5, 15.0)
        step = np.array([math.cos(heading), math.sin(heading), random.uniform(-0.2, 0.2)])
        points.append(points[-1] + leg * step)
        heading += random.choice((-1.0, 1.0)) * random.uniform(0.2, 2.5)
    return np.array(points)


def _hairpin(random: np.random.Generator) -> NDArray:
    long, aside = _logarithmic(random, 0.8, 8.0), _logarithmic(random, 0.1, 1.2)
    rows = int(random.integers(2, 5, endpoint=True))
    climb = random.uniform(-0.3, 0.3)
    return np.array([
        [long * ((row + end) % 2), aside * row, climb * row] for row in range(rows) for end in range(2)
    ])  # fmt: skip


def _spiral(random: np.random.Generator) -> NDArray:
    radius, turns = _logarithmic(random, 0.25, 3.0), random.uniform(0.75, 3.0)
    growth, pitch, squeeze = random.uniform(-0.5, 0.5), random.uniform(-0.8, 0.8), random.uniform(0.5, 1.0)
    angle = np.linspace(0.0, 2.0 * math.pi * turns, max(4, round(POINTS_A_TURN * turns) + 1))
    grown = radius * (1.0 + growth * angle / angle[-1])
    return np.stack([
        grown * np.cos(angle), squeeze * grown * np.sin(angle), pitch * radius * angle / (2.0 * math.pi)
    ], axis=1)  # fmt: skip


def _laps(random: np.random.Generator) -> NDArray:
    count, laps, radius = int(random.integers(3, 6, endpoint=True)), 3, _logarithmic(random, 0.4, 4.0)
    angle = 2.0 * math.pi * (np.arange(count) + random.uniform(-0.25, 0.25, count)) / count
    away = radius * random.uniform(0.6, 1.4, count)
    loop = np.stack([away * np.cos(angle), away * np.sin(angle), 0.3 * radius * random.uniform(-1, 1, count)], axis=1)
    if random.uniform() < 0.3:  # an eight
        loop[:, 1] *= np.sin(angle)
        loop = loop + 0.05 * radius * random.normal(size=loop.shape)
    return np.concatenate([np.tile(loop, (laps, 1)), loop[:1]])[: int(random.integers(2 * count, laps * count)) + 1]


def _vertical(random: np.random.Generator) -> NDArray:
    count, height = int(random.integers(2, 4, endpoint=True)), _logarithmic(random, 0.3, 8.0)
    aside = 0.0 if count == 2 else 0.2 * height  # else the path would reverse
    points = np.zeros((count, 3))
    points[:, 2] = height * (np.arange(count) % 2) * random.uniform(0.5, 1.0, count)
    points[:, :2] = aside * random.normal(size=(count, 2))
    return points


_DRAW: MappingProxyType[Family, Callable[[np.random.Generator], NDArray]] = MappingProxyType(
    {
        Family.RANDOM: _random,
        Family.LINE: _line,
        Family.LEGS: _legs,
        Family.HAIRPIN: _hairpin,
        Family.SPIRAL: _spiral,
        Family.LAPS: _laps,
        Family.VERTICAL: _vertical,
    }
)
