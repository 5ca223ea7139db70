"""Joints: another trajectory of the same state continues without a jump, and its own rest as the same flight."""

import numpy as np
import pytest

from cfplan.errors import InputError
from cfplan.geometry.min_snap import min_snap
from cfplan.vehicle.airframes import AIRFRAMES
from cfplan.vehicle.joint import JoinedTrajectory, joint_at
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.trajectory import Trajectory

WAYPOINTS = [[0, 0, 1], [1.5, 1, 1.4], [1, -1.5, 0.6], [-1, 0.5, 1.2]]
INTERVALS = 40


@pytest.fixture(scope="module")
def trajectory(make_profile):
    path, random = min_snap(WAYPOINTS), np.random.default_rng(5)
    profile = make_profile(
        path.end, random.uniform(0.8, 1.6, INTERVALS + 3), random.uniform(-0.3, 0.3, INTERVALS + 2).cumsum()
    )
    return Trajectory(path, profile, AIRFRAMES["crazyflie-2.1+"])


def rest_of(trajectory: Trajectory, node: int) -> Trajectory:
    """The trajectory from a grid point on, as one of its own."""
    profile = trajectory.profile
    first = profile.s[node]
    part = SpeedProfile(
        profile.s[node:] - first, profile.h[node:], profile.dh[node:], profile.ddh[node:], profile.dddh[node:],
        profile.yaw[node:], profile.dyaw[node:], profile.ddyaw[node:],
    )  # fmt: skip
    return Trajectory(trajectory.path.part(float(first), trajectory.path.end), part, trajectory.airframe)


def test_a_joint_has_the_state_of_the_trajectory_there(trajectory):
    time = 0.37 * trajectory.duration
    joint, state = joint_at(trajectory, time), trajectory.at(time)
    h, dh = joint.state.h, joint.state.dh
    np.testing.assert_allclose(joint.derivatives[0], state.position)
    np.testing.assert_allclose(h**0.5 * joint.derivatives[1], state.velocity)
    np.testing.assert_allclose(h * joint.derivatives[2] + 0.5 * dh * joint.derivatives[1], state.acceleration)
    assert joint.state.yaw == pytest.approx(float(state.yaw))


def test_in_units_of_time_it_is_the_same_state(trajectory):
    """What h, h', h'' and the path's derivatives give of velocity to jerk, by the product rule, is what there was."""
    time = 0.37 * trajectory.duration
    state = trajectory.at(time)
    timed = joint_at(trajectory, time).timed(trajectory, 1.5)
    assert (timed.state.dh, timed.state.ddh) == (0.0, 0.0)
    for order, wanted in enumerate((state.position, state.velocity, state.acceleration, state.jerk, state.snap)):
        np.testing.assert_allclose(timed.state.h ** (order / 2) * timed.derivatives[order], wanted)
    step = 1e-4
    before, after = trajectory.at(time - step), trajectory.at(time + step)
    turning = (float(after.yaw) - float(before.yaw)) / (2 * step)
    assert timed.state.h**0.5 * timed.state.dyaw == pytest.approx(turning, rel=1e-4, abs=1e-6)


@pytest.mark.parametrize("time", [-0.01, 1e3, float("nan")])
def test_where_nothing_moves_there_is_no_joint(trajectory, time):
    with pytest.raises(InputError, match="nothing moves"):
        joint_at(trajectory, time)


def test_a_trajectory_continued_by_its_own_rest_is_the_same_flight(trajectory):
    node = 15
    leave = float(trajectory.time_at(trajectory.profile.s[node]))
    joined = JoinedTrajectory((trajectory,), (0.0,)).continued(leave, rest_of(trajectory, node))
    assert joined.duration == pytest.approx(trajectory.duration)
    times = np.linspace(-0.2, trajectory.duration + 0.2, 2000)
    one, other = trajectory.at(times), joined.at(times)
    for name in ("time", "position", "velocity", "acceleration", "jerk", "quaternion", "body_rate", "motor_thrust"):
        np.testing.assert_allclose(getattr(other, name), getattr(one, name), atol=1e-6, err_msg=name)


def test_later_on_the_same_clock_runs_from_there(trajectory):
    node = 15
    leave = float(trajectory.time_at(trajectory.profile.s[node]))
    joined = JoinedTrajectory((trajectory,), (0.0,)).continued(leave, rest_of(trajectory, node))
    times = np.linspace(0.0, 2.0, 50)
    for since in (0.0, leave - 0.1, leave, leave + 0.3):
        later = joined.since(since)
        np.testing.assert_allclose(later.at(times).position, joined.at(since + times).position, atol=1e-9)
        assert later.duration == pytest.approx(joined.duration - since)
    assert len(joined.since(leave + 0.3).trajectories) == 1
    assert joined.at(1.0).position.shape == (3,)


def test_what_is_kept_from_a_time_on_is_the_same_flight_from_there(trajectory):
    node = 15
    leave = float(trajectory.time_at(trajectory.profile.s[node]))
    joined = JoinedTrajectory((trajectory,), (0.0,)).continued(leave, rest_of(trajectory, node))
    assert len(joined.kept_from(leave).trajectories) == 2  # setpoints are made of the motion just before, too
    kept = joined.kept_from(leave + 0.1)
    assert (kept.starts, kept.duration) == (joined.starts[1:], joined.duration)
    times = np.linspace(leave, joined.duration, 50)
    np.testing.assert_array_equal(kept.at(times).position, joined.at(times).position)


def test_what_is_flown_from_an_earlier_joint_replaces_all_after_it(trajectory):
    later = rest_of(trajectory, 20)
    joined = JoinedTrajectory((trajectory,), (0.0,)).continued(3.0, later).continued(2.0, later)
    assert joined.starts == (0.0, 2.0)


def test_starts_that_do_not_fit_are_refused(trajectory):
    with pytest.raises(InputError, match="1 trajectories and 2 starts"):
        JoinedTrajectory((trajectory,), (0.0, 1.0))
    with pytest.raises(InputError, match="do not ascend"):
        JoinedTrajectory((trajectory, trajectory), (1.0, 1.0))


def test_at_any_time_the_state_is_that_of_the_trajectory_flown_then(trajectory):
    starts = (0.0, 1.1, 2.3)
    joined = JoinedTrajectory((trajectory, trajectory, trajectory), starts)
    times = np.random.default_rng(7).uniform(-0.5, joined.duration + 0.5, 200)
    found, since = joined.at(times), np.select([times < starts[1], times < starts[2]], starts[:2], starts[2])
    expected = trajectory.at(times - since)
    np.testing.assert_array_equal(found.time, times)
    for name in ("s", "position", "body_rate", "motor_thrust", "quaternion"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-12, atol=1e-12)
