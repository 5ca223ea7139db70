"""How far a profile exceeds its limits between the points where the optimiser holds them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.expert import stage
from cfplan.geometry.path import Path
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle import dense
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.profile import SpeedProfile

COUNT = 17
# places an interval
FINE_COUNT = 65
# in brisk intervals: the END_INTERVALS at each end, where the thrust axis may swing to and fro within one, and
# where the path turns by more than SHARP
END_INTERVALS = 4
SHARP = 0.25
# rad, an interval
ALLOWANCE = 1.5e-3
# of the rows, kept free: certificates allow for their own sampling
THRUST_ALLOWANCE = 4e-3
# likewise, of thrusts, which change fastest
FINE_ALLOWANCE = 5e-3
# likewise in brisk intervals

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

    def __init__(self, path: Path, nodes: int, held: NDArray) -> None:
        """`held`, (N,): how far, 0 to 1, each interval is bound by a boundary state and had better be left alone."""
        self.held = held[:, None]
        step = path.end / nodes
        brisk = turns(path, nodes) > SHARP
        brisk[:END_INTERVALS] = brisk[-END_INTERVALS:] = True
        counts = np.where(brisk, FINE_COUNT, COUNT)
        self.allowance = np.full((nodes, COLUMNS), ALLOWANCE)
        self.allowance[:, list(stage.JUMPING)] = THRUST_ALLOWANCE
        self.allowance[brisk] = FINE_ALLOWANCE
        self.first = np.cumsum(counts) - counts
        self.interval = np.repeat(np.arange(nodes), counts)
        # Chebyshev-Lobatto: both ends of an interval, and closer together near them
        share = (np.arange(counts.sum()) - self.first[self.interval]) / (counts[self.interval] - 1)
        self.places = (1.0 - np.cos(np.pi * share)) / 2.0 * step
        s = self.interval * step + self.places
        self.derivatives = path.derivatives(s)[1:]

    def excess(self, profile: SpeedProfile, airframe: Airframe, limits: PlanLimits) -> Excess:
        """Of a profile with as many intervals; h must be positive."""
        at = dense.dense_rows(airframe, self.derivatives, profile, self.places, self.interval)
        middle = 0.5 * (limits.motor_thrust_max + limits.motor_thrust_min)
        half = 0.5 * (limits.motor_thrust_max - limits.motor_thrust_min)
        rows = np.empty((COLUMNS, at.shape[1]))
        rows[stage.ACCELERATION] = at[dense.ACCELERATION] / limits.acceleration**2
        rows[stage.ANGULAR_VELOCITY] = at[dense.BODY_RATE] / limits.angular_velocity**2
        rows[stage.TILT] = (1 - at[dense.AXIS_HEIGHT]) / (1 - np.cos(limits.tilt))
        rows[stage.SPECIFIC_THRUST] = at[dense.SPECIFIC_THRUST] / limits.specific_thrust_min
        rows[stage.ANGULAR_ACCELERATION] = at[dense.ANGULAR_ACCELERATION] / limits.angular_acceleration**2
        rows[stage.THRUSTS] = (at[dense.MOTOR_THRUST : dense.MOTOR_THRUST + 4] - middle) / half
        rows[SPEED] = at[dense.SPEED] / limits.speed**2
        highest, lowest = np.maximum.reduceat(rows, self.first, axis=1), np.minimum.reduceat(rows, self.first, axis=1)
        above = np.append(stage.UPPER, 1.0)
        below = np.append(stage.LOWER, -np.inf)
        upper, lower = highest.T - above + self.allowance, below - lowest.T + self.allowance
        return Excess(upper - self.held * np.maximum(upper, 0.0), lower - self.held * np.maximum(lower, 0.0))


def surely_exceeds(path: Path, profile: SpeedProfile, airframe: Airframe, limits: PlanLimits) -> bool:
    """Whether a limit is exceeded at one of many places; where not, the certificate has the word."""
    nodes = len(profile.s) - 1
    dense = DensePath(path, nodes, np.zeros(nodes))
    excess = dense.excess(profile, airframe, limits)
    return bool(max((excess.upper - dense.allowance).max(), (excess.lower - dense.allowance).max()) > 0)


def turns(path: Path, nodes: int) -> NDArray:
    """(N,) rad, by how much the direction of the path differs from one end of each interval to the other."""
    s = np.linspace(0.0, path.end, nodes + 1)
    s[[0, -1]] = s[[1, -2]]  # at rest there is no direction
    tangent = path(s, 1)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1), 1e-12)[:, None]
    return np.arccos(np.clip(np.sum(tangent[1:] * tangent[:-1], axis=1), -1.0, 1.0))


def spread(excess: NDArray) -> NDArray:
    """(N, COLUMNS): what is continuous counts for the neighbours too, whose points lie as near to its peak."""
    wider = excess.copy()
    for column in CONTINUOUS:
        wider[1:, column] = np.maximum(wider[1:, column], excess[:-1, column])
        wider[:-1, column] = np.maximum(wider[:-1, column], excess[1:, column])
    return wider
