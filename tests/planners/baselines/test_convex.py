"""The lower bound is below everything that can be flown, and meets what can be computed by hand."""

import contextlib
import math
from dataclasses import replace

import numpy as np
import pytest

from cfplan.errors import InfeasibleError
from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.path import Path
from cfplan.geometry.yaw import YawMode
from cfplan.planners.baselines import convex
from cfplan.planners.baselines.convex import lower_bound, plan_convex
from cfplan.planners.baselines.convex_rows import inner_rows
from cfplan.planners.baselines.convex_stations import stations
from cfplan.planners.baselines.min_snap import plan_min_snap
from cfplan.planners.solution import Status
from cfplan.planners.task import PlanningTask
from cfplan.safety.certificate import certify
from cfplan.safety.limit_sets import LIMIT_SETS
from cfplan.safety.slowing import slow_until_certified
from cfplan.vehicle.profile import BoundaryState
from cfplan.vehicle.trajectory import Trajectory

pytestmark = pytest.mark.unit
HARDWARE, SIMULATION = LIMIT_SETS["hardware"], LIMIT_SETS["simulation"]


@pytest.fixture(scope="module")
def wiggly() -> Path:
    return min_snap([[0, 0, 1], [1.5, 1, 1.4], [3, -0.5, 0.8], [1.2, -1.5, 1.1]])


@pytest.mark.parametrize("length", [0.1, 0.8, 3.0, 12.0])
def test_a_straight_line_takes_its_analytic_time(length):
    v, a = HARDWARE.limits.speed, HARDWARE.limits.acceleration
    exact = length / v + v / a if length > v * v / a else 2 * math.sqrt(length / a)
    line = min_snap([[0, 0, 1], [length, 0, 1]])
    bound = lower_bound(PlanningTask(line, HARDWARE.airframe, HARDWARE.limits))
    assert bound == pytest.approx(exact, rel=1e-6)
    assert bound <= exact * (1 + 1e-12)


def test_a_straight_climb_is_held_back_by_thrust_and_a_straight_descent_is_not():
    still = replace(HARDWARE.airframe, drag=(0.0, 0.0))
    limits = HARDWARE.limits
    v, brake = limits.speed, limits.acceleration
    climb = 4 * limits.motor_thrust_max / still.mass - 9.81
    assert climb < brake
    exact = 6.0 / v + v / (2 * climb) + v / (2 * brake)
    bound = lower_bound(PlanningTask(min_snap([[0, 0, 0], [0, 0, 6.0]]), still, limits))
    assert exact * 0.997 <= bound <= exact * (1 + 1e-9)


def test_on_a_circle_curvature_sets_the_speed():
    radius, bounds = 0.4, []
    for turns in (2, 5):
        angle = np.linspace(0, 2 * np.pi * turns, 24 * turns + 1)
        points = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.ones_like(angle)], axis=1)
        bounds.append(lower_bound(PlanningTask(min_snap(points), HARDWARE.airframe, HARDWARE.limits)))
    steady = math.sqrt(HARDWARE.limits.acceleration * radius)
    three_turns = bounds[1] - bounds[0]  # starting and stopping take the same in both
    assert three_turns == pytest.approx(3 * 2 * math.pi * radius / steady, rel=0.01)


@pytest.mark.parametrize("set_name", list(LIMIT_SETS))
def test_nothing_that_is_certified_is_faster_than_the_bound(set_name, wiggly):
    chosen = LIMIT_SETS[set_name]
    bound = lower_bound(PlanningTask(wiggly, chosen.airframe, chosen.limits))
    for planner in (plan_convex, plan_min_snap):
        profile = planner(PlanningTask(wiggly, chosen.airframe, chosen.limits)).profile
        slowed = slow_until_certified(Trajectory(wiggly, profile, chosen.airframe), chosen.limits)
        assert slowed.trajectory.duration > bound


def test_the_convex_profile_is_near_the_bound_before_it_is_slowed(wiggly):
    limits = replace(HARDWARE.limits, angular_acceleration=math.inf)  # it has no share in the bound
    bound = lower_bound(PlanningTask(wiggly, HARDWARE.airframe, limits))
    solution = plan_convex(PlanningTask(wiggly, HARDWARE.airframe, limits))
    assert solution.status is Status.SOLVED
    assert solution.profile is not None
    duration = Trajectory(wiggly, solution.profile, HARDWARE.airframe).duration
    assert bound < duration < 1.1 * bound


@pytest.mark.parametrize("set_name", list(LIMIT_SETS))
def test_the_inner_polygons_come_close_to_the_outer_ones(set_name, wiggly):
    chosen = LIMIT_SETS[set_name]
    bound = lower_bound(PlanningTask(wiggly, chosen.airframe, chosen.limits))
    inside = plan_convex(PlanningTask(wiggly, chosen.airframe, chosen.limits)).stats["point_mass_time"]
    assert bound < inside < 1.03 * bound


