"""The expert: feasible between the nodes, near the optimum, and honest where it cannot plan."""

import math
from dataclasses import replace

import numpy as np
import pytest

from cfplan.errors import InputError
from cfplan.geometry.min_snap import centripetal_times, min_snap
from cfplan.geometry.path import Path
from cfplan.geometry.yaw import YawMode
from cfplan.planners.expert.expert import can_begin, plan_early, plan_expert
from cfplan.planners.expert.tuning import WindowSize
from cfplan.planners.solution import Solution, Status
from cfplan.planners.task import PlanningTask
from cfplan.planning.planners import default_nodes
from cfplan.safety.certificate import certify
from cfplan.safety.limit_sets import LIMIT_SETS
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.profile import BoundaryState, SpeedProfile
from cfplan.vehicle.trajectory import Trajectory
from studies.drawn_paths import path_of_length

HARDWARE, SIMULATION = LIMIT_SETS["hardware"], LIMIT_SETS["simulation"]
CORNERED = np.array([[0.5, 0.5, 1.0], [3.5, 1.0, 1.5], [3.0, 4.0, 0.8], [1.0, 6.0, 1.2]])


def solved(solution: Solution) -> SpeedProfile:
    assert solution.status is Status.SOLVED, solution.reason
    assert solution.profile is not None
    return solution.profile


def duration(path: Path, profile: SpeedProfile, airframe: Airframe) -> float:
    return Trajectory(path, profile, airframe).duration


@pytest.mark.parametrize("yaw", YawMode)
def test_a_long_path_by_windows_is_as_fast_as_at_once_and_certified_across_joints(yaw):
    path = min_snap(np.concatenate([CORNERED, CORNERED[:2] + 0.4, CORNERED[1:] - 0.3]))
    times = []
    for window, joints in ((WindowSize(60, 30), (0.3, 0.6)), (WindowSize(200, 0), ())):
        task = PlanningTask(path, HARDWARE.airframe, HARDWARE.limits, nodes=200, yaw=yaw)
        solution = plan_expert(task, window=window)
        assert solution.joints == pytest.approx(tuple(joint * path.end for joint in joints))
        trajectory = Trajectory(path, solved(solution), HARDWARE.airframe)  # refuses jumps of h, h', h'' and yaw
        assert certify(trajectory, HARDWARE.limits).passed
        times.append(trajectory.duration)
    assert times[0] == pytest.approx(times[1], rel=5e-3)


def test_the_windows_of_a_path_do_not_depend_on_the_unit_of_s():
    points = np.concatenate([CORNERED, CORNERED + 0.4, CORNERED - 0.3, CORNERED + 0.2])
    limits, found = replace(HARDWARE.limits, speed=4.0), []
    for unit in (0.1, 1.0, 10.0):
        path = min_snap(points, times=unit * centripetal_times(points))
        solution = plan_expert(PlanningTask(path, HARDWARE.airframe, limits, nodes=600))
        found.append((solution.stats["windows"], duration(path, solved(solution), HARDWARE.airframe)))
    assert [windows for windows, _ in found] == [found[0][0]] * 3
    assert found[0][0] > 1
    assert [seconds for _, seconds in found] == pytest.approx([found[0][1]] * 3, rel=1e-3)


# On the first three paths, windows of a fixed number of intervals look too little ahead. On the others, a window begins
# where no motion continues, and the path is planned as a whole.
@pytest.mark.parametrize(("length", "seed"), [(60.0, 1), (60.0, 4), (60.0, 5), (40.0, 132), (60.0, 117), (100.0, 9)])
def test_a_long_path_is_planned_wherever_its_windows_meet(length, seed):
    path = path_of_length(length, "10x10x10", seed)
    task = PlanningTask(path, SIMULATION.airframe, SIMULATION.limits, nodes=default_nodes(path))
    profile = solved(plan_expert(task))
    assert certify(Trajectory(path, profile, SIMULATION.airframe), SIMULATION.limits).passed


@pytest.mark.parametrize("yaw", YawMode)
def test_each_yaw_mode_passes_the_dense_certificate(yaw):
    path = min_snap(CORNERED)
    profile = solved(plan_expert(PlanningTask(path, HARDWARE.airframe, HARDWARE.limits, yaw=yaw, yaw_angle=0.4)))
    trajectory = Trajectory(path, profile, HARDWARE.airframe)
    assert certify(trajectory, HARDWARE.limits).passed
    ends = trajectory.at(np.array([0.0, trajectory.duration]))
    np.testing.assert_allclose(ends.body_rate, 0.0, atol=1e-6)  # at rest nothing turns


