"""Stops held against the limits, by the motion that their bytes make."""

from dataclasses import replace

import numpy as np
import pytest

from cfplan.errors import NotCertifiedError
from cfplan.flight.setpoints.packets import FullStateSetpoints, decode, encode
from cfplan.flight.setpoints.stop_certificate import certify_stops
from cfplan.flight.setpoints.stops import encode_stops, stop_motion


@pytest.fixture
def motion(mission) -> FullStateSetpoints:
    return decode(mission.payloads)


@pytest.fixture
def stops(mission):
    return mission.stops.copy()


def test_the_worst_values_are_those_of_the_motion(stops, motion, limits):
    found = certify_stops(stops, motion, limits, 100.0)
    told, _ = stop_motion(motion, np.arange(len(stops)), 100.0)
    assert found.count == len(stops)
    assert found.worst["speed"] == pytest.approx(np.linalg.norm(told.velocity, axis=1).max(), abs=1e-3)
    assert found.worst["angular velocity"] == pytest.approx(np.linalg.norm(told.body_rate, axis=1).max(), abs=3e-3)
    force = told.acceleration + np.array([0.0, 0.0, 9.81])
    tilt = np.arctan(np.hypot(force[:, 0], force[:, 1]) / force[:, 2])
    assert found.worst["tilt"] == pytest.approx(tilt.max(), abs=2e-4)


def test_a_hover_needs_a_quarter_of_the_weight_from_each_motor(motion, limits):
    hover = FullStateSetpoints(*(getattr(motion, name)[-1:].repeat(5, axis=0) for name in motion.__slots__))
    certified = certify_stops(encode_stops(hover, 100.0), hover, limits, 100.0)
    assert certified.worst["motor thrust, most"] == pytest.approx(limits.airframe.hover_thrust, rel=1e-4)


def test_stops_within_the_limits_of_the_flight_pass(stops, motion, limits):
    certify_stops(stops, motion, limits, 100.0).require(limits)


@pytest.mark.parametrize("rows", [slice(3, 4), slice(150, 190)])
def test_stops_from_some_setpoints_alone_are_certified_as_those_of_all(stops, motion, limits, rows):
    certify_stops(stops[rows], motion, limits, 100.0, rows=np.arange(len(stops))[rows])
    with pytest.raises(NotCertifiedError):
        certify_stops(stops[rows], motion, limits, 100.0, rows=np.arange(len(stops))[rows] + 5)


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"velocity": [0.0, 0.0, 4.0]}, "speed"),
        ({"acceleration": [0.0, 0.0, 13.0]}, "acceleration"),
        ({"quaternion": [0.0, 0.0, np.sin(0.07), np.cos(0.07)]}, "angular velocity"),  # turned by 8° at once
    ],
)
def test_a_few_setpoints_beyond_a_limit_are_refused(motion, limits, changes, name):
    for field, value in changes.items():
        getattr(motion, field)[183:190] = value
    stops = encode_stops(motion, 100.0)
    with pytest.raises(NotCertifiedError, match=name) as caught:
        certify_stops(stops, motion, limits, 100.0).require(limits)
    assert caught.value.hint


@pytest.mark.parametrize("byte", range(29))
def test_a_flipped_bit_in_any_byte_of_a_stop_is_found(stops, motion, limits, byte):
    stops[50, 13, byte] ^= 0x40
    with pytest.raises(NotCertifiedError) as caught:
        certify_stops(stops, motion, limits, 100.0)
    assert caught.value.where == "setpoint 13 of the stop from 50"


@pytest.mark.parametrize("axis", range(3))
def test_a_rate_off_by_a_thousandth_is_found(stops, motion, limits, axis):
    told = decode(stops[50, 3:4])
    told.body_rate[0, axis] += 0.001
    stops[50, 3:4] = encode(told)
    with pytest.raises(NotCertifiedError, match="body_rate"):
        certify_stops(stops, motion, limits, 100.0)


def test_more_thrust_than_the_motors_have_is_refused(stops, motion, limits):
    weak = replace(limits, airframe=replace(limits.airframe, motor_thrust_max=limits.airframe.hover_thrust))
    with pytest.raises(NotCertifiedError, match="motor thrust"):
        certify_stops(stops, motion, weak, 100.0).require(weak)


def test_those_within_the_plan_are_counted(stops, motion, limits):
    strict = replace(limits, plan=replace(limits.plan, speed=0.5))
    few, many = (certify_stops(stops, motion, wanted, 100.0).as_planned for wanted in (strict, limits))
    assert few < many
