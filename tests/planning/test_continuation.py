"""Plans that continue a motion: without a jump, certified, and refused in words where none can be flown."""

from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest

from cfplan.air.replanning import JOINT_DELAYS
from cfplan.errors import InfeasibleError, InputError
from cfplan.flight.setpoints.encoding import RATE
from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.yaw import YawMode
from cfplan.planning.continuation import NoWayError, continue_plan, plan_from_rest, with_room
from cfplan.planning.plan import plan
from cfplan.safety.certificate import certify
from cfplan.vehicle.joint import JoinedTrajectory

WAYPOINTS = np.array([[-1.2, -2.0, 0.8], [1.0, -1.0, 1.2], [-0.8, 0.6, 0.9], [0.9, 2.0, 1.2], [-1.0, 2.6, 0.8]])
CONTINUOUS = ("position", "velocity", "acceleration", "jerk", "quaternion", "body_rate", "yaw")


def with_less(limits):
    """Limits as plans in the air keep them, so that they can be continued."""
    return replace(limits, plan=with_room(limits.plan, limits.airframe))


@pytest.fixture(scope="module")
def flown(limits):
    """A plan through all waypoints but the last."""
    return plan(min_snap(WAYPOINTS[:4]), limits.airframe, with_less(limits), planner="expert", yaw=YawMode.FREE)


def continued_soon(trajectory, leave, *given, **options):
    """The plan from the first joint from which a path leads on, of those that are tried in flight.

    A state just at a limit is all but decided: a little later it is another.
    """
    for leave_room in (True, False):
        for delay in JOINT_DELAYS:
            with suppress(NoWayError):
                return continue_plan(trajectory, leave + delay / RATE, *given, leave_room=leave_room, **options)
    raise NoWayError("from no joint")


@pytest.mark.parametrize(
    ("share", "yaw"),
    [
        (share, yaw)
        for share in (0.05, 0.3, 0.35, 0.55, 0.75)
        for yaw in YawMode
        if (share, yaw) != (0.3, YawMode.TANGENT)  # that state is at a limit, from which no path leads on
    ],
)
def test_a_new_plan_goes_on_without_a_jump_and_is_certified(flown, limits, share, yaw):
    leave = share * flown.trajectory.duration
    waypoints = [[0.3, 1.2, 1.0], [-1.0, 2.4, 1.1]]
    made = continue_plan(flown.trajectory, leave, waypoints, limits, yaw=yaw, yaw_angle=0.5)
    before, after = flown.trajectory.at(leave), made.plan.trajectory.at(0.0)
    for name in CONTINUOUS:
        np.testing.assert_allclose(getattr(after, name), getattr(before, name), atol=1e-6, err_msg=name)
    assert certify(made.plan.trajectory, limits.plan, limits.space).passed
    np.testing.assert_allclose(made.plan.path(made.reached), waypoints, atol=1e-9)
    end = made.plan.trajectory.at(made.plan.trajectory.duration)
    assert not end.velocity.any()
    assert np.allclose(end.acceleration, 0.0, atol=1e-6)


def test_more_waypoints_ahead_change_the_way_little_and_save_the_stop(flown, limits):
    """Extended early by a waypoint, the flight mostly takes no longer than one planned through all at once."""
    at_once = plan(min_snap(WAYPOINTS), limits.airframe, limits, planner="expert").trajectory.duration
    took = []
    for fraction in np.arange(0.1, 0.6, 0.08):
        leave = fraction * flown.trajectory.duration
        reached = flown.path.breaks[flown.path.breaks > flown.trajectory.s_at(leave)]
        ahead = WAYPOINTS[-1 - len(reached) :]
        made = continue_plan(flown.trajectory, leave, ahead, limits, reached=reached)
        np.testing.assert_allclose(made.plan.path(np.array(made.reached)), ahead, atol=1e-9)
        took.append((leave + made.plan.trajectory.duration) / at_once)
    assert np.median(took) < 1.0, took
    assert max(took) < 1.1, took


@pytest.mark.parametrize(
    ("speed", "share", "waypoints"),
    [
        (0.5, 0.3, [[-0.07, -0.91, 1.14], [0.83, -0.92, 0.79], [1.18, 2.18, 0.87]]),
        (0.7, 0.02, [[0.45, 2.5, 1.15], [0.23, 0.2, 0.71], [0.68, -0.6, 0.76]]),
        (0.7, 0.1, [[1.19, 0.8, 0.98], [0.16, -2.46, 0.84], [1.14, -2.18, 0.79]]),
    ],
)
def test_a_lower_speed_is_not_exceeded_between_the_nodes_either(flown, limits, speed, share, waypoints):
    made = continued_soon(flown.trajectory, share * flown.trajectory.duration, waypoints, limits, speed=speed).plan
    times = np.arange(0.0, made.trajectory.duration, 5e-4)
    slowed_down = made.trajectory.s_at(times) > made.path.end / 2
    assert np.linalg.norm(made.trajectory.at(times[slowed_down]).velocity, axis=1).max() <= speed