def test_a_long_straight_line_takes_the_time_of_constant_acceleration():
    # With attitude dynamics out of the way (no inertia, no limit but speed and acceleration) the fastest way along a
    # line is to accelerate, cruise and brake: T = L/v + v/a.
    airframe = replace(HARDWARE.airframe, inertia=(1e-9, 1e-9, 1e-9), drag=(0.0, 0.0))
    limits = replace(
        SIMULATION.limits, speed=2.0, acceleration=3.0, angular_velocity=1e3, angular_acceleration=math.inf,
        tilt=math.radians(85.0), motor_thrust_max=0.5, motor_thrust_min=1e-3, specific_thrust_min=0.1,
    )  # fmt: skip
    length = 12.0
    path = min_snap(np.array([[0.0, 0, 1], [length / 2, 0, 1], [length, 0, 1]]))
    profile = solved(plan_expert(PlanningTask(path, airframe, limits, nodes=300)))
    fastest = length / limits.speed + limits.speed / limits.acceleration
    assert fastest <= duration(path, profile, airframe) <= 1.015 * fastest


def test_speed_saturates_on_a_long_line():
    path = min_snap(np.array([[0.0, 0, 1], [10.0, 0, 1], [20.0, 0, 1]]))
    profile = solved(plan_expert(PlanningTask(path, HARDWARE.airframe, HARDWARE.limits)))
    speed = np.sqrt(profile.h[40:60]) * np.linalg.norm(path(profile.s[40:60], 1), axis=1)
    np.testing.assert_allclose(speed, HARDWARE.limits.speed, rtol=5e-3)


def test_twice_the_nodes_change_the_time_by_little():
    path = min_snap(CORNERED)
    times = [
        duration(
            path,
            solved(plan_expert(PlanningTask(path, HARDWARE.airframe, HARDWARE.limits, nodes=n))),
            HARDWARE.airframe,
        )
        for n in (80, 160)
    ]
    assert times[1] == pytest.approx(times[0], rel=0.02)


def test_looser_limits_are_never_slower():
    path = min_snap(CORNERED)
    airframe, limits = HARDWARE.airframe, HARDWARE.limits
    slow = duration(path, solved(plan_expert(PlanningTask(path, airframe, limits))), airframe)
    for looser in (
        replace(limits, speed=2.5), replace(limits, acceleration=6.0), replace(limits, tilt=math.radians(40.0)),
        replace(limits, angular_acceleration=70.0),
    ):  # fmt: skip
        assert duration(path, solved(plan_expert(PlanningTask(path, airframe, looser))), airframe) <= slow * (1 + 1e-3)


@pytest.mark.parametrize("yaw", YawMode)
def test_the_rest_of_a_plan_from_one_of_its_states_is_planned_alike(yaw):
    """The rest of a fastest flight is fastest itself (Bellman)."""
    path = min_snap(CORNERED)
    airframe, limits = HARDWARE.airframe, HARDWARE.limits
    whole = solved(plan_expert(PlanningTask(path, airframe, limits, yaw=yaw)))
    first = 30
    part, start = path.part(whole.s[first], path.end), whole.boundary(first)
    again = solved(plan_expert(PlanningTask(part, airframe, limits, nodes=100 - first, yaw=yaw, start=start)))

    np.testing.assert_allclose(
        [again.h[0], again.dh[0], again.yaw[0], again.dyaw[0]], [start.h, start.dh, start.yaw, start.dyaw], atol=1e-6
    )
    times = Trajectory(path, whole, airframe).time_at(whole.s[[first, -1]])
    assert duration(part, again, airframe) == pytest.approx(times[1] - times[0], rel=2e-3)


def test_a_free_end_in_motion_is_at_least_as_fast_as_a_flight_that_goes_on():
    path = min_snap(CORNERED)
    airframe, limits = HARDWARE.airframe, HARDWARE.limits
    whole = solved(plan_expert(PlanningTask(path, airframe, limits)))
    part = path.part(0.0, whole.s[50])
    free = solved(plan_expert(PlanningTask(part, airframe, limits, nodes=50)))
    assert duration(part, free, airframe) <= Trajectory(path, whole, airframe).time_at(whole.s[50]) * (1 + 1e-3)


