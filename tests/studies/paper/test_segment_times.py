"""Segment times like MFBOTrajectory's: their checks, and the motions through waypoints."""

import numpy as np
import pytest

from cfplan.geometry.min_snap import min_snap
from cfplan.safety.limit_sets import PAPER
from studies.paper.baselines import random_course
from studies.paper.segment_times import (
    QUICK_BUDGET,
    bayesian_motion,
    is_followed,
    keeps_limits,
    timed_trajectory,
)

COURSE = random_course(60_000)
LENGTHS = np.linalg.norm(np.diff(COURSE.waypoints, axis=0), axis=1)


def at(speed):
    """Return the min-snap motion whose segments take as long as straight lines at this speed, m/s."""
    return timed_trajectory(min_snap(COURSE.waypoints, times=LENGTHS / speed))


def test_a_timed_motion_takes_its_times_and_passes_its_waypoints():
    planned = at(2.0)
    assert planned.duration == pytest.approx(LENGTHS.sum() / 2.0)
    arrivals = np.concatenate([[0.0], np.cumsum(LENGTHS / 2.0)])
    np.testing.assert_allclose(planned.at(arrivals).position, COURSE.waypoints, atol=1e-6)


def test_both_checks_pass_a_slow_motion_and_refuse_one_above_the_speed_limit():
    assert keeps_limits(at(2.0))
    assert is_followed(at(2.0))
    fast = at(2.6)
    assert np.linalg.norm(fast.at(np.arange(0, fast.duration, 0.01)).velocity, axis=1).max() > PAPER.limits.speed
    assert not keeps_limits(fast)
    assert not is_followed(fast)


def test_motors_count_beside_speed():
    zigzag = np.array([[0, 0, 0], [0.6, 0, 0], [0, 0, 0.1], [0.6, 0, 0]], dtype=float)
    planned = timed_trajectory(min_snap(zigzag, times=np.full(3, 0.35)))
    state = planned.at(np.arange(0, planned.duration, 0.01))
    assert np.linalg.norm(state.velocity, axis=1).max() < PAPER.limits.speed
    assert state.motor_thrust.max() > PAPER.airframe.motor_thrust_max
    assert not keeps_limits(planned)


def test_the_optimised_motion_keeps_the_dear_check_and_is_no_slower_than_any_uniform_one():
    found = bayesian_motion(COURSE.waypoints, budget=QUICK_BUDGET, seed=0)
    assert is_followed(found)
    uniform = next(speed for speed in np.arange(3.0, 0.5, -0.01) if is_followed(at(speed)))
    assert found.duration <= LENGTHS.sum() / uniform * 1.001
