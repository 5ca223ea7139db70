"""Separation certificate: the least distance between the vertical columns of two vehicles.

Vehicles keep a horizontal distance at all heights, because the downwash of one pushes another down, and because each
must be able to descend vertically from wherever it stops. Take-off, the way up to the start, waiting, landing and
standing are all in the columns of start and end, so the distance between columns over time covers all phases.

The clocks of two vehicles differ by at most the skew, so each moment of one is compared with all moments of the other
within the skew. The distance that a vehicle may move between samples, at its certified speed, is subtracted.

Each streamed stop slows the clock along the path by the same law, so vehicles that brake at the same tick pass through
pairs of positions that are compared here, and rest at such a pair. The order to brake may reach them at different
times, which adds to the skew. A vehicle that has not begun yet stays at its start when all brake, while the others go
on along their paths. So each start is also compared with the places of the others until STOP after the vehicle there
would have begun.

A vehicle that flies on board leaves its path to stop. So the stops of two vehicles from all setpoints within the skew
are compared with each other as well.

A vehicle is not exactly on its path. `apart` has room for the deviation of both, and leaves CLEAR between them.

A vehicle without poses or without its link leaves its path, which this certificate does not cover.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.machine_code import njit
from cfplan.planning.fleet.members import FleetMember
from cfplan.safety.space import inside

CLEAR = 0.20  # m between two columns as they fly: downwash is below 5 % of weight, and vehicles touch at 0.14 m
SAMPLE = 0.001  # s
STOP = (
    0.6  # s of its plan that a vehicle passes while it brakes: half the duration of a stop (flight/setpoints/stops.py)
)
_BETWEEN = 1e-4  # m, error of linear interpolation between setpoints, at most 5 m/s² · (10 ms)² / 8


def allowed_deviation(apart: float) -> float:
    """Return how far, m, each vehicle may be off its path where paths are certified to keep `apart`, m."""
    return 0.5 * (apart - CLEAR)


class Stops(NamedTuple):
    """Stops that leave the path, from each setpoint of a plan."""

    places: NDArray  # (R, M, 2) m, x and y, of a stop from each of R setpoints; the first is that of the setpoint
    rate: float  # Hz, of setpoints and of the places of a stop
    speed: float  # m/s, at most
    off: float  # m, at most, from the place of a setpoint to that of the plan

    @property
    def error(self) -> float:
        """Return how far, m, the vehicle may be from the nearest of the places."""
        return self.speed / self.rate + self.off + _BETWEEN


@dataclass(frozen=True, slots=True)
class Separation:
    """The nearest approach of the columns of two vehicles."""

    pair: tuple[str, str]
    distance: float  # m, lower bound, including between samples and over the skew
    place: tuple[float, float]  # m, x and y, in the middle between them
    time: float  # s after the fleet's start
    braked: bool = False  # whether all begin to brake at that time, and come this near as they stop off their paths

    def __str__(self) -> str:
        a, b = self.pair
        x, y = self.place
        braked = ", when all brake" if self.braked else ""
        return f"{a} and {b} {self.distance:.3f} m apart at ({x:.2f}, {y:.2f}) m, {self.time:.2f} s{braked}"

    def keeps(self, apart: float) -> bool:
        """Return whether the two keep that distance, m."""
        return bool(inside(apart - self.distance))


def separations(members: Sequence[FleetMember], skew: float) -> tuple[Separation, ...]:
    """Return the nearest approach of each pair, the nearest first, for clocks that differ by at most `skew`, s."""
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
    middle = 0.5 * (of_a[row] + of_b[other])
    near = [(distance, middle, SAMPLE * row), _while_waiting(a, b, skew), _while_waiting(b, a, skew)]
    distance, middle, time = near[int(np.argmin([each[0] for each in near]))]  # argmin finds NaN
    moved = 0.5 * SAMPLE * (a.plan.limits.plan.speed + b.plan.limits.plan.speed) + _BETWEEN
    x, y = middle.tolist()
    return Separation((a.name, b.name), max(float(distance) - moved, 0.0), (x, y), time)


def _while_waiting(a: FleetMember, b: FleetMember, skew: float) -> tuple[float, NDArray, float]:
    """Return how near `a` may come to the start of `b` if all brake before `b` begins: distance, middle, time."""
    times = np.arange(0.0, b.delay + STOP + skew + SAMPLE, SAMPLE)
    columns, start = a.columns(times), b.columns(np.zeros(1))[0]
    away = np.linalg.norm(columns - start, axis=1)
    row = int(away.argmin())
    return float(away[row]), 0.5 * (columns[row] + start), float(times[row])


def stop_separations(members: Sequence[FleetMember], stops: Sequence[Stops], skew: float) -> tuple[Separation, ...]:
    """Return how near each pair comes when all leave their paths to stop, the nearest first; as separations()."""
    found = []
    for i, j in itertools.combinations(range(len(members)), 2):
        a, b, rate = stops[i], stops[j], stops[i].rate
        times = np.arange(int(np.ceil(max(members[i].end, members[j].end) * rate)) + 1)
        rows = [np.round(times - rate * members[n].delay).astype(np.int64) for n in (i, j)]
        least, time, place, other = _nearest_stops(a.places, rows[0], b.places, rows[1], int(np.ceil(skew * rate)) + 1)
        x, y = (0.5 * (np.array(place) + np.array(other))).tolist()
        distance = max(float(least) - a.error - b.error, 0.0)
        found.append(Separation((members[i].name, members[j].name), distance, (x, y), time / rate, braked=True))
    return tuple(sorted(found, key=lambda each: each.distance))


@njit(nogil=True, error_model="numpy")
def _nearest_stops(
    a: NDArray, rows_of_a: NDArray, b: NDArray, rows_of_b: NDArray, band: int
) -> tuple[float, int, tuple[float, float], tuple[float, float]]:
    """Return the least distance of two vehicles that stop, the number of its rows, and the places of both.

    `a` and `b` are (R, M, 2) m; rows and places are at most `band` apart. A row before the first one is a hover.
    """
    least, at = np.inf, 0
    place, other = (0.0, 0.0), (0.0, 0.0)
    for n in range(len(rows_of_a)):
        row = min(max(rows_of_a[n], 0), len(a) - 1)
        for late in range(-band, band + 1):
            row_of_b = min(max(rows_of_b[n] + late, 0), len(b) - 1)
            for k in range(a.shape[1]):
                for m in range(max(k - band, 0), min(k + band + 1, b.shape[1])):
                    away = (a[row, k, 0] - b[row_of_b, m, 0]) ** 2 + (a[row, k, 1] - b[row_of_b, m, 1]) ** 2
                    if away < least or np.isnan(away):
                        least, at = away, n
                        place = (a[row, k, 0], a[row, k, 1])
                        other = (b[row_of_b, m, 0], b[row_of_b, m, 1])
    return np.sqrt(least), at, place, other


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
