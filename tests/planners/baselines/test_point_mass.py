"""The point mass takes the time that is known by hand, and no vehicle is faster."""

import math

import numpy as np
import pytest

from cfplan.geometry.waypoints import Gate, Within
from cfplan.planners.baselines.point_mass import MOST_WAYPOINTS, point_mass_time


def straight(length, limits):
    """From rest to rest: full acceleration, full speed where there is room for it, full braking."""
    speed, acceleration = limits.speed, limits.acceleration
    if length > speed**2 / acceleration:
        return length / speed + speed / acceleration
    return 2.0 * math.sqrt(length / acceleration)


@pytest.mark.parametrize("length", [0.1, 0.7, 3.0])
def test_along_a_line_it_takes_the_known_time(length, limits):
    time = point_mass_time([[0, 0, 1], [length, 0, 1]], limits.plan)
    assert time == pytest.approx(straight(length, limits.plan), rel=2e-3)


def test_a_waypoint_on_the_line_costs_nothing_and_one_beside_it_some(limits):
    alone = point_mass_time([[0, 0, 1], [3, 0, 1]], limits.plan)
    assert point_mass_time([[0, 0, 1], [1, 0, 1], [3, 0, 1]], limits.plan) == pytest.approx(alone, rel=2e-3)
    beside = [[0, 0, 1], [1, 0.5, 1], [3, 0, 1]]
    exactly = point_mass_time(beside, limits.plan)
    near = point_mass_time(beside, limits.plan, (None, Within(0.3), None))
    through = point_mass_time(beside, limits.plan, (None, Gate(0.0, 1.0, 0.5), None))
    assert alone < near < exactly
    assert through == pytest.approx(alone, rel=2e-3)


def test_for_too_many_waypoints_there_is_none(limits):
    assert point_mass_time(np.random.default_rng(0).uniform(size=(MOST_WAYPOINTS + 1, 3)), limits.plan) is None
