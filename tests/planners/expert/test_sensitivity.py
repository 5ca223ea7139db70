"""The flight time changes with the path as the multipliers say."""

from dataclasses import replace

import numpy as np
import pytest

from cfplan.geometry.min_snap import centripetal_times, least_snap
from cfplan.planners.expert.sensitivity import sensitivity
from cfplan.planners.task import PlanningTask

POINTS = np.random.default_rng(500).uniform([-2, -3.5, 0.3], [2, 3.5, 1.7], (6, 3))
NODES = 100
_STOPPED_EARLY = 4e-3  # s, by which the flight times of searches that stop early scatter


def of_path(path, limits):
    return sensitivity(PlanningTask(path, limits.airframe, limits.plan, nodes=NODES))


def test_moving_a_time_or_a_point_changes_the_flight_time_as_it_says(limits):
    times = centripetal_times(POINTS)
    here = of_path(least_snap(POINTS, times), limits)
    random = np.random.default_rng(0)
    for _ in range(4):
        longer, moved = np.exp(1e-2 * random.normal(size=5)), 1e-2 * random.normal(size=POINTS.shape)
        longer *= times.sum() / (longer * times).sum()
        ahead = least_snap(POINTS + moved, times * longer)
        behind = least_snap(POINTS - moved, 2.0 * times - times * longer)
        change = of_path(ahead, limits).duration - of_path(behind, limits).duration
        moves = np.array([(ahead(here.s, order) - behind(here.s, order)).T for order in range(1, 5)])
        assert float((here.by_path * moves).sum()) == pytest.approx(change, rel=0.1, abs=_STOPPED_EARLY)


def test_from_coefficients_nearby_the_answer_is_the_same(limits):
    times = centripetal_times(POINTS)
    here = of_path(least_snap(POINTS, times), limits)
    times[2] *= 1.02
    task = PlanningTask(least_snap(POINTS, times), limits.airframe, limits.plan, nodes=NODES)
    assert sensitivity(task, here.coefficients).duration == pytest.approx(sensitivity(task).duration, rel=2e-3)


def test_where_no_motion_is_allowed_there_is_no_answer(limits):
    path = least_snap(POINTS[:2], np.ones(1))
    weak = replace(limits, plan=replace(limits.plan, motor_thrust_max=0.9 * limits.airframe.hover_thrust))
    assert of_path(path, limits) is not None
    assert of_path(path, weak) is None
