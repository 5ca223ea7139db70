"""A profile through samples is smooth where a SpeedProfile must be, and goes through what it is given."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cfplan.vehicle.profile import h_within
from cfplan.vehicle.profile_spline import (
    AT_NODE,
    h_coefficients,
    node_coefficients,
    node_values,
    profile_through,
    spline_profile,
    weights_at,
)
from cfplan.vehicle.yaw_spline import YawSpline

pytestmark = pytest.mark.unit


def speed(s):
    return 1.5 + np.sin(s) + 0.2 * np.cos(3 * s)


@given(end=st.floats(0.3, 200.0), intervals=st.integers(4, 60))
def test_any_grid_is_taken(end, intervals):
    grid = np.linspace(0.0, end, intervals + 1)
    profile = profile_through(grid, grid, np.full_like(grid, 2.0), np.zeros_like(grid), h_stiffness=1.0)
    np.testing.assert_allclose(profile.at(np.linspace(0.0, end, 97)).h, 2.0, rtol=1e-6)


def test_h_yaw_and_their_derivatives_follow_dense_samples():
    grid, s = np.linspace(0.0, 6.0, 121), np.linspace(0.0, 6.0, 2001)
    profile = profile_through(grid, s, speed(s), np.cos(s))
    place = np.linspace(0.3, 5.7, 333)
    found = profile.at(place)
    np.testing.assert_allclose(found.h, speed(place), rtol=1e-5)
    np.testing.assert_allclose(found.dh, np.cos(place) - 0.6 * np.sin(3 * place), atol=1e-3)
    np.testing.assert_allclose(found.yaw, np.cos(place), atol=1e-5)
    np.testing.assert_allclose(found.dyaw, -np.sin(place), atol=1e-3)


def test_both_sides_of_a_grid_point_agree_up_to_the_derivative_that_may_jump():
    grid = np.linspace(0.0, 6.0, 31)
    profile = profile_through(grid, grid, speed(grid), np.cos(grid))
    inner = grid[1:-1]
    left = profile.at(inner, np.arange(len(inner)))
    right = profile.at(inner, np.arange(1, len(inner) + 1))
    for name in ("h", "dh", "ddh", "yaw", "dyaw"):
        np.testing.assert_allclose(getattr(left, name), getattr(right, name), atol=1e-9, err_msg=name)


def test_stiffness_trades_nearness_for_smoothness():
    grid = np.linspace(0.0, 6.0, 61)
    kinked = 1.0 + np.abs(grid - 3.0)
    stiff, loose = (profile_through(grid, grid, kinked, grid, h_stiffness=value) for value in (10.0, 1e-4))
    assert np.abs(np.diff(stiff.dddh)).max() < 0.5 * np.abs(np.diff(loose.dddh)).max()
    assert np.abs(loose.h - kinked).max() < np.abs(stiff.h - kinked).max()


def test_coefficients_lead_to_a_profile_and_back(make_profile):
    coefficients = np.random.default_rng(2).uniform(0.5, 2.0, 43)
    profile = spline_profile(coefficients, 6.0, YawSpline(np.zeros(41), np.zeros(41), np.zeros(40)))
    np.testing.assert_allclose(h_coefficients(profile), coefficients, rtol=1e-12)
    expected = make_profile(6.0, coefficients)
    for name in ("s", "h", "dh", "ddh", "dddh"):
        np.testing.assert_allclose(getattr(profile, name), getattr(expected, name), rtol=1e-9, atol=1e-8)


def test_values_at_a_node_and_its_coefficients_are_of_each_other():
    coefficients = np.random.default_rng(3).uniform(0.5, 2.0, 4)
    h, slope, bend = node_values(*coefficients[:3])
    assert node_coefficients(h, slope, bend) == pytest.approx(tuple(coefficients[:3]))
    third = coefficients @ [-1, 3, -3, 1]
    np.testing.assert_allclose(AT_NODE @ coefficients, [h, slope, bend, third])
    for place in (0.0, 0.3, 1.0):
        assert np.array(weights_at(place)) @ coefficients == pytest.approx(h_within(place, h, slope, bend, third)[0])
