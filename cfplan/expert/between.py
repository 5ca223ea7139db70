"""How far a profile exceeds its limits between the points where the optimiser holds them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.expert import stage
from cfplan.geometry.path import Path
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.flatness import flat_state
from cfplan.vehicle.profile import SpeedProfile

COUNT = 17
# places an interval
END_COUNT = 65
# in the END_INTERVALS at each end, where the thrust axis may swing to and fro within one interval
END_INTERVALS = 4
ALLOWANCE = 1e-3
# of the rows, kept free: certificates allow for their own sampling
END_ALLOWANCE = 4e-3
# likewise in the END_INTERVALS, where all changes fastest

SPEED = stage.ROWS
# column of the squared speed, after the rows of the optimiser
COLUMNS = stage.ROWS + 1
CONTINUOUS = [c for c in range(COLUMNS) if c not in stage.JUMPING]


@dataclass(frozen=True, slots=True)
class Excess:
    """By how much each row leaves its limits less the allowance, in each interval, in the rows' own units.

    Negative where it does not.
    """

    upper: NDArray
    # (N, COLUMNS) above 1
    lower: NDArray
    # (N, COLUMNS) below stage.LOWER

    @property
    def worst(self) -> float:
        return float(max(self.upper.max(), self.lower.max()))


class DensePath:
    """A path's derivatives at many places of every interval, evaluated once."""

    def __init__(self, path: Path, nodes: int) -> None:
        step = path.end / nodes
        counts = np.full(nodes, COUNT)
        counts[:END_INTERVALS] = counts[-END_INTERVALS:] = END_COUNT
        self.allowance = np.where(counts == END_COUNT, END_ALLOWANCE, ALLOWANCE)[:, None]
        self.first = np.cumsum(counts) - counts
        self.interval = np.repeat(np.arange(nodes), counts)
        # Chebyshev-Lobatto: both ends of an interval, and closer together near them
        share = (np.arange(counts.sum()) - self.first[self.interval]) / (counts[self.interval] - 1)
        self.s = (self.interval + (1.0 - np.cos(np.pi * share)) / 2.0) * step
        self.derivatives = tuple(tuple(path(self.s, order).T) for order in (1, 2, 3, 4))

    def excess(self, profile: SpeedProfile, airframe: Airframe, limits: PlanLimits) -> Excess:
        """Of a profile with as many intervals; h must be positive."""
        at = profile.at(self.s, self.interval)
        flat = flat_state(
            airframe, self.derivatives, (at.h, at.dh, at.ddh, at.dddh),  # type: ignore[arg-type]
            (at.yaw, at.dyaw, at.ddyaw), np.cos, np.sin,
        )  # fmt: skip
        rows = np.stack([*stage.rows(flat, limits, np.cos), _squared(flat.velocity) / limits.speed**2])
        highest, lowest = np.maximum.reduceat(rows, self.first, axis=1), np.minimum.reduceat(rows, self.first, axis=1)
        above = np.append(stage.UPPER, 1.0)
        below = np.append(stage.LOWER, -np.inf)
        return Excess(highest.T - above + self.allowance, below - lowest.T + self.allowance)


def _squared(vector: tuple[NDArray, NDArray, NDArray]) -> NDArray:
    return vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2


def spread(excess: NDArray) -> NDArray:
    """(N, COLUMNS): what is continuous counts for the neighbours too, whose points lie as near to its peak."""
    wider = excess.copy()
    for column in CONTINUOUS:
        wider[1:, column] = np.maximum(wider[1:, column], excess[:-1, column])
        wider[:-1, column] = np.maximum(wider[:-1, column], excess[1:, column])
    return wider
