"""Rows for many points at a time against the flatness map in plain numpy."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cfplan.geometry.min_snap import min_snap
from cfplan.vehicle import dense
from cfplan.vehicle.airframes import AIRFRAMES
from cfplan.vehicle.flatness import flat_state
from cfplan.vehicle.measures import MEASURES, measures_at_instants, measures_of
from cfplan.vehicle.trigonometry import cosine, sine

WAYPOINTS = [[0, 0, 1], [1.5, 1, 1.4], [1, -1.5, 0.6], [-1, 0.5, 1.2]]


def plain_rows(airframe, derivatives, profile, s, interval):
    """What dense_rows gives, by numpy."""
    at = profile.at(s, interval)
    flat = flat_state(airframe, tuple(map(tuple, derivatives)), at[:4], at[4:], np.cos, np.sin)
    x, y, z = flat.thrust_axis
    squares = [sum(c * c for c in v) for v in (flat.acceleration, flat.body_rate)]
    turning, speed = (sum(c * c for c in v) for v in (flat.angular_acceleration, flat.velocity))
    half_tilt = (x * x + y * y) / (1 + z) ** 2
    return np.stack([*squares, half_tilt, flat.specific_thrust, turning, *flat.motor_thrust, speed])


@pytest.mark.parametrize("airframe", AIRFRAMES.values(), ids=lambda airframe: airframe.name)
@pytest.mark.parametrize("count", [1, 3, 4, 5, 15, 63, 64, 65, 1000])
def test_dense_rows_are_those_of_the_flatness_map(make_profile, airframe, count):
    path, random = min_snap(WAYPOINTS), np.random.default_rng(3)
    profile = make_profile(path.end, random.uniform(0.3, 2.6, 40), random.uniform(-0.5, 0.5, 39).cumsum())
    s = random.uniform(0.0, path.end, count)
    interval = profile.interval(s)
    derivatives = np.stack([path(s, order).T for order in (1, 2, 3, 4)])
    rows = dense.dense_rows(airframe, derivatives, profile, s - profile.s[interval], interval)
    expected = plain_rows(airframe, derivatives, profile, s, interval)
    assert rows.shape == (MEASURES, count)
    scale = 1.0 + np.abs(expected).max(axis=1, keepdims=True)
    np.testing.assert_allclose(rows / scale, expected / scale, rtol=0.0, atol=1e-14)


def test_one_point_that_is_not_a_number_leaves_its_neighbours_alone(make_profile):
    airframe, path = AIRFRAMES["crazyflie-2.1+"], min_snap(WAYPOINTS)
    profile = make_profile(path.end, np.ones(30))
    s = np.linspace(0.1, 0.9, 40) * path.end
    interval = profile.interval(s)
    derivatives = np.stack([path(s, order).T for order in (1, 2, 3, 4)])
    sound = dense.dense_rows(airframe, derivatives, profile, s - profile.s[interval], interval)
    derivatives[0, 1, 20] = np.nan
    rows = dense.dense_rows(airframe, derivatives, profile, s - profile.s[interval], interval)
    others = np.arange(40) != 20
    np.testing.assert_array_equal(rows[:, others], sound[:, others])
    assert np.isnan(rows[:, 20]).all()


@settings(max_examples=300, deadline=None)
@given(st.floats(-1e6, 1e6))
def test_sine_and_cosine_are_those_of_the_library(angle):
    assert sine(angle) == pytest.approx(math.sin(angle), rel=0.0, abs=2.3e-16)
    assert cosine(angle) == pytest.approx(math.cos(angle), rel=0.0, abs=2.3e-16)


def test_what_is_no_number_has_neither():
    assert math.isnan(sine(math.nan))
    assert math.isnan(cosine(math.nan))


def test_what_instants_tell_is_what_full_states_measure():
    random = np.random.default_rng(8)
    velocity, acceleration, body_rate, force = random.normal(size=(4, 50, 3)) + np.array([0.0, 0.0, 5.0])
    thrust = np.linalg.norm(force, axis=1)
    expected = measures_of(velocity, acceleration, body_rate, force / thrust[:, None], thrust)
    np.testing.assert_allclose(measures_at_instants(velocity, acceleration, body_rate, force), expected, rtol=1e-12)
