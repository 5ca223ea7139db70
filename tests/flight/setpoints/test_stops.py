"""Stops: on the path, ending at rest, and true to their own accelerations."""

import numpy as np
import pytest

from cfplan.flight.setpoints.encoding import controller_attitude
from cfplan.flight.setpoints.packets import FullStateSetpoints, decode, encode
from cfplan.flight.setpoints.stops import encode_stops
from cfplan.vehicle.airframe import GRAVITY


@pytest.fixture
def circle() -> np.ndarray:
    """The payloads of a circle of 1 m at 1.8 m/s, level flight, yaw along the way."""
    time = np.arange(300) / 100.0
    angle = 1.8 * time
    zero = np.zeros_like(angle)
    yaw = angle + np.pi / 2
    return encode(
        FullStateSetpoints(
            position=np.stack([np.cos(angle), np.sin(angle), zero + 1.0], axis=1),
            velocity=1.8 * np.stack([-np.sin(angle), np.cos(angle), zero], axis=1),
            acceleration=-(1.8**2) * np.stack([np.cos(angle), np.sin(angle), zero], axis=1),
            quaternion=np.stack([zero, zero, np.sin(yaw / 2), np.cos(yaw / 2)], axis=1),
            body_rate=np.stack([zero, zero, zero + 1.8], axis=1),
        )
    )


def test_a_stop_stays_on_the_path_and_ends_at_rest(circle):
    stop = decode(encode_stops(circle, 100.0)[100])
    radius = np.linalg.norm(stop.position[:, :2], axis=1)
    assert radius == pytest.approx(1.0, abs=2e-3)
    assert np.all(stop.velocity[-1] == 0.0)
    assert np.all(stop.body_rate[-1] == 0.0)
    assert np.all(np.abs(stop.acceleration[-1]) <= 1e-3)


def test_a_stop_begins_where_the_setpoint_was(circle):
    reference, stops = decode(circle), encode_stops(circle, 100.0)
    for row in (0, 57, 150):
        first = decode(stops[row, :1])
        assert first.position[0] == pytest.approx(reference.position[row], abs=1e-3)
        assert first.velocity[0] == pytest.approx(reference.velocity[row], abs=1e-3)
        assert first.acceleration[0] == pytest.approx(reference.acceleration[row], abs=1e-3)


def test_velocity_and_acceleration_are_the_derivatives_of_position(circle):
    stop = decode(encode_stops(circle, 100.0)[100])
    velocity = (stop.position[4:] - stop.position[:-4]) / 0.04
    acceleration = (stop.velocity[4:] - stop.velocity[:-4]) / 0.04
    assert velocity == pytest.approx(stop.velocity[2:-2], abs=0.05)
    assert acceleration == pytest.approx(stop.acceleration[2:-2], abs=0.12)


def test_the_stop_takes_at_most_its_share_of_deceleration(circle):
    stop = decode(encode_stops(circle, 100.0, duration=0.8)[100])
    along = np.sum(stop.acceleration * stop.velocity, axis=1) / np.maximum(np.linalg.norm(stop.velocity, axis=1), 0.1)
    assert np.min(along) == pytest.approx(-1.5 * 1.8 / 0.8, rel=0.03)


def test_body_rates_are_those_of_the_attitudes_that_the_controller_makes(circle):
    stop = decode(encode_stops(circle, 100.0)[100])
    made = controller_attitude(stop.acceleration + np.array([0.0, 0.0, GRAVITY]), stop.quaternion)
    turn = np.swapaxes(made[:-8], 1, 2) @ made[8:]  # over 80 ms, so that the quaternion's rounding is small
    rate = np.stack([turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], 1)
    ahead = (stop.body_rate[3:-5] + stop.body_rate[2:-6]) / 2.0  # sent 15 ms ahead
    assert rate / 2.0 / 0.08 == pytest.approx(ahead, abs=0.35)


def test_a_stop_at_the_end_of_the_plan_does_not_run_past_it(circle):
    reference, stops = decode(circle), encode_stops(circle, 100.0)
    assert decode(stops[-1]).position == pytest.approx(np.tile(reference.position[-1], (81, 1)), abs=1e-3)
