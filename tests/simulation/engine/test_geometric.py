"""The geometric controller: near hover its loops are the second-order systems that its gains say."""

from dataclasses import replace

import numpy as np
import pytest

from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.yaw import YawMode
from cfplan.planners.expert.expert import plan_expert
from cfplan.planners.task import PlanningTask
from cfplan.safety.limit_sets import PAPER
from cfplan.simulation.engine.geometric import (
    ATTITUDE_GAINS,
    POSITION_GAINS,
    RATE,
    RATE_GAINS,
    REFERENCE_SIZE,
    VELOCITY_GAINS,
    follow,
    reference_rows,
)
from cfplan.simulation.engine.layout import POSITION, QUATERNION, hovering
from cfplan.simulation.geometric_flight import LOST, fly_geometric, nearest_states, thrust_violation
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.rotations import about_z, yaw_of
from cfplan.vehicle.trajectory import Trajectory

FRAME = replace(PAPER.airframe, motor_time_constant=1e-4, drag=(0.0, 0.0))


@pytest.fixture(scope="module")
def trajectory():
    path = min_snap([[0, 0, 0], [3, 1, 1], [2, 5, 0]])
    task = PlanningTask(path, PAPER.airframe, PAPER.limits, 99, YawMode.FREE)
    profile = plan_expert(task).profile
    assert profile is not None
    return Trajectory(path, profile, PAPER.airframe)


def hover_reference(seconds: float) -> np.ndarray:
    reference = np.zeros((round(seconds / 0.002), REFERENCE_SIZE))
    reference[:, 8] = GRAVITY
    return reference


def settled_from_one(stiffness: float, damping: float, times: np.ndarray) -> np.ndarray:
    """x'' = -k x - d x' from rest at 1."""
    first, second = np.roots([1.0, damping, stiffness])
    return ((second * np.exp(first * times) - first * np.exp(second * times)) / (second - first)).real


@pytest.mark.parametrize(("axis", "tolerance"), [(2, 0.01), (0, 0.08)], ids=["up", "sideways, by way of attitude"])
def test_a_small_offset_vanishes_as_the_position_gains_say(axis, tolerance):
    start = hovering(FRAME, np.zeros(3))
    start[axis] = 0.01
    flight = follow(hover_reference(1.5), FRAME, start)
    wanted = settled_from_one(POSITION_GAINS[axis], VELOCITY_GAINS[axis], flight.time)
    assert flight.states[:, axis] / 0.01 == pytest.approx(wanted, abs=tolerance)


def test_a_small_turn_vanishes_as_the_attitude_gains_say():
    start = hovering(FRAME, np.zeros(3))
    start[QUATERNION] = about_z(0.05)
    flight = follow(hover_reference(0.5), FRAME, start)
    yaw = np.array([float(yaw_of(quaternion)) for quaternion in flight.states[:, QUATERNION]])
    wanted = settled_from_one(ATTITUDE_GAINS[2], RATE_GAINS[2], flight.time)
    assert yaw / 0.05 == pytest.approx(wanted, abs=0.06)


def test_a_feasible_trajectory_is_followed_and_asks_for_hardly_more_than_there_is(trajectory):
    found = fly_geometric(trajectory, replace(PAPER.airframe, motor_time_constant=0.005))
    assert 0.0 < found.deviation < 0.03
    assert found.asked_violation < 1e-3
    assert not found.failed
    grid = trajectory.time_at(trajectory.profile.s)
    places, speeds = nearest_states(found.flight, trajectory, grid)
    assert len(places) == len(grid) - 1
    assert places.max() < 0.05  # on the way from one node to the next, at 1 ms and 5 m/s
    assert speeds.max() < 0.5


def test_without_feed_forward_of_rates_it_is_followed_worse(trajectory):
    frame = replace(PAPER.airframe, motor_time_constant=0.005)
    times = np.arange(0.0, trajectory.duration, 0.002)
    reference = reference_rows(trajectory.at(times))
    plain = reference.copy()
    plain[:, RATE:] = 0.0
    start = hovering(frame, reference[0, :3])
    flown = [follow(rows, frame, start).states[:-1:2, POSITION] for rows in (reference, plain)]
    away = [np.linalg.norm(places - reference[:, :3], axis=1).max() for places in flown]
    assert away[1] > 3 * away[0]


def test_what_motors_cannot_follow_is_lost_and_counts_as_a_metre(trajectory):
    found = fly_geometric(trajectory, replace(PAPER.airframe, motor_time_constant=0.072))
    assert found.failed
    assert found.deviation == LOST


def test_violation_is_the_mean_excess_of_both_ends():
    frame = replace(FRAME, motor_thrust_min=0.01, motor_thrust_max=0.1)
    thrust = np.array([[0.05, 0.12, 0.0, 0.05], [0.05] * 4])
    assert thrust_violation(thrust, frame) == pytest.approx((0.02 + 0.01) / 8)
