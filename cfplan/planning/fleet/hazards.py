"""Hazard maps: how near a lost vehicle comes to another, by the own times of both, before their clocks are known.

They guide the search for clocks. Both vehicles are taken to fly at the full rate of their clocks; what comes of a
clock is certified with the plans that are made of it, see lost.py.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from cfplan.planning.fleet.clocks import CELL, TICK
from cfplan.planning.fleet.lost import LossModel, groups_among
from cfplan.planning.fleet.members import FleetMember

STRIDE = 3 * TICK  # s of a plan's own time, from one row of a map to the next
_FAR = 0.2  # m beyond the clearance, from which on a distance does not matter
_MOST_SLACK = 0.1  # m, less than _FAR, as distances beyond that are not known
BEFORE = 2.4  # s, the longest time before a start that a map covers


@dataclass(frozen=True, slots=True)
class Hazards:
    """The maps of all pairs of a fleet."""

    maps: dict[tuple[int, int], NDArray]  # of each pair in both orders: (U, V) m by rows of the first and the second
    clearance: float  # m

    @classmethod
    def of(cls, members: Sequence[FleetMember], lost: LossModel, skew: float) -> "Hazards":
        """Make the maps of vehicles on their plans before coordination."""
        maps, far = {}, lost.clearance + _FAR
        tubes = [lost.tube(member.plan) for member in members]
        for i, j in combinations(range(len(members)), 2):
            a, b = (_own_times(members[n].plan.trajectory.duration) for n in (i, j))
            own_a, own_b = (each.ravel() for each in np.meshgrid(a, b, indexing="ij"))
            found = np.minimum(
                lost.distances(tubes[i], own_a, (members[j].plan, own_b), skew, far=far),
                lost.distances(tubes[j], own_b, (members[i].plan, own_a), skew, far=far),
            )
            if any(groups_among(lost.together, (i, j))):
                found = np.minimum(found, lost.tubes_apart(tubes[i], own_a, tubes[j], own_b, skew))
            maps[i, j] = found.reshape(len(a), len(b))
            maps[j, i] = maps[i, j].T
        return cls(maps, lost.clearance)

    def mark(self, hazard: NDArray, may_start: NDArray, pair: tuple[int, int], others: NDArray, slack: float) -> None:
        """Mark where the first of a pair must not be at each tick and cell, (T, U), and when it may not start, (T,).

        `others`, (T,) s, are own times of the second at each tick, negative before its start.
        """
        found = self.maps[pair]
        is_near = ~(found >= self.clearance + min(slack, _MOST_SLACK))
        near = is_near[:, np.clip(_row(others), 0, found.shape[1] - 1)]  # (rows, T)
        cells = np.clip(_row(CELL * np.arange(hazard.shape[1])), 0, len(found) - 1)
        hazard[:, 1:] |= near[cells[1:]].T
        hazard[:, 0] |= near[0]
        for ticks in range(min(round(BEFORE / TICK), len(may_start))):
            may_start[ticks:] &= ~near[_row(np.array(-TICK * ticks)), : len(may_start) - ticks]


def _own_times(duration: float) -> NDArray:
    """Return the own times of the rows of a map, s; the first is long before the start, the last behind the end."""
    times = STRIDE * np.arange(-round(BEFORE / STRIDE), int(np.ceil(duration / STRIDE)) + 1)
    return np.concatenate([[-np.inf], times[1:]])


def _row(own: NDArray) -> NDArray:
    """Return the rows of own times, s."""
    return np.round((own + BEFORE) / STRIDE).astype(np.int64)
