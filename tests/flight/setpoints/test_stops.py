"""Stops: on the path, ending at rest, and true to their own accelerations."""

from dataclasses import replace

import numpy as np
import pytest

from cfplan.flight.setpoints.encoding import RATE_LEAD, command_quaternion, controller_attitude
from cfplan.flight.setpoints.level_out import UNTIL_WATCHDOG
from cfplan.flight.setpoints.packets import FullStateSetpoints, decode
from cfplan.flight.setpoints.stops import encode_stops, rest_behind, stop_motion
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.rotations import hopf_quaternion, yaw_of


@pytest.fixture
def circle() -> FullStateSetpoints:
    """A circle of 1 m at 1.8 m/s, level flight, yaw along the way."""
    time = np.arange(300) / 100.0
    angle = 1.8 * time
    zero = np.zeros_like(angle)
    yaw = angle + np.pi / 2
    return FullStateSetpoints(
        position=np.stack([np.cos(angle), np.sin(angle), zero + 1.0], axis=1),
        velocity=1.8 * np.stack([-np.sin(angle), np.cos(angle), zero], axis=1),
        acceleration=-(1.8**2) * np.stack([np.cos(angle), np.sin(angle), zero], axis=1),
        quaternion=np.stack([zero, zero, np.sin(yaw / 2), np.cos(yaw / 2)], axis=1),
        body_rate=np.stack([zero, zero, zero + 1.8], axis=1),
    )


def stop_from(motion: FullStateSetpoints, row: int, **given) -> FullStateSetpoints:
    """The motion of one stop, nothing of it ahead."""
    return stop_motion(motion, np.array([row]), 100.0, **{"rate_lead": 0.0, "thrust_lead": 0.0} | given)[0]


def test_a_stop_stays_on_the_path_and_ends_at_rest(circle):
    stop = stop_from(circle, 100)
    radius = np.linalg.norm(stop.position[:, :2], axis=1)
    assert radius == pytest.approx(1.0, abs=2e-3)
    assert np.all(stop.velocity[-1] == 0.0)
    last = decode(encode_stops(circle, 100.0)[100, -1:])
    for field in (last.velocity, last.body_rate):
        assert np.all(field == 0.0)
    assert np.all(np.abs(last.acceleration) <= 1e-3)


def test_a_stop_begins_where_the_setpoint_was(circle):
    stops = encode_stops(circle, 100.0)
    for row in (0, 57, 150):
        first = decode(stops[row, :1])
        assert first.position[0] == pytest.approx(circle.position[row], abs=1e-3)
        assert first.velocity[0] == pytest.approx(circle.velocity[row], abs=1e-3)
        assert stop_from(circle, row).acceleration[0] == pytest.approx(circle.acceleration[row], abs=1e-9)


def test_a_stop_from_a_leaning_attitude_keeps_the_planned_yaw(circle):
    """Euler yaw of that attitude differs by degrees, and a vehicle that stopped often would turn away."""
    force = circle.acceleration + np.array([0.0, 0.0, GRAVITY])
    axis = tuple((force / np.linalg.norm(force, axis=1, keepdims=True)).T)
    leaning = np.stack(hopf_quaternion(axis, np.cos(0.25), np.sin(0.25)), axis=1)
    motion = replace(circle, quaternion=leaning)
    assert np.abs(yaw_of(leaning.T) - 0.5).max() > 0.01
    assert np.abs(np.sum(stop_from(motion, 57).quaternion[0] * leaning[57])) == pytest.approx(1.0, abs=1e-12)
    for row in range(0, 300, 50):
        assert rest_behind(motion, row, 100.0)[1] == pytest.approx(0.5, abs=1e-12)


def test_velocity_and_acceleration_are_the_derivatives_of_position(circle):
    stop = stop_from(circle, 100)
    velocity = (stop.position[4:] - stop.position[:-4]) / 0.04
    acceleration = (stop.velocity[4:] - stop.velocity[:-4]) / 0.04
    assert velocity == pytest.approx(stop.velocity[2:-2], abs=0.05)
    assert acceleration == pytest.approx(stop.acceleration[2:-2], abs=0.12)


def test_the_stop_takes_at_most_its_share_of_deceleration(circle):
    stop = stop_from(circle, 100, duration=0.8)
    along = np.sum(stop.acceleration * stop.velocity, axis=1) / np.maximum(np.linalg.norm(stop.velocity, axis=1), 0.1)
    assert np.min(along) == pytest.approx(-1.875 * 1.8 / 0.8, rel=0.03)


def test_body_rates_are_those_of_the_attitudes_that_the_controller_makes(circle):
    stop = stop_from(circle, 100)
    made = controller_attitude(stop.acceleration + np.array([0.0, 0.0, GRAVITY]), command_quaternion(stop.quaternion))
    turn = np.swapaxes(made[:-8], 1, 2) @ made[8:]  # over 80 ms, so that the quaternion's rounding is small
    rate = np.stack([turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], 1)
    assert rate / 2.0 / 0.08 == pytest.approx(stop.body_rate[4:-4], abs=0.2)


def test_rates_and_the_length_of_the_thrust_vector_are_sent_ahead(circle):
    stop, sent = stop_from(circle, 100), stop_from(circle, 100, rate_lead=0.02, thrust_lead=0.05)
    later, before = stop.body_rate[4:-1], stop.body_rate[:-5]
    assert sent.body_rate[2:-3] == pytest.approx(0.8 * later + 0.2 * before)
    gravity = np.array([0.0, 0.0, GRAVITY])
    force, now, later = sent.acceleration[:-5] + gravity, stop.acceleration[:-5] + gravity, stop.acceleration[5:]
    assert np.linalg.norm(force, axis=1) == pytest.approx(np.linalg.norm(later + gravity, axis=1))
    assert np.cross(force, now) == pytest.approx(0.0, abs=1e-9)


def test_a_stop_at_the_end_of_the_plan_does_not_run_past_it(circle):
    stops = encode_stops(circle, 100.0)
    assert decode(stops[-1]).position == pytest.approx(np.tile(circle.position[-1], (121, 1)), abs=1e-3)


def test_roll_and_pitch_rates_are_sent_as_attitude(circle):
    planned, sent = stop_from(circle, 100, rate_lead=RATE_LEAD), decode(encode_stops(circle, 100.0)[100])
    assert np.linalg.norm(planned.body_rate[:, :2], axis=1).max() > 1.0
    assert np.linalg.norm(sent.body_rate[:, :2], axis=1).max() <= UNTIL_WATCHDOG.rate_max + 1e-3
    assert sent.body_rate[:, 2] == pytest.approx(planned.body_rate[:, 2], abs=0.6e-3)


def test_many_stops_are_those_that_are_made_one_by_one(circle):
    whole = encode_stops(circle, 100.0)
    for row in (0, 5, 199, 200, 280):
        np.testing.assert_array_equal(encode_stops(circle, 100.0, rows=np.array([row])), whole[[row]])
