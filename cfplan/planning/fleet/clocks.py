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
# How a state was reached: from rest, or from the same, a lower or a higher rate.
_START, _SAME, _SLOWER, _FASTER = 1, 2, 4, 8


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
    found = how.any(axis=1)
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
    """Return how each state is reached, (T, LEVELS + 1, U) uint8, and tick, cell and level of the earliest end.

    The level is 0 if no end is reached.
    """
    known, cells = conflict.shape
    end = cells - LEVELS  # the first cell at the end
    ticks = known + cells // LEVELS + LEVELS * RAMP
    how = np.zeros((ticks, LEVELS + 1, cells), dtype=np.uint8)
    free = np.ones((ticks, cells), dtype=np.uint8)  # 1 without conflict; after the map all others rest
    for t in range(ticks):
        for u in range(cells):
            free[t, u] = not conflict[min(t, known - 1), u]
    stays = np.ones(ticks + 1, dtype=np.bool_)  # whether it may rest at its end from a tick on
    for t in range(ticks - 1, -1, -1):
        stays[t] = stays[t + 1] and free[t, end] != 0
    for t in range(ticks):
        if (t == 0 or how[t - 1, 0, 0] != 0) and free[t, 0] != 0:
            for level in range(LEVELS + 1 if may_start[min(t, known - 1)] else 1):
                how[t, level, 0] |= _START
        for u in range(end, cells if stays[t] else end):
            for level in range(LEVELS, 0, -1):
                if how[t, level, u] != 0:
                    return how, t, u, level
        for level in range(1, LEVELS + 1):
            states = (how[t, level, :end] != 0).view(np.uint8)
            if t + 1 < ticks:
                _mark(how[t + 1, level, level:], states & free[t + 1, level : end + level], _SAME)
            for change in (-1, 1):
                if 1 <= level + change <= LEVELS and t + RAMP < ticks:
                    _ramp(how, free, states, t, level, change)
    return how, 0, 0, 0


@njit(error_model="numpy")
def _ramp(how: NDArray, free: NDArray, states: NDArray, t: int, level: int, change: int) -> None:
    """Mark the states reached by a change of rate without a conflict and without passing the end.

    `states`, (end,) uint8, is 1 for each cell that is reached at tick `t` and `level`.
    """
    passed = _passed(level, change, RAMP)
    kept = states[: max(len(states) + 1 - passed, 0)]  # cells from which the change is complete by the end
    for k in range(1, RAMP + 1):
        kept = kept & free[t + k, _passed(level, change, k) :][: len(kept)]
    _mark(how[t + RAMP, level + change, passed:], kept, _FASTER if change < 0 else _SLOWER)


@njit(error_model="numpy")
def _mark(how: NDArray, reached: NDArray, way: int) -> None:
    """Add `way` to each state for which `reached` is 1."""
    for u in range(len(reached)):
        how[u] |= way * reached[u]


@njit(error_model="numpy")
def _passed(level: int, change: int, ticks: int) -> int:
    """Return the cells passed in the first ticks of a change of rate."""
    return int(level * ticks + np.floor(change * ticks * ticks / (2.0 * RAMP) + 0.5))


@njit(error_model="numpy")
def _followed(how: NDArray, t: int, u: int, level: int) -> tuple[NDArray, NDArray]:
    """Return cells and rates at each tick up to an end, of the clock that waits as early as possible."""
    own, rate = np.zeros(t + 1, dtype=np.int64), np.zeros(t + 1)
    own[t], rate[t] = u, level / LEVELS
    while u > 0:
        ways = how[t, level, u]
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
