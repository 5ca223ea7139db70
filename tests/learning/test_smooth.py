"""From answers to a profile: the least squares that are promised, and the ends as the expert has them."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from cfplan.learning.smooth import Begin, smoothed
from cfplan.vehicle.profile import BoundaryState
from cfplan.vehicle.profile_spline import spline_profile
from cfplan.vehicle.yaw_spline import YawSpline

SETTLED = np.array([2.0, 2.05, 2.12])


def rough(count: int = 21) -> np.ndarray:
    return 2.0 + np.random.default_rng(0).normal(scale=0.2, size=count)


@pytest.mark.parametrize("begin", Begin)
@pytest.mark.parametrize("rest_end", [False, True])
def test_it_is_the_least_sum_of_squares(begin, rest_end):
    """Any small change within what is free to change makes the sum larger."""
    rates, duration = rough(), 0.15
    found = smoothed(rates, SETTLED, int(begin), rest_end, duration)
    stiffness = (duration * np.exp(rates[np.minimum(np.arange(20), 20)])) ** 6

    def cost(z):
        return np.sum((z[1:-1] - rates) ** 2) + np.sum(stiffness * np.diff(z, 3) ** 2)

    for seed in range(40):
        change = np.random.default_rng(seed).normal(size=23)
        if begin is Begin.REST:
            change[:4] = change[0]
        if begin is Begin.KNOWN:
            change[:3] = 0.0
        if rest_end:
            change[-4:] = change[-1]
        slope = (cost(found + 1e-4 * change) - cost(found - 1e-4 * change)) / 2e-4
        assert abs(slope) < 1e-6 * cost(found + change)
        assert cost(found + 1e-3 * change) > cost(found)


def test_what_is_settled_stays():
    np.testing.assert_array_equal(smoothed(rough(), SETTLED, int(Begin.KNOWN), False, 0.07)[:3], SETTLED)


def test_h_is_constant_next_to_a_rest():
    u = np.exp(2 * smoothed(rough(), SETTLED, int(Begin.REST), True, 0.07))
    zeros = np.zeros(21)
    profile = spline_profile(u, 3.0, YawSpline(zeros, zeros, zeros[1:]))
    for values, at in ((profile.dh, [0, 1]), (profile.ddh, [0, 1]), (profile.dddh, [0])):
        assert np.all(values[at] == 0.0)
        assert np.all(values[[-1 - k for k in at]] == 0.0)


def test_smoothing_takes_the_same_time_whatever_the_grid():
    """A ripple of two seconds in flight is damped alike on a grid twice as fine."""
    left = []
    for rate in (10.0, 20.0):
        n = np.arange(400)
        ripple = np.sin(2 * np.pi * n / (2.0 * rate))
        out = smoothed(np.log(rate) + 1e-3 * ripple, SETTLED, int(Begin.FREE), False, 0.3)[1:-1] - np.log(rate)
        left.append(np.ptp(out[100:300]) / 2e-3)
    assert left[0] == pytest.approx(left[1], rel=0.05)
    assert 0.1 < left[0] < 0.9


def test_a_profile_is_the_spline_of_its_coefficients(make_profile):
    u = np.random.default_rng(1).uniform(0.5, 2.0, 23)
    zeros = np.zeros(21)
    found, expected = spline_profile(u, 3.0, YawSpline(zeros, zeros, zeros[1:])), make_profile(3.0, u)
    for name in ("s", "h", "dh", "ddh", "dddh"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-9, atol=1e-8)


@pytest.mark.parametrize("nodes", [10, 64, 100])
def test_yaw_is_smoothed_as_scipy_does_and_keeps_the_state_it_is_given(nodes):
    yaw = np.random.default_rng(nodes).normal(size=nodes + 1).cumsum()
    track = YawSpline.smoothed(yaw, 0.2, None)
    smooth = gaussian_filter1d(yaw, 3.0, mode="nearest")
    middles = (smooth[1:] + smooth[:-1]) / 2
    np.testing.assert_allclose(track.yaw[1:-1], (middles[1:] + middles[:-1]) / 2, atol=1e-12)
    np.testing.assert_allclose(track.dyaw[1:-1], np.diff(middles) / 0.2, atol=1e-12)
    held = YawSpline.smoothed(yaw, 0.2, BoundaryState(1.0, 0.0, 0.0, 0.3, 0.2))
    assert (held.yaw[0], held.dyaw[0]) == pytest.approx((0.3, 0.2))
    # a parabola in each interval, continuous with its slope
    np.testing.assert_allclose(held.yaw[:-1] + 0.2 * held.dyaw[:-1] + 0.02 * held.ddyaw, held.yaw[1:], atol=1e-12)
    np.testing.assert_allclose(held.dyaw[:-1] + 0.2 * held.ddyaw, held.dyaw[1:], atol=1e-12)
