"""Time along the path against scipy, and profiles that no flight can have."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad, solve_ivp

from cfplan.errors import NotCertifiedError
from cfplan.vehicle.timing import LONGEST, duration_of, measure

coefficients = st.lists(st.floats(0.01, 9.0), min_size=5, max_size=40)


@settings(max_examples=40, deadline=None)
@given(coefficients, st.floats(0.3, 20.0))
def test_the_duration_is_the_integral_of_one_over_speed(make_profile, values, end):
    profile = make_profile(end, values)
    by_interval = [
        quad(
            lambda s, k=k: profile.at(np.array(s), np.array(k)).h ** -0.5,
            *profile.s[k : k + 2],
            epsabs=1e-13,
            epsrel=1e-12,
        )[0]
        for k in range(len(profile.s) - 1)
    ]
    times = measure(profile).time_at(profile.s)
    np.testing.assert_allclose(np.diff(times), by_interval, rtol=1e-9, atol=1e-9 / len(by_interval))


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(0.45, 4.5), min_size=5, max_size=40), st.floats(0.3, 20.0))
def test_the_duration_alone_is_that_of_the_timing(make_profile, values, end):
    profile = make_profile(end, values)
    assert duration_of(profile) == pytest.approx(measure(profile).time[-1], rel=1e-6)


@settings(max_examples=60, deadline=None)
@given(coefficients, st.floats(0.3, 20.0))
def test_place_and_time_are_inverse_to_each_other(make_profile, values, end):
    timing = measure(make_profile(end, values))
    times = np.linspace(0.0, timing.time[-1], 997)
    np.testing.assert_allclose(timing.time_at(timing.s_at(times)), times, atol=1e-9)
    places = np.linspace(0.0, end, 997)
    np.testing.assert_allclose(timing.s_at(timing.time_at(places)), places, atol=1e-9)


def test_the_place_solves_the_differential_equation(make_profile):
    profile = make_profile(6.0, np.random.default_rng(1).uniform(0.2, 4.0, 30))
    timing = measure(profile)
    for until in (0.3 * timing.time[-1], 0.9 * timing.time[-1]):
        # Short steps, because h''' jumps at the grid points.
        solved = solve_ivp(
            lambda _, s: np.sqrt(profile.at(s).h), (0, until), [0.0], "DOP853", rtol=1e-12, atol=1e-12, max_step=0.002
        )
        assert timing.s_at(until) == pytest.approx(solved.y[0, -1], abs=1e-9)


def test_a_speed_that_changes_a_thousandfold_in_one_interval_is_timed_as_well(make_profile):
    profile = make_profile(1.0, [4.0, 4.0, 4.0, 4.0, 1e-6, 1e-6, 1e-6, 1e-6, 4.0, 4.0, 4.0])
    timing = measure(profile)
    times = np.linspace(0.0, timing.time[-1], 5001)
    np.testing.assert_allclose(timing.time_at(timing.s_at(times)), times, atol=1e-9)


def test_time_and_place_are_held_within_the_flight(make_profile):
    timing = measure(make_profile(2.0, np.ones(10)))
    np.testing.assert_allclose(timing.time_at([-1.0, 5.0]), [0.0, 2.0], atol=1e-12)
    np.testing.assert_allclose(timing.s_at([-1.0, 5.0]), [0.0, 2.0], atol=1e-12)


@pytest.mark.parametrize("name", ["s", "h", "dh", "ddh", "dddh", "yaw", "dyaw", "ddyaw"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_is_not_finite_is_refused_by_name(make_profile, name, value):
    profile = make_profile(2.0, np.ones(10))
    values = getattr(profile, name).copy()
    values[3] = value
    with pytest.raises(NotCertifiedError, match=f"{name} is not finite"):
        measure(replace(profile, **{name: values}))


def test_a_dip_below_zero_between_grid_points_is_found(make_profile):
    # h = 1 at both ends of the interval, with a parabola between them that dips to -1.
    profile = make_profile(1.0, np.ones(4))
    dipping = replace(profile, dh=np.array([-8.0, 8.0]), ddh=np.array([16.0, 16.0]))
    with pytest.raises(NotCertifiedError, match="falls to zero or below"):
        measure(dipping)


@pytest.mark.parametrize("names", [("h", "dh", "ddh"), ("dh", "ddh"), ("ddh",), ("yaw", "dyaw"), ("dyaw",)])
def test_a_jump_at_a_grid_point_is_refused_by_name(make_profile, names):
    profile = make_profile(2.0, np.ones(10))
    family = ("h", "dh", "ddh") if "ddh" in names else ("yaw", "dyaw")
    x = profile.s[4:] - profile.s[4]
    changed = {name: getattr(profile, name).copy() for name in family}
    # From grid point 4 on, the integral of a jump of the first name.
    for order, name in enumerate(reversed(family[: family.index(names[0]) + 1])):
        changed[name][4:] += 0.01 * x**order / max(order, 1)
    with pytest.raises(NotCertifiedError, match=f"{names[0]} jumps") as error:
        measure(replace(profile, **changed))
    assert error.value.where.startswith("node 4,")


def test_a_grid_that_does_not_ascend_or_of_wrong_length_is_refused(make_profile):
    profile = make_profile(2.0, np.ones(10))
    with pytest.raises(NotCertifiedError, match="does not ascend"):
        measure(replace(profile, s=profile.s[::-1].copy()))
    with pytest.raises(NotCertifiedError, match="values of dddh"):
        measure(replace(profile, dddh=profile.dddh[:-1]))


def test_a_flight_of_hours_is_a_mistake(make_profile):
    slow = (2.0 / LONGEST) ** 2
    with pytest.raises(NotCertifiedError, match="longer than any flight"):
        measure(make_profile(2.001, np.full(10, slow)))
    assert measure(make_profile(1.999, np.full(10, slow))).time[-1] < LONGEST
