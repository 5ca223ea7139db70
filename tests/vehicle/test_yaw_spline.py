"""Yaw splines: C¹ parabolas that meet what is wanted and boundary states, by coefficients and back."""

import numpy as np
import pytest

from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.yaw import YawMode
from cfplan.vehicle.profile import BoundaryState, yaw_within
from cfplan.vehicle.yaw_spline import AT_NODE, YawSpline, end_coefficients

PATH = min_snap([[0, 0, 1], [1.5, 1, 1.4], [1, -1.5, 0.6], [-1, 0.5, 1.2]])
UPWARD = min_snap([[0, 0, 0.5], [0, 0, 1.5], [0, 0, 1.9]])
NODES = 60
STEP = PATH.end / NODES
START = BoundaryState(1.0, 0.0, 0.0, 0.9, -0.2)


def assert_smooth(spline, step):
    yaw, dyaw, _ = yaw_within(step, spline.yaw[:-1], spline.dyaw[:-1], spline.ddyaw)
    np.testing.assert_allclose(yaw, spline.yaw[1:], atol=1e-10)
    np.testing.assert_allclose(dyaw, spline.dyaw[1:], atol=1e-9)


def test_a_fixed_yaw_is_one_angle():
    spline = YawSpline.fixed(PATH, NODES, 0.7)
    assert (spline.yaw == 0.7).all()
    assert not spline.dyaw.any()
    assert not spline.ddyaw.any()


@pytest.mark.parametrize("mode", [YawMode.FIXED, YawMode.TANGENT])
def test_a_boundary_state_is_met(mode):
    spline = YawSpline.along(PATH, NODES, mode, 0.1, START)
    assert_smooth(spline, STEP)
    assert (spline.yaw[0], spline.dyaw[0]) == pytest.approx((START.yaw, START.dyaw))


def test_a_tangent_yaw_follows_the_direction_of_flight_and_rests_where_the_path_does():
    spline = YawSpline.tangent(PATH, NODES, 0.0)
    assert_smooth(spline, STEP)
    inner = np.linspace(0, PATH.end, NODES + 1)[5:-5]
    tangent = PATH(inner, 1)
    off = spline.yaw[5:-5] - np.arctan2(tangent[:, 1], tangent[:, 0])
    assert np.abs((off + np.pi) % (2 * np.pi) - np.pi).max() < 0.3
    assert spline.dyaw[[0, -1]] == pytest.approx([0.0, 0.0], abs=1e-9)


def test_a_tangent_yaw_of_flight_straight_up_is_the_angle_given():
    assert YawSpline.tangent(UPWARD, NODES, 0.4).yaw == pytest.approx(np.full(NODES + 1, 0.4))


def test_coefficients_lead_to_the_spline_and_back():
    coefficients = np.random.default_rng(0).normal(size=NODES + 2).cumsum()
    spline = YawSpline.from_coefficients(coefficients, STEP)
    assert_smooth(spline, STEP)
    np.testing.assert_allclose(spline.coefficients(STEP), coefficients, atol=1e-12)
    values = AT_NODE @ coefficients[3:6]
    assert (spline.yaw[3], spline.dyaw[3] * STEP, spline.ddyaw[3] * STEP**2) == pytest.approx(tuple(values))
    assert end_coefficients(spline.yaw[3], spline.dyaw[3] * STEP) == pytest.approx(tuple(coefficients[3:5]))


def test_a_part_is_the_spline_there():
    spline = YawSpline.tangent(PATH, NODES, 0.0)
    part = spline.part(10, 25)
    np.testing.assert_array_equal(part.yaw, spline.yaw[10:26])
    np.testing.assert_array_equal(part.ddyaw, spline.ddyaw[10:25])
