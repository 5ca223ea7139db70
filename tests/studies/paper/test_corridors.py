"""Minimum-jerk motion through boxes: the analytical solution far from walls, and motions within near ones."""

import numpy as np
import pytest

from cfplan.errors import InfeasibleError
from cfplan.geometry.min_snap import min_snap
from studies.paper.corridors import (
    ACCELERATION,
    PADDING,
    SPEED,
    Corridor,
    box_corners,
    corridor_about,
    least_time,
    min_jerk,
    timed_path,
)

WAYPOINTS = [[0, 0, 0], [3, 1, 1], [4, -3, 0.5], [0, -4, -1]]
TIMES = np.array([1.2, 2.0, 1.5])


@pytest.fixture(scope="module")
def corridor():
    return corridor_about(min_snap(WAYPOINTS))


def wide(start, goal):
    everywhere = np.full((3, 3), 100.0)
    return Corridor(np.array(start), np.array(goal), np.array(3 * [np.eye(3)]), -everywhere, everywhere)


@pytest.mark.parametrize("times", [TIMES, np.array([0.2, 3.0, 0.9])])
def test_far_from_walls_it_is_the_quintic_from_rest_to_rest(times):
    start, goal = np.array([1.0, 2.0, -1.0]), np.array([4.0, -2.0, 1.0])
    path = timed_path(min_jerk(wide(start, goal), times), times)
    u = np.linspace(0.0, 1.0, 101)[:, None]
    known = start + (goal - start) * (10 * u**3 - 15 * u**4 + 6 * u**5)
    np.testing.assert_allclose(path(path.end * u[:, 0]), known, atol=1e-6)


def test_the_boxes_hold_the_path_that_they_are_about_with_room_to_spare(corridor):
    path = min_snap(WAYPOINTS)
    for k in range(3):
        along = path(np.linspace(k, k + 1, 60) * path.end / 3) @ corridor.axes[k]
        assert (along >= corridor.low[k] + PADDING - 1e-9).all()
        assert (along <= corridor.high[k] - PADDING + 1e-9).all()
        np.testing.assert_allclose(corridor.axes[k].T @ corridor.axes[k], np.eye(3), atol=1e-9)


def test_the_corners_of_a_box_are_its_sides_apart_and_differ_in_one_bit_along_an_edge(corridor):
    for box, corners in enumerate(box_corners(corridor)):
        sides = corridor.high[box] - corridor.low[box]
        for axis in range(3):
            for corner in range(8):
                edge = corners[corner | 1 << axis] - corners[corner & ~(1 << axis)]
                np.testing.assert_allclose(edge, sides[axis] * corridor.axes[box][:, axis], atol=1e-9)


def test_it_rests_at_its_ends_and_jumps_in_nothing_up_to_jerk(corridor):
    path = timed_path(min_jerk(corridor, TIMES), TIMES)
    np.testing.assert_allclose(path.breaks, [0, *np.cumsum(TIMES)])
    for s, place in ((0.0, WAYPOINTS[0]), (path.end, WAYPOINTS[-1])):
        np.testing.assert_allclose(path(s), place, atol=1e-6)
        np.testing.assert_allclose([path(s, 1), path(s, 2)], 0.0, atol=1e-6)
    for joint in path.breaks[1:-1]:
        for order in range(4):
            np.testing.assert_allclose(path(joint - 1e-7, order), path(joint + 1e-7, order), atol=1e-4)


def test_every_segment_stays_in_its_box_and_none_could_jerk_less(corridor):
    points = min_jerk(corridor, TIMES)
    path = timed_path(points, TIMES)
    for k in range(3):
        along = path(np.linspace(path.breaks[k], path.breaks[k + 1], 50)) @ corridor.axes[k]
        assert (along >= corridor.low[k] - 1e-4).all()
        assert (along <= corridor.high[k] + 1e-4).all()

    def jerk(control):
        s = np.linspace(0.0, path.end, 4000)
        return np.mean(np.sum(timed_path(control, TIMES)(s, 3) ** 2, axis=1))

    free = min_jerk(wide(WAYPOINTS[0], WAYPOINTS[-1]), TIMES)
    assert jerk(free) < jerk(points)  # a wall is in the way
    other = min_jerk(corridor, np.array([1.3, 1.9, 1.5]))
    assert path.length != pytest.approx(timed_path(other, TIMES).length)


def test_a_goal_outside_of_the_last_box_is_refused(corridor):
    beyond = Corridor(corridor.start, corridor.goal + 50.0, corridor.axes, corridor.low, corridor.high)
    with pytest.raises(InfeasibleError):
        min_jerk(beyond, TIMES)


def test_at_the_least_time_the_speed_or_the_acceleration_is_the_limit(corridor):
    factor = least_time(min_jerk(corridor, TIMES), TIMES)
    path = timed_path(min_jerk(corridor, factor * TIMES), factor * TIMES)
    s = np.linspace(0.0, path.end, 3000)
    speed, acceleration = (np.linalg.norm(path(s, order), axis=1).max() for order in (1, 2))
    assert max(speed / SPEED, acceleration / ACCELERATION) == pytest.approx(1.0, abs=0.01)