@pytest.mark.parametrize("set_name", list(LIMIT_SETS))
def test_the_inner_solution_keeps_the_limits_when_differentiated_in_the_world(set_name, wiggly):
    """With the test above this encloses the best time from both sides; its arithmetic shares no line with the rows."""
    chosen = LIMIT_SETS[set_name]
    at = stations(wiggly, spacing=0.004, turn=0.004)
    fastest = np.full(len(at.length), chosen.limits.speed)
    b = convex.solve_rows(at, inner_rows(at, chosen.airframe, chosen.limits, fastest), (0.0, 0.0))
    time = np.concatenate([[0.0], np.cumsum(2 * np.diff(at.length) / (np.sqrt(b[1:]) + np.sqrt(b[:-1])))])
    velocity = np.diff(wiggly(at.s), axis=0) / np.diff(time)[:, None]
    middle = 0.5 * (time[1:] + time[:-1])
    acceleration = np.diff(velocity, axis=0) / np.diff(middle)[:, None]
    away = (at.length[1:-1] > 0.05) & (at.length[1:-1] < at.length[-1] - 0.05)  # stations are micrometres apart there
    thrust = acceleration + [0, 0, 9.81] + chosen.airframe.drag[0] / chosen.airframe.mass * velocity[1:]
    most = 4 * chosen.limits.motor_thrust_max / chosen.airframe.mass
    assert np.linalg.norm(velocity, axis=1).max() <= chosen.limits.speed * (1 + 1e-6)
    assert np.linalg.norm(acceleration[away], axis=1).max() <= chosen.limits.acceleration * 1.01
    assert np.linalg.norm(thrust[away], axis=1).max() <= most * 1.01


def test_looser_limits_never_raise_the_bound(wiggly):
    bounds = [
        lower_bound(
            PlanningTask(wiggly, HARDWARE.airframe, replace(HARDWARE.limits, speed=speed, acceleration=acceleration))
        )
        for speed, acceleration in ((1.0, 2.0), (2.0, 2.0), (2.0, 5.0), (3.0, 8.0))
    ]
    assert bounds == sorted(bounds, reverse=True)


def test_drag_holds_the_bound_up_because_it_takes_thrust(wiggly):
    still = replace(SIMULATION.airframe, drag=(0.0, 0.0))
    draggy = replace(SIMULATION.airframe, drag=(0.03, 0.03))
    assert lower_bound(PlanningTask(wiggly, draggy, SIMULATION.limits)) > lower_bound(
        PlanningTask(wiggly, still, SIMULATION.limits)
    )


def test_a_flying_start_takes_less_time_than_a_slow_one():
    straight = Path(np.array([0.0, 2.0, 4.0]), np.array([[[0.0, 0, 1], [1, 0, 0]], [[4, 0, 1], [1, 0, 0]]]))
    slow, fast = (BoundaryState(h, 0.0, 0.0, 0.0, 0.0) for h in (0.01, 4.0))
    times = [lower_bound(PlanningTask(straight, HARDWARE.airframe, HARDWARE.limits, start=x)) for x in (slow, fast)]
    assert times[1] == pytest.approx(4.0 / 2.0, rel=1e-6)
    assert times[0] > times[1]


def test_a_start_faster_than_the_limits_is_infeasible_and_says_so():
    straight = Path(np.array([0.0, 2.0, 4.0]), np.array([[[0.0, 0, 1], [1, 0, 0]], [[4, 0, 1], [1, 0, 0]]]))
    solution = plan_convex(
        PlanningTask(
            straight, HARDWARE.airframe, HARDWARE.limits, start=BoundaryState(h=9.0, dh=0.0, ddh=0.0, yaw=0.0, dyaw=0.0)
        )
    )
    assert solution.status is Status.INFEASIBLE
    assert "3.000 m/s" in solution.reason


def test_thrust_below_weight_is_infeasible_in_both_faces(wiggly):
    limits = replace(HARDWARE.limits, motor_thrust_max=0.07)
    with pytest.raises(InfeasibleError, match="limits"):
        lower_bound(PlanningTask(wiggly, HARDWARE.airframe, limits))
    solution = plan_convex(PlanningTask(wiggly, HARDWARE.airframe, limits))
    assert solution.status is Status.INFEASIBLE
    assert solution.profile is None
    assert solution.reason


@pytest.mark.parametrize("yaw", list(YawMode))
def test_min_snap_comes_certified_and_touches_a_limit(yaw, wiggly):
    solution = plan_min_snap(PlanningTask(wiggly, HARDWARE.airframe, HARDWARE.limits, yaw=yaw, yaw_angle=0.3))
    certificate = certify(Trajectory(wiggly, solution.profile, HARDWARE.airframe), HARDWARE.limits)
    assert certificate.passed
    assert certificate.worst.share > 0.98
    assert np.ptp(solution.profile.h) == 0.0


@pytest.mark.parametrize("limit", ["angular_velocity", "angular_acceleration", "acceleration"])
@pytest.mark.parametrize("value", [1e-3, 1e-6, 1e-9])
def test_absurd_limits_end_in_a_solution_or_in_none(wiggly, limit, value):
    limits = replace(HARDWARE.limits, **{limit: value})
    task = PlanningTask(wiggly, HARDWARE.airframe, limits, nodes=30)
    with contextlib.suppress(InfeasibleError):
        assert plan_convex(task).status in (Status.SOLVED, Status.NOT_CONVERGED, Status.INFEASIBLE)
