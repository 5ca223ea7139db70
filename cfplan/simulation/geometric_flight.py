"""Flights under a geometric controller, as in the paper's simulations: deviation, thrust asked, states reached.

They show how well a motion can be followed at all, by a controller that knows the true state and the trajectory. How a
Crazyflie follows the bytes that it is sent is the subject of the dry run.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from cfplan.simulation.engine.body import TIME_STEP
from cfplan.simulation.engine.geometric import (
    CONTROL_STEPS,
    BodyStep,
    GeometricFlight,
    follow,
    follow_by,
    reference_rows,
)
from cfplan.simulation.engine.layout import POSITION, VELOCITY, hovering
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.trajectory import Trajectory

LOST = 1.0  # m, deviation at which a flight has failed and ends (as in the paper)
SETTLING = 1.0  # s simulated after the end of the motion


@dataclass(frozen=True, slots=True)
class FollowedFlight:
    """The result of following a trajectory."""

    deviation: float  # m, largest distance from the trajectory at the same time; LOST if it failed
    asked_violation: float  # N, commanded thrust beyond a motor's range, mean over time and motors
    flight: GeometricFlight

    @property
    def failed(self) -> bool:
        """Return whether it crashed or was LOST."""
        return self.deviation >= LOST

    @property
    def top_speed(self) -> float:
        """Return the highest speed, m/s; NaN if the state diverged."""
        return float(np.linalg.norm(self.flight.states[:, VELOCITY], axis=1).max())


def fly_geometric(trajectory: Trajectory, airframe: Airframe) -> FollowedFlight:
    """Follow the trajectory from a hover at its start, on `airframe`, for SETTLING longer than it lasts."""
    wanted = trajectory.at(control_times(trajectory))
    flight = follow(reference_rows(wanted), airframe, hovering(airframe, wanted.position[0], float(wanted.yaw[0])))
    away = np.linalg.norm(flight.states[:-1:CONTROL_STEPS, POSITION] - wanted.position, axis=1)
    lost = np.flatnonzero(~(away < LOST))
    last = int(lost[0]) if len(lost) else len(away)
    asked = flight.asked[: max(CONTROL_STEPS * last, 1)]
    return FollowedFlight(LOST if len(lost) else float(away.max()), thrust_violation(asked, airframe), flight)


def control_times(trajectory: Trajectory) -> NDArray:
    """Return the controller's times, (K,) s from the start of the motion to SETTLING after its end."""
    return np.arange(0.0, trajectory.duration + SETTLING, CONTROL_STEPS * TIME_STEP)


def positions_by_both(step: BodyStep, trajectory: Trajectory, airframe: Airframe) -> tuple[NDArray, NDArray, NDArray]:
    """Return where the trajectory, another body and cfplan's with `airframe` are at `control_times`, (K, 3) m each.

    The same geometric controller flies both, from a hover at the start.
    """
    wanted = trajectory.at(control_times(trajectory))
    reference, start = reference_rows(wanted), hovering(airframe, wanted.position[0], float(wanted.yaw[0]))
    own = follow(reference, airframe, start).states[:-1:CONTROL_STEPS, POSITION]
    return wanted.position, follow_by(step, reference, airframe, start), own


def thrust_violation(thrust: NDArray, airframe: Airframe) -> float:
    """Return the excess of thrusts, (N, 4) N, over the motors' range, mean over time and motors."""
    low, high = airframe.motor_thrust_min, airframe.motor_thrust_max
    return float(np.mean(np.maximum(thrust - high, 0.0) + np.maximum(low - thrust, 0.0)))


def nearest_states(flight: GeometricFlight, trajectory: Trajectory, times: NDArray) -> tuple[NDArray, NDArray]:
    """Return how near the flight comes to each planned state in the time before it: metres and m/s, (N-1,) each.

    `times`, (N,) s ascending, are those of the planned states r(sᵢ). From the state reached at tᵢ the controller goes
    on towards r(sᵢ₊₁) until tᵢ₊₁; of the states on the way the one with the nearest position is used.
    """
    planned = trajectory.at(times[1:])
    places, speeds = np.full(len(times) - 1, np.inf), np.full(len(times) - 1, np.inf)
    for n, (begin, end) in enumerate(pairwise(times)):
        way = slice(int(begin / TIME_STEP), int(np.ceil(end / TIME_STEP)) + 1)
        away = np.linalg.norm(flight.states[way, POSITION] - planned.position[n], axis=1)
        if len(away) and np.isfinite(away).all():
            best = int(np.argmin(away))
            places[n] = away[best]
            speeds[n] = np.linalg.norm(flight.states[way, VELOCITY][best] - planned.velocity[n])
    return places, speeds
