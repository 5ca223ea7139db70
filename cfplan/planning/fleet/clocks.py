"""The fastest clock of one vehicle among others with known flights: its start delay, and its clock rate.

The vehicle stays on its path. With the common time t and the time u of its own plan, a clock is a curve u(t) with a
slope between 0 and 1 that avoids the conflict map: the pairs (t, u) at which the vehicle is too near to another. Curves
are searched on a grid: rates are multiples of a quarter, change by one quarter in RAMP ticks, and are 0 only at the
start. Of the curves with the earliest end, the result waits as early as possible, preferably at the start.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.machine_code import njit

TICK = 0.04  # s of common time, a multiple of the setpoint period
LEVELS = 4  # rates above 0
CELL = TICK / LEVELS  # s of a plan's own time
RAMP = 6  # ticks between rates: 1.04 /s, which from 2 m/s brakes at 2.1 m/s²
_START, _SAME, _SLOWER, _FASTER = (
    1,
    2,
    4,
    8,
)  # how a state was reached: from rest, at the same, a lower, or a higher rate


class VehicleClock(NamedTuple):
    """A clock of a vehicle, from the fleet's start to the end of its path."""

    own: NDArray  # (N,) int, cells of its plan's own time at each tick
    rate: NDArray  # (N,) of its clock, between 0 and 1

    @property
    def delay(self) -> float:
        """Return the start delay, s."""
        return TICK * float(np.argmax(self.rate > 0.0))

    @property
    def slows(self) -> bool:
        """Return whether the clock slows after the start."""
        return bool((self.rate[self.rate > 0.0] < 1.0).any())

    def rate_at(self, own: NDArray) -> NDArray:
        """Return the rate at each of its plan's own times, (N,) s."""
        moving = self.rate > 0.0
        return np.asarray(np.interp(own / CELL, self.own[moving], self.rate[moving]))


class Stuck(NamedTuple):
    """No clock reaches the end: the farthest point that the vehicle reaches, and when."""

    own: float  # s of its plan's own time
    time: float  # s


def cells_of(duration: float) -> NDArray:
    """Return the own times, s, of a plan's cells, extended past its end by the cells of one tick."""
    return CELL * np.arange(int(np.ceil(duration / CELL)) + LEVELS)


def fastest_clock(
    own: NDArray, others: NDArray, apart: float, hazard: NDArray, may_start: NDArray
) -> VehicleClock | Stuck:
    """Return the clock with the earliest end, `apart`, m, from all others.

    `own`, (U, 2) m, are x and y of the vehicle at each of cells_of() its plan; `others`, (K, T, W, 2) m, are those of K
    vehicles whose flights are known, at W moments of the skew about each tick until all rest. It also keeps out of
    `hazard`, (T, U) bool, and does not start at ticks other than those in `may_start`, (T,) bool.
    """
    conflict = _conflicts(own, others, apart) | hazard
    how, end, cell, level = _reached(conflict, may_start)
    if level > 0:
        return VehicleClock(*_followed(how, end, cell, level))
    found = how.any(axis=2)
    farthest = int(np.flatnonzero(found.any(axis=0)).max(initial=0))
    return Stuck(CELL * farthest, TICK * float(np.flatnonzero(found[:, farthest]).max(initial=0)))


@njit(nogil=True, error_model="numpy")
def _conflicts(own: NDArray, columns: NDArray, apart: float) -> NDArray:
    """Return the conflict map, (T, U) bool."""
    out = np.zeros((columns.shape[1], len(own)), dtype=np.bool_)
    for k in range(columns.shape[0]):
        for t in range(columns.shape[1]):
            for w in range(columns.shape[2]):
                x, y = columns[k, t, w, 0], columns[k, t, w, 1]
                for u in range(len(own)):
                    out[t, u] |= not (own[u, 0] - x) ** 2 + (own[u, 1] - y) ** 2 >= apart * apart
    return out


@njit(nogil=True, error_model="numpy")
def _reached(conflict: NDArray, may_start: NDArray) -> tuple[NDArray, int, int, int]:
    """Return how each state is reached, (T, U, LEVELS + 1) uint8, and tick, cell and level of the earliest end.

    The level is 0 if no end is reached.
    """
    known, cells = conflict.shape
    end = cells - LEVELS  # the first cell at the end
    ticks = known + cells // LEVELS + LEVELS * RAMP
    how = np.zeros((ticks, cells, LEVELS + 1), dtype=np.uint8)
    stays = np.ones(ticks + 1, dtype=np.bool_)  # whether it may rest at its end from a tick on
    for t in range(ticks - 1, -1, -1):
        stays[t] = stays[t + 1] and _free(conflict, t, end)
    for t in range(ticks):
        if (t == 0 or how[t - 1, 0, 0] != 0) and _free(conflict, t, 0):
            for level in range(LEVELS + 1 if may_start[min(t, known - 1)] else 1):
                how[t, 0, level] |= _START
        for u in range(cells):
            for level in range(LEVELS, 0, -1):
                if how[t, u, level] == 0:
                    continue
                if u >= end:
                    if stays[t]:
                        return how, t, u, level
                    continue
                if t + 1 < ticks and _free(conflict, t + 1, u + level):
                    how[t + 1, u + level, level] |= _SAME
                for change in (-1, 1):
                    if 1 <= level + change <= LEVELS and t + RAMP < ticks and u + _passed(level, change, RAMP) <= end:
                        _ramp(how, conflict, t, u, level, change)
    return how, 0, 0, 0


@njit(error_model="numpy")
def _ramp(how: NDArray, conflict: NDArray, t: int, u: int, level: int, change: int) -> None:
    """Mark the state after a change of rate as reached, unless there is a conflict on the way."""
    for k in range(1, RAMP + 1):
        if not _free(conflict, t + k, u + _passed(level, change, k)):
            return
    how[t + RAMP, u + _passed(level, change, RAMP), level + change] |= _FASTER if change < 0 else _SLOWER


@njit(error_model="numpy")
def _passed(level: int, change: int, ticks: int) -> int:
    """Return the cells passed in the first ticks of a change of rate."""
    return int(level * ticks + np.floor(change * ticks * ticks / (2.0 * RAMP) + 0.5))


@njit(error_model="numpy")
def _free(conflict: NDArray, t: int, u: int) -> bool:
    """Return whether a state is out of conflict; after the last tick of the map all others rest."""
    return not conflict[min(t, len(conflict) - 1), u]


@njit(error_model="numpy")
def _followed(how: NDArray, t: int, u: int, level: int) -> tuple[NDArray, NDArray]:
    """Return cells and rates at each tick up to an end, of the clock that waits as early as possible."""
    own, rate = np.zeros(t + 1, dtype=np.int64), np.zeros(t + 1)
    own[t], rate[t] = u, level / LEVELS
    while u > 0:
        ways = how[t, u, level]
        if ways & _SAME and (level == LEVELS or not ways & _FASTER):
            t, u = t - 1, u - level
        else:
            change = -1 if ways & _FASTER else 1
            level -= change
            t, u = t - RAMP, u - _passed(level, change, RAMP)
            for k in range(1, RAMP):
                own[t + k] = u + _passed(level, change, k)
                rate[t + k] = (level + change * k / RAMP) / LEVELS
        own[t], rate[t] = u, level / LEVELS
    return own, rate
