"""Measures and full states of many points at a time against the flatness map in plain numpy."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cfplan.geometry.min_snap import min_snap
from cfplan.vehicle.airframes import AIRFRAMES
from cfplan.vehicle.flatness import flat_state
from cfplan.vehicle.measures import measures_at_instants, measures_of
from cfplan.vehicle.motion import STATES, measures_at, states_at
from cfplan.vehicle.trigonometry import cosine, sine

WAYPOINTS = [[0, 0, 1], [1.5, 1, 1.4], [1, -1.5, 0.6], [-1, 0.5, 1.2]]


def plain(airframe, curve, profile, s, interval):
    """The full state by numpy."""
    at = profile.at(s, interval)
    return flat_state(airframe, tuple(map(tuple, curve[1:])), at[:4], at[4:], np.cos, np.sin)


def assert_same(rows, expected):
    assert rows.shape == expected.shape
    scale = 1.0 + np.abs(expected).max(axis=1, keepdims=True)
    np.testing.assert_allclose(rows / scale, expected / scale, rtol=0.0, atol=1e-14)


@pytest.mark.parametrize("airframe", AIRFRAMES.values(), ids=lambda airframe: airframe.name)
@pytest.mark.parametrize("count", [1, 3, 4, 5, 15, 63, 64, 65, 1000])
def test_measures_and_full_states_are_those_of_the_flatness_map(make_profile, airframe, count):
    path, random = min_snap(WAYPOINTS), np.random.default_rng(3)
    profile = make_profile(path.end, random.uniform(0.3, 2.6, 40), random.uniform(-0.5, 0.5, 39).cumsum())
    s = random.uniform(0.0, path.end, count)
    interval, curve = profile.interval(s), path.derivatives(s)
    flat = plain(airframe, curve, profile, s, interval)
    x, y, z = flat.thrust_axis
    squares = [sum(c * c for c in v) for v in (flat.acceleration, flat.body_rate)]
    turning, speed = (sum(c * c for c in v) for v in (flat.angular_acceleration, flat.velocity))
    measured = [*squares, (x * x + y * y) / (1 + z) ** 2, flat.specific_thrust, turning, *flat.motor_thrust, speed]
    assert_same(measures_at(airframe, curve, profile.table(), s, interval), np.stack(measured))
    states = states_at(airframe, curve, profile.table(), s, interval)
    for name in set(STATES) - {"quaternion", "yaw"}:
        assert_same(np.atleast_2d(states[STATES[name]]), np.atleast_2d(getattr(flat, name)))
    assert_same(states[None, STATES["yaw"]], profile.at(s, interval).yaw[None])
    frames = Rotation.from_quat(states[STATES["quaternion"]].T).as_matrix()
    np.testing.assert_allclose(frames[:, :, 2].T, flat.thrust_axis, rtol=0.0, atol=1e-14)


def test_one_point_that_is_not_a_number_leaves_its_neighbours_alone(make_profile):
    airframe, path = AIRFRAMES["crazyflie-2.1+"], min_snap(WAYPOINTS)
    profile = make_profile(path.end, np.ones(30))
    s = np.linspace(0.1, 0.9, 40) * path.end
    interval, curve = profile.interval(s), path.derivatives(s)
    sound = measures_at(airframe, curve, profile.table(), s, interval)
    curve[1, 1, 20] = np.nan
    rows = measures_at(airframe, curve, profile.table(), s, interval)
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
