"""Paths on which a vehicle goes on: where their choice begins, what they cost, and that they begin in its state."""

from dataclasses import replace

import numpy as np
import pytest

from cfplan.deadline import NEVER
from cfplan.geometry.min_snap import centripetal_times
from cfplan.geometry.path_file import path_through
from cfplan.planning.continuation import plan_from_rest
from cfplan.planning.path.onward import STEPS, Departure, along, onward_paths, toward
from cfplan.planning.path.room import Room
from cfplan.planning.path.search import search
from cfplan.planning.path.soft_limits import SoftLimits
from cfplan.planning.path.variables import Knots, variables_of
from cfplan.planning.plan import plan
from cfplan.safety.space import Box, Cylinder
from cfplan.vehicle.profile import BoundaryState

MOVED = 1e-5
POINTS = np.array([[0.0, 0.0, 1.0], [0.5, 0.6, 1.1], [1.0, -0.4, 0.9], [-0.8, 0.8, 1.2]])
MOTION = np.array([POINTS[0], [1.2, 0.6, 0.1], [1.0, -2.0, 0.5], [5.0, -8.0, 3.0], [20.0, 30.0, -10.0]])


@pytest.mark.parametrize("outside", [False, True], ids=["inside", "with points outside"])
@pytest.mark.parametrize("moving", [False, True], ids=["from rest", "in motion"])
def test_the_gradient_of_soft_limits_is_that_of_central_differences(limits, moving, outside):
    """Of times and points, near obstacles; so fast that all limits are exceeded somewhere."""
    points = POINTS.copy()
    points[1, 0] += 2.0 * outside  # beyond a wall
    obstacles = Box((0.9, -0.1, 0.8), (1.2, 0.1, 1.3), 0.4), Cylinder(0.3, 0.9, 0.1, 0.0, 1.0)
    space = replace(limits.space, obstacles=obstacles if outside else ())
    assert (space.beyond(points).max() > 0.0) == outside
    knots = Knots(centripetal_times(points) / 2, points, np.array([0, 2, 3]), MOTION if moving else None)
    room = Room(space, points[knots.waypoint], None)
    cost = SoftLimits(variables_of(knots, (None,) * 3, 1, space.margin), limits, room, limits.plan.speed)
    first = cost.first
    random = np.random.default_rng(5)
    for x in (first, first + random.normal(scale=0.3, size=first.shape)):
        _, gradient = cost(x)
        moves = MOVED * np.eye(len(x))
        expected = np.array([(cost(x + move)[0] - cost(x - move)[0]) / (2.0 * MOVED) for move in moves])
        np.testing.assert_allclose(gradient, expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max())


def assert_begins_in_motion(path):
    np.testing.assert_allclose(path.derivatives(np.zeros(1))[..., 0], MOTION, atol=1e-9)


def test_a_descent_begins_straight_ahead_and_in_motion_braking_first_too(limits):
    rest, moving = Departure(POINTS[0]), Departure(POINTS[0], MOTION)
    assert len(toward(rest, POINTS[1:], limits)) == 1
    straight, braking = toward(moving, POINTS[1:], limits)
    for knots in (straight, braking):
        np.testing.assert_array_equal(knots.points[knots.waypoint], POINTS)
        assert_begins_in_motion(knots.path)
    stopping = np.linalg.norm(MOTION[1]) ** 2 / 2 / limits.plan.acceleration
    assert np.linalg.norm(braking.points[1] - POINTS[0]) > stopping


def test_paths_that_are_found_begin_in_the_state_of_the_joint_and_go_through_the_waypoints(limits):
    moving = Departure(POINTS[0], MOTION, BoundaryState(1.0, 0.0, 0.0, 0.0, 0.0))
    found = list(onward_paths(toward(moving, POINTS[1:], limits), moving, limits, limits.plan.speed))
    assert found
    for knots in found:
        assert_begins_in_motion(knots.path)
        np.testing.assert_allclose(knots.path(knots.breaks[knots.waypoint]), POINTS, atol=1e-9)
        assert (limits.space.beyond(knots.path(np.linspace(0.0, knots.path.end, 300))) < 0.05).all()


def test_the_path_left_is_where_a_descent_begins_that_goes_on_along_it(limits):
    """Its points lie on the path left, at the times at which it is flown, and more waypoints follow them."""
    left = plan_from_rest(POINTS, limits)
    trajectory, leave = left.plan.trajectory, 0.3 * left.reached[0]
    state = trajectory.at(leave)
    moving = Departure(state.position, np.zeros((5, 3)))
    more = np.array([[0.0, 1.0, 1.0]])
    knots = along(trajectory, leave, np.array(left.reached), moving, more, limits)
    np.testing.assert_allclose(knots.points[knots.waypoint], [state.position, *POINTS[1:], *more], atol=1e-9)
    flown = leave + knots.breaks[: knots.waypoint[-2] + 1]
    np.testing.assert_allclose(trajectory.at(flown).position, knots.points[: len(flown)], atol=1e-6)


def test_a_choice_is_the_same_again_and_ends_after_a_bounded_number_of_evaluations(limits, monkeypatch):
    """Whatever the computer's load, so that a flight on the stepped clock is the same on every run."""
    evaluated = []
    cost = SoftLimits.__call__
    monkeypatch.setattr(SoftLimits, "__call__", lambda each, x: evaluated.append(x) or cost(each, x))
    moving = Departure(POINTS[0], MOTION, BoundaryState(1.0, 0.0, 0.0, 0.0, 0.0))
    begins = toward(moving, POINTS[1:], limits)
    first, again = (next(onward_paths(begins, moving, limits, limits.plan.speed)) for _ in range(2))
    np.testing.assert_array_equal(first.times, again.times)
    np.testing.assert_array_equal(first.points, again.points)
    assert len(evaluated) / 2 <= len(begins) + 1.2 * STEPS


def test_a_path_chosen_in_the_air_is_flown_nearly_as_soon_as_one_searched_for_without_haste(limits):
    """From rest, where both choose among the same paths."""
    searched = search(path_through(POINTS), limits, NEVER).knots.path
    made = plan(searched, limits.airframe, limits, planner="expert")
    assert plan_from_rest(POINTS, limits).plan.trajectory.duration < 1.05 * made.trajectory.duration
