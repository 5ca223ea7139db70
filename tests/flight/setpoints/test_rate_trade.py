"""The trade of rates for attitude: exact, bounded, and braking where setpoints stop."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from cfplan.flight.setpoints.packets import FullStateSetpoints
from cfplan.flight.setpoints.rate_trade import (
    BRAKE_RATE_MAX,
    TRADED_RATE_MAX,
    AttitudeGains,
    ahead,
    harmless_rates,
    trade_rates,
    turns_for,
)
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.rotations import rotations_of

GRAVITATION = np.array([0.0, 0.0, GRAVITY])


def motion_of(velocity, rate, thrust=9.0, rotvec=(0.3, -0.2, 1.0)) -> FullStateSetpoints:
    turn = Rotation.from_rotvec([rotvec])
    return FullStateSetpoints(
        position=np.zeros((1, 3)),
        velocity=np.array([velocity], dtype=float),
        acceleration=turn.apply([[0.0, 0.0, thrust]]) - GRAVITATION,
        quaternion=turn.as_quat(),
        body_rate=np.array([rate], dtype=float),
    )


vectors = arrays(float, 3, elements=st.floats(-5.0, 5.0))


@given(vectors, vectors, st.floats(3.0, 15.0), arrays(float, 3, elements=st.floats(-1.0, 1.0)), vectors)
def test_torque_and_thrust_are_those_of_the_motion(velocity, rate, thrust, rotvec, coming):
    """Twice kR times the sine of the turn, and kw times the rates: written out, not as the trade computes them."""
    motion = motion_of(velocity, rate, thrust, rotvec)
    sent = trade_rates(motion, coming[None])
    turned = (Rotation.from_quat(motion.quaternion).inv() * Rotation.from_quat(sent.quaternion)).as_rotvec()[0]
    size = np.linalg.norm(turned)
    sine = np.sin(size) / size * turned if size else turned
    torque = 2 * 70000.0 * sine[:2] + 20000.0 * sent.body_rate[0, :2]
    assert torque == pytest.approx(20000.0 * rate[:2], abs=1e-3)
    assert turned[2] == pytest.approx(0.0, abs=1e-9)
    force = sent.acceleration[0] + GRAVITATION
    assert force / np.linalg.norm(force) == pytest.approx(Rotation.from_quat(sent.quaternion).apply([0, 0, 1])[0])
    assert force @ Rotation.from_quat(motion.quaternion).as_matrix()[0, :, 2] == pytest.approx(thrust)
    assert sent.body_rate[0, 2] == rate[2]


@given(vectors, vectors, vectors)
def test_rates_are_what_brakes_and_what_exceeds_the_most(velocity, rate, coming):
    motion = motion_of(velocity, rate)
    sent = trade_rates(motion, coming[None]).body_rate
    assert sent[:, :2] == pytest.approx(harmless_rates(motion, coming[None]), abs=0.51e-3)
    assert np.linalg.norm(rate[:2] - sent[0, :2]) <= TRADED_RATE_MAX + 1e-3
    excess = max(np.linalg.norm(rate[:2]) + BRAKE_RATE_MAX - TRADED_RATE_MAX, 0.0)
    assert np.linalg.norm(sent[0, :2]) <= BRAKE_RATE_MAX + excess + 1e-3


@given(st.floats(-np.pi, np.pi), st.floats(0.1, 1.0), st.floats(-np.pi, np.pi))
def test_the_tilt_at_which_level_out_settles_brakes_the_speed_left(direction, speed, yaw):
    """That tilt turns the torque of the rate off: asin of the rate over 7 rad/s, about the axis of the rate."""
    velocity = speed * np.array([np.cos(direction), np.sin(direction), 0.0])
    sent = trade_rates(motion_of(velocity, (0.0, 0.0, 0.0), rotvec=(0.0, 0.0, yaw)), np.zeros((1, 3)))
    settled = Rotation.from_euler("z", yaw) * Rotation.from_matrix(rotations_of(turns_for(sent.body_rate[:, :2]))[0])
    axis = settled.apply([0.0, 0.0, 1.0])
    assert GRAVITY * axis[:2] / axis[2] == pytest.approx(-0.41 * velocity[:2], abs=2e-3)


def test_a_hover_sends_no_rates():
    sent = trade_rates(motion_of((0, 0, 0), (0, 0, 0.5), 9.81, (0, 0, 2.0)), np.zeros((1, 3)))
    assert np.all(sent.body_rate == [0.0, 0.0, 0.5])
    assert sent.acceleration == pytest.approx(0.0, abs=1e-12)


def test_other_gains_make_other_turns():
    strong = AttitudeGains(kR_xy=140000.0)
    assert strong.full_rate == pytest.approx(14.0)
    assert turns_for(np.array([[3.5, 0.0]]))[0, 0] == pytest.approx(np.radians(30.0))
    assert turns_for(np.array([[7.0, 0.0]]), strong)[0, 0] == pytest.approx(np.radians(30.0))


def test_the_acceleration_ahead_is_that_of_fifteen_setpoints_later_and_the_last_holds():
    values = np.arange(40.0)[:, None] * np.ones(3)
    assert ahead(values, 100.0)[:, 0] == pytest.approx(np.minimum(np.arange(40) + 15, 39))
