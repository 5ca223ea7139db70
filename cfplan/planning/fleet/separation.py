"""The certificate of separation: how near the vertical columns of two vehicles come to each other.

Vehicles keep apart sideways at all heights, since the air beneath one pushes another down, and so that all can come
straight down from wherever they stop. Take-off, the way up to the start, waiting, landing and standing all happen in
the columns of start and end, so the distance of columns over time is that of all phases.

The clocks of two vehicles differ by the skew at most, so every moment of one is compared with every moment of the other
within the skew. Between samples a vehicle moves no faster than its certified plan may, which is taken off.

Joint stops need no samples of their own: each stop runs along the path by the same law of its clock, so vehicles that
all brake at one tick pass pairs of places that are compared here, and rest at such a pair. The order to brake may reach
them at different times, which adds to the skew.

A vehicle without poses or without its link leaves its path, and is not part of this certificate.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.machine_code import njit
from cfplan.planning.fleet.members import FleetMember
from cfplan.safety.space import inside

SAMPLE = 0.001  # s
_BETWEEN = 1e-4  # m: what linear interpolation between setpoints differs from the plan, at most 5 m/s² · (10 ms)² / 8


@dataclass(frozen=True, slots=True)
class Separation:
    """The nearest that the columns of two vehicles come to each other."""

    pair: tuple[str, str]
    distance: float  # m, at least: between samples and over the skew too
    place: tuple[float, float]  # m, x and y, in the middle between them
    time: float  # s after the fleet's start

    def __str__(self) -> str:
        a, b = self.pair
        x, y = self.place
        return f"{a} and {b} {self.distance:.3f} m apart at ({x:.2f}, {y:.2f}) m, {self.time:.2f} s"

    def keeps(self, apart: float) -> bool:
        """Return whether the two keep that distance, m."""
        return bool(inside(apart - self.distance))


def separations(members: Sequence[FleetMember], skew: float) -> tuple[Separation, ...]:
    """Return the nearest approach of each pair, the nearest first, for clocks that differ by `skew`, s, at most."""
    end = max(member.end for member in members)
    times = np.arange(0.0, end + SAMPLE, SAMPLE)
    columns = [member.columns(times) for member in members]
    found = []
    for i, j in itertools.combinations(range(len(members)), 2):
        found.append(_separation(members[i], members[j], columns[i], columns[j], skew))
    return tuple(sorted(found, key=lambda each: each.distance))


def _separation(a: FleetMember, b: FleetMember, of_a: NDArray, of_b: NDArray, skew: float) -> Separation:
    band = int(np.ceil(skew / SAMPLE)) + 1
    distance, row, other = _nearest(of_a, of_b, band)
    moved = 0.5 * SAMPLE * (a.plan.limits.plan.speed + b.plan.limits.plan.speed) + _BETWEEN
    x, y = (0.5 * (of_a[row] + of_b[other])).tolist()
    return Separation((a.name, b.name), max(float(distance) - moved, 0.0), (x, y), SAMPLE * row)


@njit(nogil=True, error_model="numpy")
def _nearest(a: NDArray, b: NDArray, band: int) -> tuple[float, int, int]:
    """Return the least distance of a row of `a` and one of `b`, (N, 2), at most `band` rows apart; and both rows."""
    least, row, other = np.inf, 0, 0
    for n in range(len(a)):
        for m in range(max(n - band, 0), min(n + band + 1, len(b))):
            away = (a[n, 0] - b[m, 0]) ** 2 + (a[n, 1] - b[m, 1]) ** 2
            if np.isnan(away):
                return away, n, m
            if away < least:
                least, row, other = away, n, m
    return np.sqrt(least), row, other
