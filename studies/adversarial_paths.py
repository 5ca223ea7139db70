"""Draw paths that are hard to plan, by seed, from several families, with limits 0.01 to 10 times the usual ones.

The families cover what users bring (exported point lists, hand recordings, laps, drawings with corners) and extremes:
two centimetres, a kilometre, a thousand points.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from cfplan.geometry.min_snap import min_snap, smooth_through
from cfplan.geometry.path import Path
from cfplan.geometry.random_paths import generator
from cfplan.geometry.yaw import YawMode
from cfplan.safety.limits import PlanLimits

FACTORS = (0.01, 10.0)  # range of the factors on the limits
SCALED = ("speed", "acceleration", "angular_velocity", "angular_acceleration")
STEEPEST = math.radians(80.0)  # rad, largest tilt drawn
MAX_TIME = 1800.0  # s at the speed limit; the limits of slower paths are drawn again
Draw = Callable[[np.random.Generator], NDArray]


@dataclass(frozen=True, slots=True)
class AdversarialPath:
    """A path and how to plan it."""

    family: str
    seed: int
    points: NDArray  # (K, 3) m
    through: Callable[[NDArray], Path]  # builds the path through the points
    yaw: YawMode
    limits: PlanLimits
    factor: float  # on the limits; the geometric mean where each has its own

    @property
    def path(self) -> Path:
        """Return the path. Raises InputError if the points do not define one."""
        path = self.through(self.points)
        path.check()
        return path


def adversarial_path(seed: int, usual: PlanLimits) -> AdversarialPath:
    """Draw a path, its yaw mode and its limits, which are multiples of the usual ones. Families take turns."""
    family = list(FAMILIES)[seed % len(FAMILIES)]
    random = generator(seed)
    points = FAMILIES[family](random)
    length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
    factors = np.ones(len(SCALED))
    while True:
        factors = np.exp(random.uniform(math.log(FACTORS[0]), math.log(FACTORS[1]), size=len(SCALED)))
        if random.random() < 0.75:  # one factor for all limits
            factors[:] = factors[0]
        limits = replace(
            usual, **{name: float(f) * getattr(usual, name) for name, f in zip(SCALED, factors, strict=True)}
        )
        if length <= MAX_TIME * limits.speed:
            break
    if random.random() < 0.25:
        tilt = usual.tilt * math.exp(random.uniform(math.log(FACTORS[0]), math.log(FACTORS[1])))
        limits = replace(limits, tilt=min(tilt, STEEPEST))
    dense = family in DENSE and random.random() < 0.7
    yaws = [YawMode.TANGENT] if family in TANGENT else list(YawMode)
    yaw = yaws[int(random.integers(len(yaws)))]
    factor = float(np.exp(np.log(factors).mean()))
    return AdversarialPath(family, seed, points, smooth_through if dense else min_snap, yaw, limits, factor)


def _rounded(points: NDArray, random: np.random.Generator) -> NDArray:
    """Return the points as a file would hold them: half the time exact, otherwise rounded to 1 mm to 10 µm."""
    digits = random.integers(3, 6)
    return points if random.random() < 0.5 else np.round(points, digits)


def _apart(points: NDArray, least: float) -> NDArray:
    """Return the points without those nearer than `least`, m, to the last one kept."""
    kept = [points[0]]
    for point in points[1:]:
        if np.linalg.norm(point - kept[-1]) >= least:
            kept.append(point)
    return np.array(kept)


def _along(points: NDArray, spacing: float) -> NDArray:
    """Return points every `spacing`, m, along straight lines through the given ones."""
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    at = np.arange(0.0, lengths[-1], spacing)
    return np.column_stack([np.interp(at, lengths, axis) for axis in points.T])


def _turned(points: NDArray, random: np.random.Generator) -> NDArray:
    """Return the points rotated about the vertical by a random angle and raised by 1 m."""
    angle = random.uniform(0, 2 * math.pi)
    turn = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
    return points @ turn.T + [0, 0, 1]


def _walk(random: np.random.Generator, count: int, size: float) -> NDArray:
    """Return smooth random points, closely spaced, in a box of about that size, m."""
    time = np.linspace(0, 1, count)[:, None]
    waves = sum(random.normal(size=3) / k * np.sin(2 * math.pi * (k * time + random.random(3))) for k in range(1, 5))
    return np.asarray(size / 2 * waves)


def _waypoints_every_centimetre(random: np.random.Generator) -> NDArray:
    points = _walk(random, 20_000, random.uniform(0.5, 3.0))
    length = random.uniform(0.3, 5.0)
    return _turned(_apart(points, random.uniform(0.0105, 0.02))[: round(length / 0.01)], random)


def _dense_line(random: np.random.Generator) -> NDArray:
    spacing = random.uniform(0.003, 0.012)
    count = int(random.integers(100, 700))
    points = np.column_stack([spacing * np.arange(count), np.zeros(count), np.zeros(count)])
    if random.random() < 0.5:  # with noise, as if measured
        points = points + random.normal(size=points.shape) * 10 ** random.uniform(-5, -3.3)
    return _turned(_rounded(points, random), random)


def _coil(random: np.random.Generator) -> NDArray:
    each, radius = int(random.integers(8, 60)), np.exp(random.uniform(np.log(0.05), np.log(2.0)))
    angle = np.arange(int(random.integers(40, 600))) * 2 * math.pi / each
    rise = random.uniform(0.0, 0.3)
    return _turned(np.column_stack([radius * np.cos(angle), radius * np.sin(angle), rise * angle / 6.28]), random)


def _twist(random: np.random.Generator) -> NDArray:
    """Return points that turn in every direction within a small space."""
    size = np.exp(random.uniform(np.log(0.1), np.log(1.0)))
    return _turned(_apart(random.uniform(-size, size, size=(int(random.integers(8, 60)), 3)), 0.02), random)


def _hairpins(random: np.random.Generator) -> NDArray:
    width, apart = random.uniform(0.2, 4.0), np.exp(random.uniform(np.log(0.011), np.log(0.5)))
    rows = np.arange(int(random.integers(2, 20)))
    x = np.stack([rows % 2 * width, (rows + 1) % 2 * width], axis=1).ravel()
    return _turned(np.column_stack([x, np.repeat(rows, 2) * apart, np.zeros(len(x))]), random)


def _corners(random: np.random.Generator) -> NDArray:
    """Return straight lines and right angles, drawn point by point."""
    steps = random.integers(0, 2, size=int(random.integers(3, 12))) * 2 - 1
    heading, corners = 0.0, [np.zeros(3)]
    for turn in steps:
        heading += turn * math.pi / 2
        corners.append(corners[-1] + random.uniform(0.3, 2.0) * np.array([math.cos(heading), math.sin(heading), 0]))
    points = np.array(corners)
    if random.random() < 0.5:
        points = _along(points, np.exp(random.uniform(np.log(0.02), np.log(0.3))))
    return _turned(_apart(points, 0.0101), random)


def _lollipop(random: np.random.Generator) -> NDArray:
    """Return a line, a circle at its end, and the line back beside it."""
    radius, stick = np.exp(random.uniform(np.log(0.05), np.log(1.0))), random.uniform(0.2, 5.0)
    spacing = np.exp(random.uniform(np.log(0.011), np.log(0.2)))
    angle = np.linspace(-math.pi + 0.2, math.pi - 0.2, max(6, int(6.0 * radius / spacing)))
    circle = np.column_stack([stick + radius + radius * np.cos(angle), radius * np.sin(angle), np.zeros(len(angle))])
    out = np.array([[0.0, circle[0, 1], 0.0], circle[0]])
    back = np.array([circle[-1], [0.0, circle[-1, 1], 0.0]])
    return _turned(_apart(np.concatenate([_along(out, spacing), circle, _along(back, spacing)]), 0.0101), random)


def _thousand_points(random: np.random.Generator) -> NDArray:
    points = _apart(_walk(random, 40_000, random.uniform(2.0, 30.0)), random.uniform(0.011, 0.1))[:1000]
    return _turned(_rounded(points, random), random)


def _vertical(random: np.random.Generator) -> NDArray:
    """Return a path up, down, or up and back down beside it; sometimes with hand tremor."""
    height, count = random.uniform(0.3, 10.0), int(random.integers(2, 40))
    up = np.column_stack([np.zeros(count), np.zeros(count), np.linspace(0, height, count)])
    beside = np.array([random.uniform(0.02, 1.0), 0.0, 0.0])
    points = (up, up[::-1], np.concatenate([up, up[::-1] + beside]))[int(random.integers(3))]
    trembling = random.choice([0.0, 1e-6, 1e-3])
    return points + trembling * random.normal(size=points.shape) + [0, 0, 1]


def _tiny(random: np.random.Generator) -> NDArray:
    count = int(random.integers(2, 6))
    points = np.cumsum(random.normal(size=(count, 3)), axis=0)
    gaps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    points = points[0] + (points - points[0]) * 0.0101 / gaps.min()
    return points + np.array([0, 0, 1]) if gaps.max() < 5 * gaps.min() else np.array([[0.0, 0, 1], [0.02, 0, 1]])


def _kilometre(random: np.random.Generator) -> NDArray:
    if random.random() < 0.4:
        middle = np.sort(random.uniform(0, 1000, size=int(random.integers(0, 5))))
        x = np.concatenate([[0.0], middle, [1000.0]])
        points = np.column_stack([x, np.zeros(len(x)), np.zeros(len(x))])
    else:
        step = random.uniform(2.0, 100.0)
        count = int(1000 / step)
        points = np.cumsum(random.normal(size=(count, 3)) * [1, 1, 0.2] * step / 1.4, axis=0)
    return _turned(_apart(points, 0.1), random)


def _fifty_laps(random: np.random.Generator) -> NDArray:
    count, size = int(random.integers(4, 12)), random.uniform(0.3, 3.0)
    angle = np.arange(count) * 2 * math.pi / count
    lap = size * np.column_stack([np.cos(angle), random.uniform(0.3, 1) * np.sin(angle), 0.3 * np.cos(2 * angle)])
    lap = lap * random.uniform(0.6, 1.2, size=(count, 1))
    return _turned(np.concatenate([np.tile(lap, (50, 1)), lap[:1]]), random)


FAMILIES = MappingProxyType(
    {
        "waypoints 1 cm apart": _waypoints_every_centimetre,
        "dense lines": _dense_line,
        "coils": _coil,
        "twists": _twist,
        "hairpins": _hairpins,
        "corners": _corners,
        "lollipops": _lollipop,
        "thousand points": _thousand_points,
        "vertical, tangent yaw": _vertical,
        "2 cm": _tiny,
        "1 km": _kilometre,
        "50 laps": _fifty_laps,
    }
)
DENSE = frozenset({"waypoints 1 cm apart", "dense lines", "coils", "corners", "thousand points"})  # as files of points
TANGENT = frozenset({"vertical, tangent yaw"})
