"""shape: fastest: the flight through waypoints is never longer than along min-snap, stays inside, and ends in time."""

import math
from dataclasses import replace
from itertools import count

import numpy as np
import pytest
import yaml

from cfplan.deadline import Deadline
from cfplan.errors import InfeasibleError, InputError
from cfplan.geometry.min_snap import centripetal_times, min_snap
from cfplan.geometry.path_file import load_path_file
from cfplan.geometry.yaw import YawMode
from cfplan.planners.task import PlanningTask
from cfplan.planning.fastest_path import chosen_path, fastest_path
from cfplan.planning.plan import plan
from cfplan.planning.policy import a_model_knows
from cfplan.safety.space import check_space
from tests.geometry.test_path_file import CORNERS, SQUARE

LAWN_MOWER = [
    [-1.5, -1, 1],
    [1.5, -1, 1],
    [1.5, -0.7, 1],
    [-1.5, -0.7, 1],
    [-1.5, -0.4, 1],
    [1.5, -0.4, 1],
    [1.5, -0.1, 1],
]
RECTANGLE = [[-1.5, 0, 1], [1.5, 0, 1], [1.5, 0.3, 1], [-1.5, 0.3, 1], [-1.5, 0, 1]]
RANDOM = {
    f"random {n}": np.random.default_rng(n).uniform([-2, -3.5, 0.3], [2, 3.5, 1.7], (6, 3)) for n in range(500, 504)
}
SETS = {"lawn mower": (LAWN_MOWER, 7.0), "rectangle": (RECTANGLE, 5.0)} | {
    name: (points, math.inf) for name, points in RANDOM.items()
}  # waypoints, and the time that centripetal times take, s, rounded up
ROOMY = {"low": (-20.0, -20.0, -3.0), "high": (20.0, 20.0, 5.0)}


def flight(path, limits, **options) -> float:
    made = plan(path, limits.airframe, limits, **options)
    assert made.certificate.passed
    return made.trajectory.duration


def both_timings(points):
    return min_snap(points), min_snap(points, times=centripetal_times(points))


@pytest.mark.parametrize("name", SETS)
def test_the_flight_is_shorter_than_along_min_snap_and_within_the_room(name, limits):
    points, below = SETS[name]
    chosen = fastest_path(points, limits.airframe, limits)
    assert chosen.finished
    check_space(chosen.path, limits.space, waypoints=points)
    np.testing.assert_allclose(chosen.path(chosen.path.breaks), points, atol=1e-9)
    assert np.abs(chosen.path([0.0, chosen.path.end], 1)).max() == 0.0
    assert flight(chosen.path, limits) == chosen.duration < below
    roomy = replace(limits, space=replace(limits.space, **ROOMY))
    assert chosen.duration < 0.98 * min(flight(path, roomy) for path in both_timings(points))


def test_one_segment_leaves_nothing_to_choose(limits):
    chosen = fastest_path(CORNERS[:2], limits.airframe, limits)
    assert chosen.duration == chosen.min_snap == flight(min_snap(CORNERS[:2]), limits)


def test_the_same_waypoints_have_the_same_path(limits):
    first, second = (fastest_path(RECTANGLE, limits.airframe, limits).path for _ in range(2))
    np.testing.assert_array_equal(first.coefficients, second.coefficients)


@pytest.mark.parametrize("questions", [0, 1, 3, 10, 30])
def test_whenever_the_deadline_comes_a_certified_path_is_the_answer(questions, limits):
    ticks = count()
    deadline = Deadline(questions, lambda: float(next(ticks)))
    chosen = fastest_path(LAWN_MOWER, limits.airframe, limits, deadline=deadline)
    assert not chosen.finished
    assert "cut short by the budget" in chosen.describe(1.0)
    assert flight(chosen.path, limits) <= 1.001 * min(chosen.duration, chosen.min_snap)


def test_walls_steer_the_choice(limits):
    """Where walls and margin leave 0.15 m around the waypoints' box, min-snap leaves the room with either timing."""
    points = np.array(LAWN_MOWER)
    reach = 0.15 + limits.space.margin
    low, high = (points.min(axis=0) - reach).tolist(), (points.max(axis=0) + reach).tolist()
    space = replace(limits.space, low=tuple(low), high=tuple(high))
    narrow = replace(limits, space=space)
    for path in both_timings(points):
        with pytest.raises(InfeasibleError):
            check_space(path, space)
    chosen = fastest_path(points, narrow.airframe, narrow)
    check_space(chosen.path, space)
    assert chosen.min_snap == math.inf
    assert flight(chosen.path, narrow) == chosen.duration < 7.0


def test_the_expert_is_asked_where_no_model_knows_the_limits(limits):
    gentle = replace(limits, plan=replace(limits.plan, speed=0.4, acceleration=0.4))
    task = PlanningTask(min_snap(RECTANGLE), gentle.airframe, gentle.plan)
    assert not a_model_knows(task, ()).due
    chosen = fastest_path(RECTANGLE, gentle.airframe, gentle)
    assert flight(chosen.path, gentle) == chosen.duration < 0.98 * chosen.min_snap


@pytest.mark.parametrize("yaw", YawMode)
def test_yaw_is_the_path_files_own(yaw, limits):
    chosen = fastest_path(SQUARE, limits.airframe, limits, yaw=yaw, yaw_angle=0.5)
    assert flight(chosen.path, limits, yaw=yaw, yaw_angle=0.5) == chosen.duration <= chosen.min_snap


@pytest.fixture
def load(tmp_path):
    def run(**content):
        file = tmp_path / "path.yaml"
        file.write_text(yaml.safe_dump(content))
        return load_path_file(file)

    return run


def test_laps_have_the_same_times_and_a_place_is_kept(load, limits):
    given = load(waypoints=RECTANGLE, laps=3, shape="fastest", place={"x": 0.2, "y": 0.5, "yaw_deg": 90})
    file, fastest = chosen_path(given, limits)
    spans = np.diff(file.path.breaks).reshape(3, 4)
    np.testing.assert_allclose(spans[1:], spans[:-1], rtol=1e-9)
    np.testing.assert_allclose(file.path(file.path.breaks), given.waypoints, atol=1e-9)
    assert fastest.duration == flight(file.path, limits, yaw_angle=file.yaw_angle) < 0.98 * fastest.min_snap


def test_min_snap_is_kept(load, limits):
    given = load(waypoints=SQUARE)
    assert chosen_path(given, limits) == (given, None)


def test_a_waypoint_outside_is_refused_before_any_search(load, limits):
    given = load(waypoints=[*CORNERS, [9, 9, 1]], shape="fastest")
    assert chosen_path(given, limits) == (given, None)


def test_waypoints_that_are_none_are_refused(limits):
    for points in ([[0, 0, 1]], [[0, 0, 1], [0, 0, 1]], [[0, 0, 1], [1, math.nan, 1]], [[0, 0], [1, 1]]):
        with pytest.raises(InputError):
            fastest_path(points, limits.airframe, limits)
