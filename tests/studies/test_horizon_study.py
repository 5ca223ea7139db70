"""The study of the horizon: with all waypoints known nothing is lost, with few of them little."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cfplan.geometry.min_snap import centripetal_times, min_snap
from cfplan.planning.plan import plan
from studies.horizon import fly_knowing, horizon

SAFETY = Path(__file__).parents[2] / "safety.yaml"
CORNERS = np.array([[-1.0, -1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 1.0, 1.0], [-1.0, 1.0, 1.0], [-1.0, -0.5, 1.0]])


def test_with_all_waypoints_known_nothing_is_lost(limits):
    roomy = replace(limits, space=replace(limits.space, low=(-9.0, -9.0, -9.0), high=(9.0, 9.0, 9.0)))
    path = min_snap(CORNERS, times=centripetal_times(CORNERS))
    whole = plan(path, roomy.airframe, roomy, planner="expert").trajectory.duration
    assert fly_knowing(CORNERS, 4, roomy) == (pytest.approx(whole), 0)
    knowing_two, stops = fly_knowing(CORNERS, 2, roomy)
    assert stops == 0
    assert 0.7 * whole < knowing_two < 1.2 * whole  # its curve may be the faster one
    at_each = sum(fly_knowing(CORNERS[place : place + 2], 1, roomy)[0] for place in range(4))
    assert knowing_two < 0.9 * at_each


def test_its_result_survives_json():
    result = horizon(SAFETY, paths=1, waypoints=5, known=(2, 3))
    document = json.loads(json.dumps(result.to_json(), allow_nan=False))
    assert [row[0] for row in document["tables"][0]["rows"]] == [2, 3]
    assert result.table("horizon").rows[0]["paths"] == 1
