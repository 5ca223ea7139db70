"""Motion since a pose is known from accelerometer and gyroscope, whatever the vehicle's filter believes."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cfplan.flight.mocap.dead_reckoning import SensedMotion
from cfplan.flight.telemetry import Estimate, VehicleStatus

LEVEL = (0.0, 0.0, 0.0, 1.0)
ASTRAY = (9.0, 9.0, 9.0)  # what the filter believes must not matter
LAST = 0.5  # s, of the last pose
NOW = 0.64  # s


def place(time):
    """Half a turn a second about the vertical, with 6.9 m/s² at 2.2 m/s."""
    return 0.7 * math.cos(math.pi * time), 0.7 * math.sin(math.pi * time), 1.0 + 0.3 * time


def acceleration(time):
    return -(math.pi**2) * place(time)[0], -(math.pi**2) * place(time)[1], 0.0


def rate(time):
    """In body axes: about x, y and z at once, faster and faster, as a vehicle tumbles."""
    return 20.0 * time, -4.0, 2.0 * math.cos(8.0 * time)


def log(until=NOW, missing=(math.inf, math.inf)):
    sensed = SensedMotion()
    for time in np.arange(0.3, until, 0.01).tolist():
        if not missing[0] < time < missing[1]:
            sensed.note(Estimate(time, ASTRAY, ASTRAY, acceleration(time), LEVEL), None)
    for time in np.arange(0.3, until, 0.02).tolist():
        sensed.note(None, VehicleStatus(time, rate(time), (0, 0, 0, 0), 4.0, 0))
    return sensed


AT = LAST - 0.03  # s, of a velocity that is known


def way(sensed):
    velocity = (np.array(place(AT + 1e-4)) - place(AT - 1e-4)) / 2e-4
    return sensed.displacement(tuple(velocity.tolist()), AT, LAST, NOW)


def test_a_turn_at_full_acceleration_is_followed_within_a_centimetre():
    assert way(log()) == pytest.approx(np.subtract(place(NOW), place(LAST)).tolist(), abs=0.01)


def test_a_tumbling_vehicle_is_turned_as_its_gyroscope_says():
    turned = Rotation.identity()
    for time in np.arange(LAST, NOW, 1e-4).tolist():
        turned *= Rotation.from_rotvec(np.array(rate(time + 5e-5)) * 1e-4)
    reckoned = Rotation.from_quat(log().turn(LEVEL, LAST, NOW))
    assert turned.magnitude() > 1.0
    assert (reckoned.inv() * turned).magnitude() < math.radians(2.0)


def test_the_same_message_twice_counts_once():
    sensed = log()
    sensed.note(Estimate(NOW - 0.01, ASTRAY, ASTRAY, ASTRAY, LEVEL), None)
    assert way(sensed) == way(log())


@pytest.mark.parametrize("missing", [(0.0, 0.49), (0.5, 0.62), (0.5, 1.0)])
def test_what_the_log_does_not_tell_is_not_guessed(missing):
    assert way(log(missing=missing)) is None


def test_without_any_log_nothing_is_known():
    sensed = SensedMotion()
    sensed.note(None, None)
    assert way(sensed) is None
    assert sensed.turn(LEVEL, LAST, NOW) is None