def test_plans_can_be_continued_again_and_again(flown, limits):
    """Twelve replans, 0.4 s apart, each through two new waypoints: one flight without a jump."""
    random = np.random.default_rng(1)
    joined, made = JoinedTrajectory((flown.trajectory,), (0.0,)), 0
    clock = 0.0
    for _ in range(12):
        clock += 0.4
        last, start = joined.trajectories[-1], joined.starts[-1]
        waypoints = random.uniform([-1.2, -2.6, 0.7], [1.2, 2.6, 1.3], (2, 3))
        try:
            new = continue_plan(last, clock - start, waypoints, limits)
        except InfeasibleError:
            continue
        joined, made = joined.continued(clock, new.plan.trajectory), made + 1
    assert made >= 8
    for start in joined.starts[1:]:
        before, after = joined.at(np.array([start - 1e-7, start])).position, joined.at(start).position
        np.testing.assert_allclose(before[0], after, atol=1e-6)
    times = np.arange(0.0, joined.duration, 0.001)
    states = joined.at(times)
    assert np.linalg.norm(states.velocity, axis=1).max() <= limits.plan.speed + 1e-9
    assert np.linalg.norm(states.acceleration, axis=1).max() <= limits.plan.acceleration + 1e-9
    changes = np.abs(np.diff(states.acceleration, axis=0)).max()
    assert changes < 0.2  # m/s² in a millisecond: no jump


def test_a_waypoint_outside_is_refused_by_its_number(flown, limits):
    with pytest.raises(InfeasibleError, match=r"\(0.000, 0.000, 2.500\) m is 0.700 m too far out") as refused:
        continue_plan(flown.trajectory, 1.0, [[0, 0, 1], [0, 0, 2.5]], limits)
    assert refused.value.where == "waypoint 2"


def test_a_waypoint_just_passed_is_flown_to_after_a_turn(flown, limits):
    leave = 0.5 * flown.trajectory.duration
    state = flown.trajectory.at(leave)
    behind = state.position - 0.05 * state.velocity / np.linalg.norm(state.velocity)
    made = continue_plan(flown.trajectory, leave, [behind], limits)
    np.testing.assert_allclose(made.plan.path(made.reached), [behind], atol=1e-9)
    assert made.plan.path.length > 0.5


def test_where_no_way_leads_through_a_waypoint_speed_and_distance_are_said(flown, limits):
    """The wall stands 10 cm ahead of a vehicle that flies towards it."""
    leave = 0.5 * flown.trajectory.duration
    state = flown.trajectory.at(leave)
    axis = int(np.argmax(np.abs(state.velocity)))
    towards = np.sign(state.velocity[axis])
    low, high = list(limits.space.low), list(limits.space.high)
    wall = high if towards > 0 else low
    wall[axis] = state.position[axis] + towards * (0.1 + limits.space.margin)
    room = replace(limits, space=replace(limits.space, low=tuple(low), high=tuple(high)))
    away = np.zeros(3)
    away[axis] = -0.05 * towards
    with pytest.raises(
        InfeasibleError, match=r"from \d\.\d\d m/s no path leads through waypoint 1, 0\.05 m away"
    ) as refused:
        continue_plan(flown.trajectory, leave, [state.position + away], room)
    x, y, z = flown.trajectory.at(leave + 0.6).position
    assert f"farther on than ({x:.2f}, {y:.2f}, {z:.2f}) m" in refused.value.hint


def test_waypoints_anywhere_in_the_space_are_flown_from_rest(limits):
    random = np.random.default_rng(3)
    low, high = np.array(limits.space.low) + limits.space.margin, np.array(limits.space.high) - limits.space.margin
    made, tried = 0, 20
    for _ in range(tried):
        points = random.uniform(low, high, (4, 3))
        try:
            new = plan_from_rest(points, limits)
        except InfeasibleError:
            continue
        made += 1
        np.testing.assert_allclose(new.plan.path(np.array(new.reached)), points[1:], atol=1e-9)
        assert certify(new.plan.trajectory, limits.plan, limits.space).passed
        assert not new.plan.trajectory.at(0.0).velocity.any()
    assert made >= 0.95 * tried


