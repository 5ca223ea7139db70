"""The study of the horizon: with all waypoints known nothing is lost, with few of them little."""

from dataclasses import replace

import numpy as np
import pytest

from cfplan.geometry.path_file import path_through
from cfplan.planning.path.choice import fastest_path
from studies.horizon import STUDY, Settings, fly_knowing
from studies.runner.cases import run_study

CORNERS = np.array([[-1.0, -1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 1.0, 1.0], [-1.0, 1.0, 1.0], [-1.0, -0.5, 1.0]])


def test_with_all_waypoints_known_nothing_is_lost(limits):
    roomy = replace(limits, space=replace(limits.space, low=(-9.0, -9.0, -9.0), high=(9.0, 9.0, 9.0)))
    reference = fastest_path(path_through(CORNERS), roomy).duration
    assert fly_knowing(CORNERS, 4, roomy) == (pytest.approx(reference, rel=0.03), 0)
    knowing_two, stops = fly_knowing(CORNERS, 2, roomy)
    assert stops == 0
    assert 0.7 * reference < knowing_two < 1.2 * reference  # its curve may be the faster one
    at_each = sum(fly_knowing(CORNERS[place : place + 2], 1, roomy)[0] for place in range(4))
    assert knowing_two < 0.9 * at_each


def test_each_number_of_known_waypoints_is_a_line():
    settings = Settings(paths=1, waypoints=5, known=(2, 3))
    rows = run_study("horizon", "studies.horizon", STUDY, settings).table("horizon").rows
    assert [(row["known"], row["paths"]) for row in rows] == [(2, 1), (3, 1)]
