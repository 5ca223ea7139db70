"""Motions with given segment times: paths whose parameter is time, and a min-snap timing like MFBOTrajectory's.

The cheap check of that timing evaluates the flatness map: motors and the 5 m/s limit. The expensive check flies the
motion in closed loop: it must be followed, within 5 m/s.
"""

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError
from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.path import Path
from cfplan.safety.limit_sets import PAPER
from cfplan.simulation.geometric_flight import fly_geometric
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.trajectory import Trajectory
from studies.paper.bayesian_times import Budget, optimise_times
from studies.paper.trials import FLOWN, NODES

FOLLOWED = 0.1  # m, largest deviation in closed loop
SAMPLE = 0.01  # s between evaluations of the flatness map
QUICK_BUDGET = Budget(low=60, high=6, iterations=2, more_low=2)


def timed_trajectory(timed: Path) -> Trajectory:
    """Return the motion of a path whose parameter s is time, s, with yaw 0."""
    grid, zeros = np.linspace(0.0, timed.end, NODES + 1), np.zeros(NODES + 1)
    profile = SpeedProfile(grid, np.ones(NODES + 1), zeros, zeros, zeros[1:], zeros, zeros, zeros[1:])
    return Trajectory(timed, profile, PAPER.airframe)


def bayesian_motion(waypoints: NDArray, *, budget: Budget, seed: int) -> Trajectory:
    """Return the min-snap motion through waypoints, (K, 3) m, with the fastest segment times found.

    Raises:
        InfeasibleError: no uniform timing can be flown.
        InputError: scikit-learn is not installed.
    """

    def motion(times: NDArray) -> Trajectory | None:
        try:
            return timed_trajectory(min_snap(waypoints, times=times))
        except InputError:  # the times are too unequal for a smooth path
            return None

    def low(times: NDArray) -> bool:
        planned = motion(times)
        return planned is not None and keeps_limits(planned)

    def high(times: NDArray) -> bool:
        planned = motion(times)
        return planned is not None and is_followed(planned)

    nominal = np.linalg.norm(np.diff(waypoints, axis=0), axis=1)  # s at 1 m/s
    found = optimise_times(nominal, low, high, budget=budget, seed=seed)
    return timed_trajectory(min_snap(waypoints, times=found.times))


def keeps_limits(planned: Trajectory) -> bool:
    """Return whether thrusts and speed stay within their limits by the flatness map: the cheap check."""
    state = planned.at(np.arange(0.0, planned.duration, SAMPLE))
    airframe, thrust = PAPER.airframe, state.motor_thrust
    within = airframe.motor_thrust_min <= thrust.min() and thrust.max() <= airframe.motor_thrust_max
    return bool(within and np.linalg.norm(state.velocity, axis=1).max() <= PAPER.limits.speed)


def is_followed(planned: Trajectory) -> bool:
    """Return whether a motion is followed in closed loop, within the speed limit: the expensive check."""
    followed = fly_geometric(planned, FLOWN)
    return followed.deviation <= FOLLOWED and followed.top_speed <= PAPER.limits.speed
