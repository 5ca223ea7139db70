"""Find limits that are exceeded between the points at which the optimiser holds them, by interval."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.geometry.path import Path
from cfplan.machine_code import njit
from cfplan.planners.expert.tuning import TUNING
from cfplan.safety import quantities
from cfplan.safety.limits import PlanLimits
from cfplan.safety.quantities import scaled
from cfplan.safety.speed_caps import SpeedCaps
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.measures import SPEED
from cfplan.vehicle.motion import measures_at
from cfplan.vehicle.profile import SpeedProfile

# Chebyshev-Lobatto: both ends of an interval, and closer together near them
_PLACES, _FINE = (
    (1.0 - np.cos(np.pi * np.arange(count) / (count - 1))) / 2.0 for count in (TUNING.places, TUNING.fine_places)
)
CONTINUOUS = np.flatnonzero(~quantities.JUMPS)


@dataclass(frozen=True, slots=True)
class Violation:
    """The excess of each row over its limits, lowered by the allowance, in each interval and in the rows' own units.

    Negative if the row keeps them.
    """

    upper: NDArray  # (N, MEASURES) above quantities.UPPER
    lower: NDArray  # (N, MEASURES) below quantities.LOWER

    @property
    def worst(self) -> float:
        """Return the largest excess."""
        return float(max(self.upper.max(), self.lower.max()))


class DensePath:
    """A path's derivatives at many places of every interval, evaluated once."""

    def __init__(self, path: Path, nodes: int, held: NDArray, caps: SpeedCaps | None = None) -> None:
        """Take `held`, (N,), 0 to 1: how far boundary states fix each interval, whose violation counts less."""
        self.held = held
        step = path.end / nodes
        refined = turns(path, nodes) > TUNING.sharp
        refined[: TUNING.refined_at_ends] = refined[-TUNING.refined_at_ends :] = True
        self.allowance, self.begins, self.interval, self.s = _laid_out(refined, quantities.JUMPS, _PLACES, _FINE, step)
        self.curve = path.derivatives(self.s)
        self.caps = None if caps is None else caps.at(self.s)

    def violation(self, profile: SpeedProfile, airframe: Airframe, limits: PlanLimits) -> Violation:
        """Return the violation by a profile with the same number of intervals; h must be positive."""
        count = len(self.allowance)
        rows = scaled(_extremes(self.measures(profile, airframe, limits), self.begins), limits)
        return Violation(*_beyond(
            rows[:, :count], rows[:, count:], quantities.UPPER, quantities.LOWER, self.allowance, self.held
        ))  # fmt: skip

    def measures(self, profile: SpeedProfile, airframe: Airframe, limits: PlanLimits) -> NDArray:
        """Return the measures at all places, (MEASURES, P · K), speed counted against caps as against the limit."""
        at = measures_at(airframe, self.curve, profile.table(), self.s, self.interval)
        _count_against_caps(at, self.caps, limits)
        return at

    def least_of_intervals(self, values: NDArray) -> NDArray:
        """Return the least of values at all places, (P · K,), in each interval, (N,)."""
        return np.asarray(np.minimum.reduceat(values, self.begins[:-1]))


