"""The study of the horizon: with all waypoints known nothing is lost, with few of them little."""

from dataclasses import replace

import numpy as np
import pytest

from cfplan.geometry.min_snap import centripetal_times, min_snap
from cfplan.planning.plan import plan
from studies.horizon import STUDY, Settings, fly_knowing
from studies.runner.cases import run_study

CORNERS = np.array([[-1.0, -1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 1.0, 1.0], [-1.0, 1.0, 1.0], [-1.0, -0.5, 1.0]])


def test_with_all_waypoints_known_nothing_is_lost(limits):
    roomy = replace(limits, space=replace(limits.space, low=(-9.0, -9.0, -9.0), high=(9.0, 9.0, 9.0)))
    path = min_snap(CORNERS, times=centripetal_times(CORNERS))
    reference = plan(path, roomy.airframe, roomy, planner="expert").trajectory.duration
    assert fly_knowing(CORNERS, 4, roomy) == (pytest.approx(reference), 0)
    knowing_two, stops = fly_knowing(CORNERS, 2, roomy)
    assert stops == 0
    assert 0.7 * reference < knowing_two < 1.2 * reference  # its curve may be the faster one
    at_each = sum(fly_knowing(CORNERS[place : place + 2], 1, roomy)[0] for place in range(4))
    assert knowing_two < 0.9 * at_each


def test_each_number_of_known_waypoints_is_a_line():
    settings = Settings(paths=1, waypoints=5, known=(2, 3))
    rows = run_study("horizon", "studies.horizon", STUDY, settings).table("horizon").rows
    assert [(row["known"], row["paths"]) for row in rows] == [(2, 1), (3, 1)]