def test_fixed_yaw_stays():
    path = min_snap(CORNERED)
    profile = solved(plan_expert(PlanningTask(path, HARDWARE.airframe, HARDWARE.limits, yaw_angle=-0.7)))
    np.testing.assert_array_equal(profile.yaw, -0.7)
    np.testing.assert_array_equal(profile.ddyaw, 0.0)


def test_tangent_yaw_points_along_the_flight():
    path = min_snap(CORNERED)
    profile = solved(plan_expert(PlanningTask(path, HARDWARE.airframe, HARDWARE.limits, yaw=YawMode.TANGENT)))
    inner = slice(10, 91)
    tangent = path(profile.s[inner], 1)
    heading = np.arctan2(tangent[:, 1], tangent[:, 0])
    error = np.angle(np.exp(1j * (profile.yaw[inner] - heading)))
    assert np.abs(error).max() < math.radians(10.0)


def test_free_yaw_starts_within_a_quarter_turn_and_does_not_drift():
    path = min_snap(CORNERED)
    profile = solved(
        plan_expert(PlanningTask(path, SIMULATION.airframe, SIMULATION.limits, yaw=YawMode.FREE, yaw_angle=1.0))
    )
    assert 1.0 - 1e-6 <= profile.yaw[0] <= 1.0 + math.pi / 2 + 1e-6
    assert np.ptp(profile.yaw) < math.pi


def test_the_same_call_gives_the_same_bytes():
    path = min_snap(CORNERED)
    one, two = (solved(plan_expert(PlanningTask(path, HARDWARE.airframe, HARDWARE.limits, nodes=60))) for _ in range(2))
    assert one.h.tobytes() == two.h.tobytes()


def test_a_start_too_fast_for_the_limits_is_named():
    path = min_snap(CORNERED).part(2.0, 6.0)
    state = BoundaryState(h=25.0, dh=0.0, ddh=0.0, yaw=0.0, dyaw=0.0)
    solution = plan_expert(PlanningTask(path, HARDWARE.airframe, HARDWARE.limits, nodes=40, start=state))
    assert solution.status is Status.BAD_BOUNDARY
    assert solution.profile is None
    assert "speed" in solution.reason


def test_a_state_that_stands_still_is_refused():
    path = min_snap(CORNERED).part(2.0, 6.0)
    state = BoundaryState(h=0.0, dh=0.0, ddh=0.0, yaw=0.0, dyaw=0.0)
    assert (
        plan_expert(PlanningTask(path, HARDWARE.airframe, HARDWARE.limits, start=state)).status is Status.BAD_BOUNDARY
    )


def test_a_start_that_cannot_brake_in_time_is_a_result_not_an_exception():
    # Allowed by itself, at the speed limit, but half a metre before the path's rest.
    whole = min_snap(np.array([[0.0, 0, 1], [4.0, 0, 1], [8.0, 0, 1]]))
    path = whole.part(whole.end - 0.8, whole.end)
    h = (0.99 * HARDWARE.limits.speed / np.linalg.norm(path(0.0, 1))) ** 2
    state = BoundaryState(h=float(h), dh=0.0, ddh=0.0, yaw=0.0, dyaw=0.0)
    solution = plan_expert(PlanningTask(path, HARDWARE.airframe, HARDWARE.limits, nodes=30, start=state))
    assert solution.status in (Status.NOT_CONVERGED, Status.BAD_BOUNDARY)
    assert solution.profile is None
    assert solution.reason


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"motor_thrust_max": 0.05}, "motor_thrust_max"),
        ({"motor_thrust_min": 0.1}, "motor_thrust_min"),
        ({"specific_thrust_min": 12.0}, "specific_thrust_min"),
        ({"speed": 0.0}, "speed"),
        ({"tilt": float("nan")}, "tilt"),
    ],
)
def test_limits_that_exclude_hovering_are_named(changes, named):
    limits: PlanLimits = replace(HARDWARE.limits, **changes)
    solution = plan_expert(PlanningTask(min_snap(CORNERED), HARDWARE.airframe, limits))
    assert solution.status is Status.INFEASIBLE
    assert named in solution.reason


