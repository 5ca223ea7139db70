"""A pose is carried on to the moment in which it is sent."""

import math

import numpy as np
import pytest

from cfplan.flight.mocap.pose_predictor import FARTHEST, PosePredictor
from cfplan.flight.mocap.poses import Pose

LEVEL = (0.0, 0.0, 0.0, 1.0)
_TIMES = tuple(np.arange(20) * 0.01)


def filled(place, times=_TIMES):
    forecast = PosePredictor()
    for time in times:
        forecast.add(Pose(time, time, place(time), LEVEL))
    return forecast


def test_steady_motion_is_carried_on_exactly():
    forecast = filled(lambda t: (2.0 * t, -1.0 * t, 1.0))
    assert forecast.velocity() == pytest.approx((2.0, -1.0, 0.0))
    assert forecast.position(0.21) == pytest.approx((0.42, -0.21, 1.0))
    assert forecast.middle == pytest.approx(0.16, abs=0.006)


def test_before_there_are_some_poses_there_is_no_line():
    few = filled(lambda t: (2.0 * t, 0.0, 0.0), times=(0.0, 0.01))
    assert math.isnan(few.middle)
    assert few.velocity() == (0.0, 0.0, 0.0)


def test_hard_acceleration_costs_millimetres():
    forecast = filled(lambda t: (2.5 * t**2, 0.0, 1.0))
    ahead = 0.19 + 0.017
    assert forecast.position(ahead)[0] == pytest.approx(2.5 * ahead**2, abs=0.005)


def test_noise_is_hardly_made_worse():
    chance = np.random.default_rng(3)
    errors = []
    for _ in range(300):
        forecast = filled(lambda t: tuple(chance.normal(0.0, 0.001, 3)))
        errors.append(forecast.position(0.19 + 0.017))
    assert np.std(errors) < 0.0013


def test_one_pose_is_taken_as_it_is():
    assert filled(lambda t: (1.0, 2.0, 3.0), [0.0]).position(0.01) == (1.0, 2.0, 3.0)


def test_nothing_is_carried_far():
    forecast = filled(lambda t: (2.0 * t, 0.0, 1.0))
    assert forecast.position(9.0)[0] == pytest.approx(2.0 * (0.19 + FARTHEST))


def test_after_a_gap_old_poses_do_not_count():
    forecast = filled(lambda t: (2.0 * t, 0.0, 1.0))
    forecast.add(Pose(1.0, 1.0, (0.0, 0.0, 1.0), LEVEL))
    assert forecast.velocity() == (0.0, 0.0, 0.0)
    assert math.isclose(forecast.position(1.01)[0], 0.0)
