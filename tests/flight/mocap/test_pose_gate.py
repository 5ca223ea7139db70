"""Poses that must not be forwarded are told from those that must."""

import math

import pytest

from cfplan.flight.mocap.pose_gate import PoseGate
from cfplan.flight.mocap.poses import Pose

LEVEL = (0.0, 0.0, 0.0, 1.0)


def pose(time, x=0.0, quaternion=LEVEL):
    return Pose(time, time + 0.01, (x, 0.0, 1.0), quaternion)


@pytest.fixture
def gate():
    judge = PoseGate(jump=0.1)
    assert not judge.fault(pose(1.0))
    return judge


def test_a_pose_that_moves_as_a_vehicle_does_is_good(gate):
    assert not gate.fault(pose(1.01, 0.02))
    assert not gate.fault(pose(1.02, 0.04))


@pytest.mark.parametrize(
    ("bad", "why"),
    [
        (pose(1.01, math.nan), "not a number"),
        (pose(1.01, math.inf), "not a number"),
        (pose(math.nan), "not a number"),
        (pose(1.0, 0.01), "not newer"),
        (pose(0.9, 0.01), "not newer"),
        (pose(1.01), "frozen"),
        (pose(1.01, 1.0), "jumped"),
        (pose(1.01, 0.01, (0.0, 0.0, 1.0, 0.0)), "turned 180"),
        (pose(1.01, 0.01, (0.0, 0.0, 0.0, 0.0)), "no rotation"),
    ],
)
def test_a_bad_pose_is_named_and_forgotten(gate, bad, why):
    assert why in gate.fault(bad)
    assert gate.last == pose(1.0)
    assert not gate.fault(pose(1.02, 0.02))


def test_the_sign_of_a_quaternion_means_nothing(gate):
    assert not gate.fault(pose(1.01, 0.01, (0.0, 0.0, 0.0, -1.0)))


def test_after_a_dropout_a_vehicle_may_have_gone_far(gate):
    assert not gate.fault(pose(1.5, 1.0))


def test_after_a_dropout_a_pose_must_agree_with_what_the_vehicle_believes(gate):
    jumped, back = pose(1.4, 1.0), pose(1.41, 0.6)
    assert "0.40 m from the estimate" in gate.fault(jumped, believed=(0.6, 0.0, 1.0))
    assert gate.last == pose(1.0)
    assert not gate.fault(back, believed=(0.62, 0.0, 1.0))
    assert not gate.fault(pose(1.42, 0.61), believed=(5.0, 0.0, 1.0))  # there is no dropout any more


def test_what_the_vehicle_believes_may_drift_in_a_long_dropout(gate):
    assert not gate.fault(pose(3.0, 0.9), believed=(0.0, 0.0, 1.0))