def test_too_few_nodes_are_refused_with_the_number_needed():
    path = min_snap(CORNERED)
    with pytest.raises(InputError, match="too few") as caught:
        plan_expert(PlanningTask(path, HARDWARE.airframe, HARDWARE.limits, nodes=5))
    assert "at least" in caught.value.hint


def test_numbers_that_are_none_are_refused():
    path = min_snap(CORNERED)
    with pytest.raises(InputError, match="yaw"):
        plan_expert(PlanningTask(path, HARDWARE.airframe, HARDWARE.limits, yaw_angle=float("nan")))
    with pytest.raises(InputError, match="start"):
        plan_expert(
            PlanningTask(
                path, HARDWARE.airframe, HARDWARE.limits, start=BoundaryState(float("inf"), 0.0, 0.0, 0.0, 0.0)
            )
        )


def test_the_solver_prints_nothing(capfd):
    plan_expert(PlanningTask(min_snap(CORNERED), HARDWARE.airframe, HARDWARE.limits, nodes=40))
    captured = capfd.readouterr()
    assert captured.out == ""
    assert captured.err == ""


@pytest.mark.parametrize("yaw", YawMode)
def test_a_plan_that_stops_early_is_certified_and_nearly_as_fast(yaw):
    path = min_snap(CORNERED)
    task = PlanningTask(path, HARDWARE.airframe, HARDWARE.limits, yaw=yaw)
    best, early = plan_expert(task), plan_early(task)
    assert certify(Trajectory(path, solved(early), HARDWARE.airframe), HARDWARE.limits).passed
    assert duration(path, solved(early), HARDWARE.airframe) < 1.001 * duration(path, solved(best), HARDWARE.airframe)
    assert early.stats["iterations"] < 0.85 * best.stats["iterations"]


@pytest.mark.parametrize("yaw", YawMode)
def test_where_limits_leave_room_a_plan_is_made_in_fewer_rounds(yaw):
    path = min_snap(CORNERED)
    task = PlanningTask(path, HARDWARE.airframe, HARDWARE.limits, yaw=yaw)
    kept, early = plan_early(task), plan_early(task, 0.003)
    assert early.stats["rounds"] < kept.stats["rounds"]
    assert certify(Trajectory(path, solved(early), HARDWARE.airframe), HARDWARE.limits).worst.share < 1.003


def test_what_cannot_be_braked_for_is_given_up_early():
    """A little before a sharp corner; plan_expert's first search takes 60 steps to see that."""
    corner = min_snap([[0, 0, 1], [1, 0, 1], [1, 0.4, 1], [0.3, 0.4, 1]])
    path = corner.part(0.8, corner.end)
    nominal = float(np.linalg.norm(path(0.0, 1)))
    for speed, leads_on in ((1.4, True), (1.8, False)):
        start = BoundaryState((speed / nominal) ** 2, 0.0, 0.0, 0.0, 0.0)
        task = PlanningTask(path, HARDWARE.airframe, HARDWARE.limits, start=start)
        assert task.refusal is None
        solution = plan_early(task)
        assert (solution.profile is not None) is leads_on
    assert solution.reason == "no step improves the solution"


@pytest.mark.parametrize("yaw", YawMode)
def test_the_beginning_of_a_path_tells_whether_it_can_be_flown_from_a_start_in_motion(yaw):
    """Nearer and nearer to a sharp corner, faster and faster, and turned away from the yaw that is wanted.

    In one of 18 cases, at most, one search just succeeds where the other just fails.
    """
    corner = min_snap([[0, 0, 1], [1, 0, 1], [1, 0.4, 1], [0.3, 0.4, 1]])
    told, is_so = [], []
    for begin in (0.5, 0.65, 0.8):
        path = corner.part(begin, corner.end)
        nominal = float(np.linalg.norm(path(0.0, 1)))
        for speed in (0.8, 1.2, 1.4, 1.6, 1.8, 2.5):
            start = BoundaryState((speed / nominal) ** 2, 0.0, 0.0, 0.4, 0.0)
            task = PlanningTask(path, HARDWARE.airframe, HARDWARE.limits, yaw=yaw, start=start)
            told.append(can_begin(task))
            is_so.append(plan_early(task).profile is not None)
    assert np.not_equal(told, is_so).sum() <= 1
    assert 6 <= sum(is_so) <= 12
