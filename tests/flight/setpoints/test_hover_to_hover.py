"""From hover to hover by setpoints."""

import numpy as np
import pytest

from cfplan.flight.setpoints.encoding import encode_motion
from cfplan.flight.setpoints.hover_to_hover import hover_to_hover
from cfplan.flight.setpoints.packets import decode
from cfplan.flight.setpoints.rate_trade import ahead
from cfplan.vehicle.rotations import yaw_of

BEGIN, END = (0.5, -1.0, 0.3), (-1.0, 2.0, 1.1)


@pytest.fixture
def told():
    return hover_to_hover(BEGIN, 3.0, END, -3.0, 5.0, 100.0)


def sent(motion):
    return decode(encode_motion(motion, ahead(motion.acceleration, 100.0)))


def test_it_begins_and_ends_at_rest_where_it_should(told):
    assert told.position[0] == pytest.approx(BEGIN, abs=1e-3)
    assert told.position[-1] == pytest.approx(END, abs=1e-3)
    for row in (0, -1):
        for field in (told.velocity, told.acceleration, told.body_rate):
            assert np.all(field[row] == 0.0)
    last = sent(told)
    for field in (last.velocity, last.acceleration, last.body_rate):
        assert np.all(field[-1] == 0.0)


def test_the_roll_and_pitch_rates_that_are_sent_lean_against_the_motion(told):
    """Level-out settles at a tilt that goes with the last rates: nose up, so that it brakes, at full speed ahead."""
    halfway = len(told.position) // 2
    straight = hover_to_hover((0.0, 0.0, 1.0), 0.0, (3.0, 0.0, 1.0), 0.0, 5.0, 100.0)
    roll, pitch, yaw = sent(straight).body_rate[halfway]
    assert -1.2 <= pitch < -0.2
    assert abs(roll) < 0.01
    assert yaw == 0.0


def test_velocity_and_acceleration_are_the_derivatives_of_position(told):
    velocity = (told.position[4:] - told.position[:-4]) / 0.04
    acceleration = (told.velocity[4:] - told.velocity[:-4]) / 0.04
    assert velocity == pytest.approx(told.velocity[2:-2], abs=0.03)
    assert acceleration == pytest.approx(told.acceleration[2:-2], abs=0.03)


def test_it_is_straight(told):
    way = np.subtract(END, BEGIN)
    across = np.cross(told.position - BEGIN, way / np.linalg.norm(way))
    assert np.abs(across).max() < 1e-3


def test_it_turns_the_shorter_way(told):
    x, y, _, _ = told.quaternion.T
    yaw = np.unwrap(yaw_of(told.quaternion.T), period=2 * np.pi)
    assert 2.0 * np.hypot(x, y).max() < 0.1  # it leans a little
    assert np.ptp(yaw) == pytest.approx(2 * np.pi - 6.0, abs=0.02)
    assert np.sum(told.body_rate[:, 2]) / 100.0 == pytest.approx(2 * np.pi - 6.0, abs=0.01)


def test_a_transfer_to_the_same_place_hovers():
    told = sent(hover_to_hover(BEGIN, 0.0, BEGIN, 0.0, 1.5, 100.0))
    assert np.ptp(told.position, axis=0) == pytest.approx([0.0, 0.0, 0.0])
