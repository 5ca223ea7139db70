"""Drawn vehicles: random draws of what is unknown before a flight, from the spreads of airframe and pose delays.

Each quantity is stratified: its values lie at as many equally probable quantiles as there are draws, shuffled, so that
few draws show the tails of all of them. The same airframe and room always give the same draws.
"""

from dataclasses import dataclass, replace
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from cfplan.safety.limits import PoseLimits
from cfplan.vehicle.airframe import Airframe

DRAWS = 32
RADIO = 0.002  # s, from the pilot to the vehicle
LATENCY_ERROR = 0.003  # s, error of the room's stated latency, either sign
_SEED = 45
_HALF_WIDTH = 1.96  # standard deviations in half the width of 95 %


@dataclass(frozen=True, slots=True)
class Draw:
    """A drawn vehicle in a drawn room."""

    airframe: Airframe
    pose_age: float  # s, of a pose's position when the filter fuses it
    attitude_age: float  # s, of its attitude, which is not extrapolated
    pose_phase: float  # s from the beginning to the first pose
    seed: int  # of the poses' noise


def nominal_draw(airframe: Airframe, pose: PoseLimits) -> Draw:
    """Return the nominal vehicle in the nominal room."""
    return _drawn(airframe, pose, np.zeros(5), np.full(2, 0.5), 0)


def draw_vehicles(airframe: Airframe, pose: PoseLimits, count: int = DRAWS, seed: int = _SEED) -> list[Draw]:
    """Return `count` vehicles, drawn from the spreads of airframe and room."""
    chance = np.random.default_rng(seed)
    quantiles = np.stack([(chance.permutation(count) + 0.5) / count for _ in range(7)], axis=1)
    normal = np.vectorize(NormalDist().inv_cdf)(quantiles[:, :5])
    return [_drawn(airframe, pose, normal[k], quantiles[k, 5:], k + 1) for k in range(count)]


def _drawn(airframe: Airframe, pose: PoseLimits, deviations: NDArray, quantiles: NDArray, seed: int) -> Draw:
    """Return a draw: `deviations`, (5,), in standard deviations; `quantiles`, (2,), of the age and phase of poses."""
    spread, (age, phase) = airframe.spread, quantiles.tolist()
    widths = spread.mass, spread.thrust_scale, spread.drag, spread.velocity_moment, spread.motor_time_constant
    mass, scale, drag, moment, lag = (1.0 + np.array(widths) * deviations / _HALF_WIDTH).tolist()
    vehicle = replace(
        airframe, mass=mass * airframe.mass, thrust_scale=scale * airframe.thrust_scale,
        drag=(drag * airframe.drag[0], drag * airframe.drag[1]),
        velocity_moment=(moment * airframe.velocity_moment[0], moment * airframe.velocity_moment[1]),
        motor_time_constant=lag * airframe.motor_time_constant,
    )  # fmt: skip
    # Cameras expose at any moment between two transmissions of the pilot, which extrapolates positions to these.
    wrong, waited = (2.0 * age - 1.0) * LATENCY_ERROR, phase / pose.rate
    return Draw(vehicle, max(RADIO + wrong, 0.0), max(pose.latency + wrong + waited, 0.0) + RADIO, waited, seed)
