"""Lowering: what exceeds a limit is slower there, within a blink around, and nowhere else."""

from dataclasses import replace

import numpy as np
import pytest

from cfplan.geometry.min_snap import min_snap
from cfplan.planners.task import PlanningTask
from cfplan.planning.lowering import lower_locally
from cfplan.safety.certificate import certify
from cfplan.safety.limit_sets import LIMIT_SETS
from cfplan.vehicle.trajectory import Trajectory
from studies.drawn_paths import random_path

HARDWARE = LIMIT_SETS["hardware"]
LINE = min_snap([[0, 0, 1], [6, 0, 1]])


def task_of(path, limits=HARDWARE.limits, **rest):
    return PlanningTask(path, HARDWARE.airframe, limits, **rest)


@pytest.mark.parametrize("limit_set", LIMIT_SETS)
@pytest.mark.parametrize("seed", range(4))
def test_a_profile_that_is_far_too_fast_ends_certified(seed, limit_set, make_profile):
    chosen, path = LIMIT_SETS[limit_set], random_path(seed, "4.5x8x2")
    fast = make_profile(path.end, np.full(103, 2.0 * chosen.limits.speed**2))
    low = lower_locally(PlanningTask(path, chosen.airframe, chosen.limits), fast)
    assert certify(Trajectory(path, low, chosen.airframe), chosen.limits).worst.share < 1.005
    assert (low.yaw == fast.yaw).all()


def test_what_keeps_its_limits_stays_to_the_last_bit(make_profile):
    slow = make_profile(LINE.end, np.full(63, 0.05))
    assert lower_locally(task_of(LINE), slow) is slow


def test_only_what_is_near_in_time_is_lowered(make_profile):
    profile = make_profile(LINE.end, np.full(123, 0.2))
    speed = np.sqrt(profile.h) * np.linalg.norm(LINE(profile.s, 1), axis=1)
    cap = 0.97 * speed.max()  # at half-way
    low = lower_locally(task_of(LINE, replace(HARDWARE.limits, speed=cap)), profile)
    after = np.sqrt(low.h) * np.linalg.norm(LINE(low.s, 1), axis=1)
    assert 0.98 * cap < after.max() <= cap
    far = speed < 0.8 * cap
    np.testing.assert_allclose(low.h[far], profile.h[far], rtol=1e-9)


def test_boundary_states_are_kept(make_profile):
    part = LINE.part(LINE.end * 0.4, LINE.end * 0.6)
    fast = make_profile(part.end, np.linspace(0.9, 1.5, 63) * HARDWARE.limits.speed**2)
    start = fast.boundary(0)
    low = lower_locally(task_of(part, start=start), fast)
    found = low.boundary(0)
    assert (found.h, found.dh, found.ddh) == pytest.approx((start.h, start.dh, start.ddh), rel=1e-9, abs=1e-9)
    assert low.h[-1] < fast.h[-1]
