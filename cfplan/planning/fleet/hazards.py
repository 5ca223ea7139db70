"""Where a vehicle could not get out of the way of another one that is lost, nor another out of its way.

A lost vehicle sweeps boxes, one after another, until it lies. The others are told, brake along their paths and stay
there. On a coarse grid of the time of all and of a vehicle's own time, and for each rate of its clock, the map says
whether somebody would come too near to a box. It guides the search for clocks; certificates are made of what is found.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.machine_code import njit

STRIDE = 3  # ticks, and as much of a vehicle's own time, from one row of the map to the next


class LossModel(NamedTuple):
    """What lost vehicles sweep, and how the others brake."""

    tubes: tuple[NDArray, ...]  # of each vehicle, (R, S, 2, 2) m: low and high x and y swept in S parts of the time
    every: float  # s of its plan's own time from one row of a tube to the next
    braking: NDArray  # (S, W) s by which the others go on along their plans, at W moments of each part
    clearance: float  # m, between a box and the middle of another vehicle


def hazard_map(
    own: NDArray, cell: float, tube: NDArray, swept: NDArray, passing: NDArray, model: LossModel, rates: NDArray
) -> NDArray:
    """Return, (T, U', len(rates)) bool, where a vehicle is in the way of a lost one, or lost in the way of another.

    `own`, (U, 2) m, are its places every `cell` s of its own time, and `tube` what it sweeps from there. Others sweep
    `swept`, (K, T, S, 2, 2) m, and brake through `passing`, (K, T, S, W, 2) m, from each of T times. `rates` are those
    of its clock, up to 1.
    """
    cells = np.arange(0, len(own), round(STRIDE * len(rates[1:])))
    rows = np.minimum(np.round(cells * cell / model.every).astype(int), len(tube) - 1)
    ahead = np.minimum(
        cells[:, None, None, None] + np.round(rates[:, None, None] * model.braking / cell).astype(int), len(own) - 1
    )
    return np.asarray(_in_the_way(own[ahead], tube[rows], swept, passing, model.clearance))


@njit(nogil=True, error_model="numpy")
def _in_the_way(braking: NDArray, lost: NDArray, swept: NDArray, passing: NDArray, clearance: float) -> NDArray:
    """Return the map; the vehicle brakes through (U, L, S, W, 2) m, and sweeps (U, S, 2, 2) m if it is lost."""
    cells, levels, parts, moments = braking.shape[:4]
    others, times = swept.shape[:2]
    out = np.zeros((times, cells, levels), dtype=np.bool_)
    for k in range(others):
        for t in range(times):
            for u in range(cells):
                hit = False
                for s in range(parts):
                    for w in range(moments):
                        hit |= _within(passing[k, t, s, w], lost[u, s], clearance)
                for level in range(levels):
                    met = hit
                    for s in range(parts):
                        for w in range(moments):
                            met |= _within(braking[u, level, s, w], swept[k, t, s], clearance)
                    out[t, u, level] |= met
    return out


@njit(error_model="numpy")
def _within(place: NDArray, box: NDArray, clearance: float) -> bool:
    for axis in range(2):
        if place[axis] < box[0, axis] - clearance or place[axis] > box[1, axis] + clearance:
            return False
    return True
