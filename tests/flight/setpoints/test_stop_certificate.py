"""Stops held against the limits, by their bytes."""

from dataclasses import replace

import numpy as np
import pytest

from cfplan.errors import NotCertifiedError
from cfplan.flight.setpoints.packets import decode, encode
from cfplan.flight.setpoints.stop_certificate import certify_stops
from cfplan.flight.setpoints.stops import encode_stops


@pytest.fixture
def stops(mission):
    return mission.stops.copy()


def test_the_worst_values_are_those_of_the_bytes(stops, limits):
    found = certify_stops(stops, limits, 100.0)
    told = decode(stops.reshape(-1, 29))
    assert found.count == len(stops)
    assert found.worst["speed"] == pytest.approx(np.linalg.norm(told.velocity, axis=1).max())
    assert found.worst["angular velocity"] == pytest.approx(np.linalg.norm(told.body_rate, axis=1).max())
    force = told.acceleration + np.array([0.0, 0.0, 9.81])
    assert np.tan(found.worst["tilt"]) == pytest.approx((np.hypot(force[:, 0], force[:, 1]) / force[:, 2]).max())


def test_a_hover_needs_a_quarter_of_the_weight_from_each_motor(mission, limits):
    hover = encode_stops(mission.payloads[-1:].repeat(5, axis=0), 100.0)
    assert certify_stops(hover, limits, 100.0).worst["motor thrust, most"] == pytest.approx(
        limits.airframe.hover_thrust, rel=1e-4
    )


def test_stops_within_the_limits_of_the_flight_pass(stops, limits):
    certify_stops(stops, limits, 100.0).require(limits)


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"velocity": 4.0}, "speed"),
        ({"acceleration": 12.0}, "acceleration"),
        ({"body_rate": 11.0}, "angular velocity"),
    ],
)
def test_a_single_setpoint_beyond_a_limit_is_refused(stops, limits, changes, name):
    told = decode(stops[50, 3:4])
    for field, value in changes.items():
        told = replace(told, **{field: np.array([[0.0, 0.0, value]])})
    stops[50, 3:4] = encode(told)
    with pytest.raises(NotCertifiedError, match=name) as caught:
        certify_stops(stops, limits, 100.0).require(limits)
    assert caught.value.hint


def test_more_thrust_than_the_motors_have_is_refused(stops, limits):
    weak = replace(limits, airframe=replace(limits.airframe, motor_thrust_max=limits.airframe.hover_thrust))
    with pytest.raises(NotCertifiedError, match="motor thrust"):
        certify_stops(stops, weak, 100.0).require(weak)


def test_those_within_the_plan_are_counted(stops, limits):
    strict = replace(limits, plan=replace(limits.plan, speed=0.5))
    assert certify_stops(stops, strict, 100.0).as_planned < certify_stops(stops, limits, 100.0).as_planned