@njit
def _laid_out(
    refined: NDArray, jumps: NDArray, usual: NDArray, fine: NDArray, step: float
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Return the allowance of each interval, (N, MEASURES), and the first place of each, (N+1,); and of every place the
    interval and s: those of one interval after those of another."""
    allowance, begins = np.empty((len(refined), len(jumps))), np.zeros(len(refined) + 1, np.int64)
    for k in range(len(refined)):
        begins[k + 1] = begins[k] + (len(fine) if refined[k] else len(usual))
        for row in range(len(jumps)):
            allowance[k, row] = (
                TUNING.fine_allowance if refined[k] else TUNING.thrust_allowance if jumps[row] else TUNING.allowance
            )
    interval, s = np.empty(begins[-1], np.int64), np.empty(begins[-1])
    for k in range(len(refined)):
        places = fine if refined[k] else usual
        for n in range(len(places)):
            interval[begins[k] + n], s[begins[k] + n] = k, step * (k + places[n])
    return allowance, begins, interval, s


@njit
def _extremes(measured: NDArray, begins: NDArray) -> NDArray:
    """Return the highest of each row, (MEASURES, P), in each interval, then the lowest, (MEASURES, 2 N)."""
    rows, count = measured.shape[0], len(begins) - 1
    extremes = np.empty((rows, 2 * count))
    for row in range(rows):
        for k in range(count):
            high = low = measured[row, begins[k]]
            for n in range(begins[k] + 1, begins[k + 1]):
                value = measured[row, n]
                high, low = value if value > high else high, value if value < low else low
            extremes[row, k], extremes[row, count + k] = high, low
    return extremes


@njit
def _beyond(
    highest: NDArray, lowest: NDArray, most: NDArray, least: NDArray, allowance: NDArray, held: NDArray
) -> tuple[NDArray, NDArray]:
    """Return the fields of a Violation, (N, MEASURES), of the extremes, (MEASURES, N) each."""
    upper, lower = np.empty(allowance.shape), np.empty(allowance.shape)
    for n in range(allowance.shape[0]):
        for row in range(allowance.shape[1]):
            above = highest[row, n] - most[row] + allowance[n, row]
            below = least[row] - lowest[row, n] + allowance[n, row]
            upper[n, row] = above - held[n] * max(above, 0.0) if held[n] > 0.0 else above
            lower[n, row] = below - held[n] * max(below, 0.0) if held[n] > 0.0 else below
    return upper, lower


def violates_at_nodes(
    path: Path, profile: SpeedProfile, airframe: Airframe, limits: PlanLimits, caps: SpeedCaps | None = None
) -> bool:
    """Return whether a limit is exceeded at a node; if none is, the certificate still decides."""
    first, nodes = profile.s[:-1], np.arange(len(profile.s) - 1)
    at = measures_at(airframe, path.derivatives(first), profile.table(), first, nodes)
    _count_against_caps(at, None if caps is None else caps.at(first), limits)
    rows = scaled(at, limits).T
    return bool((rows > quantities.UPPER).any() or (rows < quantities.LOWER).any())


def _count_against_caps(measured: NDArray, caps: NDArray | None, limits: PlanLimits) -> None:
    """Scale the squared speed in (MEASURES, P) so that the limit stands for the cap at each place, if that is lower."""
    if caps is not None:
        measured[SPEED] *= (limits.speed / np.minimum(caps, limits.speed)) ** 2


def turns(path: Path, nodes: int) -> NDArray:
    """Return the angle between the path's directions at the ends of each interval, (N,) rad."""
    s = np.arange(nodes + 1) * (path.end / nodes)
    s[0], s[-1] = s[1], s[-2]  # at rest there is no direction
    return np.asarray(_angles(path(s, 1)))


@njit
def _angles(vectors: NDArray) -> NDArray:
    """Return the angles, (N,) rad, between one vector of (N+1, 3) and the next."""
    angles = np.empty(len(vectors) - 1)
    for n in range(len(angles)):
        x, y, z = vectors[n]
        p, q, r = vectors[n + 1]
        lengths = max(math.sqrt(x * x + y * y + z * z), 1e-12) * max(math.sqrt(p * p + q * q + r * r), 1e-12)
        angles[n] = math.acos(min(max((x * p + y * q + z * r) / lengths, -1.0), 1.0))
    return angles


@njit
def spread(violation: NDArray, continuous: NDArray) -> NDArray:
    """Return (N, MEASURES): extend `continuous` rows to neighbours too, whose points may be as near to the peak."""
    wider, last = violation.copy(), len(violation) - 1
    for row in continuous:
        for n in range(len(violation)):
            before, after = violation[max(n - 1, 0), row], violation[min(n + 1, last), row]
            wider[n, row] = max(violation[n, row], before, after)
    return wider