@pytest.mark.parametrize("end", [[-0.8, 0.5, 1.0], [-0.8, 0.55, 1.1]], ids=["straight back", "almost straight back"])
def test_who_is_to_fly_there_and_back_turns_round_beside_the_wall(flown, limits, end):
    wall = limits.space.high[0] - limits.space.margin
    there = [wall - 0.05, 0.5, 1.0]
    made = plan_from_rest([[0.0, 0.5, 1.0], there, end], limits)
    np.testing.assert_allclose(made.plan.path(np.array(made.reached)), [there, end], atol=1e-9)
    assert certify(made.plan.trajectory, limits.plan, limits.space).passed
    leave = 0.3 * flown.trajectory.duration
    made = continue_plan(flown.trajectory, leave, [[0.0, 0.5, 1.0], there, end], limits)
    assert certify(made.plan.trajectory, limits.plan, limits.space).passed


@pytest.mark.parametrize(
    ("down", "share", "waypoints"),
    [
        (
            [[-0.4, 0.5, 1.7], [-0.5, -0.5, 0.3]],
            0.42,
            [[1.9, -1.1, 1.3], [0.9, -1.7, 0.3], [1.6, 3.4, 0.5], [-1.4, -0.5, 1.1]],
        ),
        ([[-1.6, -0.1, 1.7], [-0.8, -0.4, 0.3]], 0.55, [[1.8, 3.5, 0.7], [0.8, 0.1, 1.7], [0.4, -0.7, 0.3]]),
        ([[0.2, 0.6, 1.7], [1.2, 1.2, 0.3]], 0.35, [[-0.8, -1.3, 0.5], [-1.5, 1.2, 0.8], [2.0, 0.6, 0.7]]),
    ],
)
def test_who_sinks_fast_turns_off_above_the_floor(limits, down, share, waypoints):
    sinking = plan(min_snap(down), limits.airframe, with_less(limits), planner="expert").trajectory
    made = continued_soon(sinking, share * sinking.duration, waypoints, limits)
    assert certify(made.plan.trajectory, limits.plan, limits.space).passed


def test_most_waypoints_anywhere_in_the_space_are_flown_in_motion(flown, limits):
    random, made, tried = np.random.default_rng(5), 0, 24
    low, high = np.array(limits.space.low) + limits.space.margin, np.array(limits.space.high) - limits.space.margin
    for _ in range(tried):
        points = random.uniform(low, high, (3, 3))
        try:
            leave = float(random.uniform(0.1, 0.8)) * flown.trajectory.duration
            new = continued_soon(flown.trajectory, leave, points, limits)
        except InfeasibleError:
            continue
        made += 1
        np.testing.assert_allclose(new.plan.path(np.array(new.reached)), points, atol=1e-9)
    assert made >= 0.9 * tried


def test_who_must_turn_back_from_full_speed_reaches_a_waypoint_a_metre_behind(flown, limits):
    trajectory = flown.trajectory
    for share in np.arange(0.1, 0.9, 0.1):
        leave = share * trajectory.duration
        state = trajectory.at(leave)
        back = state.position - state.velocity / np.linalg.norm(state.velocity)
        back = np.clip(back, np.array(limits.space.low) + 0.3, np.array(limits.space.high) - 0.3)
        made = continued_soon(trajectory, leave, [back], limits)
        np.testing.assert_allclose(made.plan.path(np.array(made.reached)), [back], atol=1e-9)
        assert certify(made.plan.trajectory, limits.plan, limits.space).passed


@pytest.mark.parametrize("waypoints", [[], [[1, 2]], [[np.nan, 0, 1]], [[0.5, 0, 1], [0.5, 0, 1]]])
def test_what_are_no_waypoints_is_refused(flown, limits, waypoints):
    with pytest.raises(InputError):
        continue_plan(flown.trajectory, 1.0, waypoints, limits)


def test_after_its_end_a_plan_is_not_continued(flown, limits):
    with pytest.raises(InputError, match="nothing moves"):
        continue_plan(flown.trajectory, flown.trajectory.duration + 0.1, [[0, 0, 1]], limits)


def test_short_hops_from_rest_are_flown(limits):
    """Less than 0.4 m apart, where the few steps of the quick search find nothing."""
    random = np.random.default_rng(7)
    for _ in range(12):
        first = random.uniform([-1.5, -3.0, 0.5], [1.5, 3.0, 1.5])
        last = first + random.uniform(-0.3, 0.3, 3)
        made = plan_from_rest([first, last], limits)
        assert made.plan.certificate.passed
        np.testing.assert_allclose(made.plan.path(made.reached[-1]), last, atol=1e-9)
