"""Of the poses that come, the good ones are carried on to now, without their steps, and sent to the vehicle."""

import math

import numpy as np
import pytest

from cfplan.flight.mocap.pose_check import Verdict
from cfplan.flight.mocap.pose_tracker import MAX_EXTRAPOLATION, SMALLEST_STEP, PoseTracker
from cfplan.flight.mocap.poses import Pose
from cfplan.flight.telemetry import Estimate, VehicleStatus
from cfplan.safety.limits import PoseLimits

LEVEL = (0.0, 0.0, 0.0, 1.0)
JUMP = 0.15  # m
LIMITS = PoseLimits(
    rate=100.0, rate_min=80.0, latency=0.01, age_warning=0.05, age_brake=0.15, age_land=0.5, jump=JUMP,
    agreement=0.05, yaw_agreement=0.17,
)  # fmt: skip
TIMES = tuple((0.01 * np.arange(400)).tolist())
_FEW = TIMES[:20]


def straight(time):
    return 2.0 * time, -time, 1.0


def pose(time, place, number=None):
    return Pose(time, time, place, LEVEL, number)


def tracked(place, times=_FEW):
    """A tracker of a vehicle on the ground, after its poses."""
    tracker = PoseTracker(LIMITS)
    for time in times:
        assert tracker.take(pose(time, place(time)))
    return tracker


def sense(tracker, time, place=straight, velocity=(2.0, -1.0, 0.0)):
    """The log of a vehicle that flies straight on."""
    estimate = Estimate(time, place(time), velocity, (0.0, 0.0, 0.0), LEVEL)
    tracker.sense(time, estimate, VehicleStatus(time, (0.0, 0.0, 0.0), (0, 0, 0, 0), 4.0, 0), airborne=True, fresh=True)


def sent(step, times=TIMES, *, senses=True):
    """The x by which what is sent in flight is off, with poses off by `step(time)` along x."""
    tracker, off = PoseTracker(LIMITS), []
    for time in times:
        if senses or time == times[0]:
            sense(tracker, time)
        x, y, z = straight(time)
        tracker.take(pose(time, (x + step(time), y, z)))
        assert not tracker.fault
        position, _ = tracker.to_send(time)
        assert position[1:] == pytest.approx((y, z), abs=1e-9)
        off.append(position[0] - x)
    return np.array(off)


# Judging.


def test_a_vehicle_that_turned_while_its_log_and_its_poses_were_silent_is_known_again():
    tracker, half = PoseTracker(LIMITS), 0.5  # rad/s, of half the angle
    seen = [time for time in TIMES if not 2.2 < time < 2.45]
    for time in seen:
        if time < 1.5:
            sense(tracker, time)
        else:
            tracker.sense(time, None, None, airborne=True, fresh=False)
        turned = (0.0, 0.0, math.sin(half * max(time - 1.5, 0.0)), math.cos(half * max(time - 1.5, 0.0)))
        taken = tracker.take(Pose(time, time, straight(time), turned))
    assert taken
    assert not tracker.fault


def test_the_newest_good_pose_is_sent_once_and_a_bad_one_never():
    tracker = tracked(straight)
    assert tracker.to_send(0.2) is not None
    assert tracker.to_send(0.2) is None
    assert not tracker.take(pose(0.2, (1.4, -0.2, 1.0)))
    assert tracker.fault == Verdict.JUMPED
    assert tracker.to_send(0.2) is None
    assert tracker.take(pose(0.21, straight(0.21)))
    assert not tracker.fault


@pytest.mark.parametrize("rate", [300.0, 170.0])
def test_no_more_poses_are_used_than_the_rate_allows(rate):
    tracker, times = PoseTracker(LIMITS), np.arange(0.0, 1.0, 1.0 / rate).tolist()
    used = sum(tracker.take(pose(time, straight(time))) for time in times)
    assert tracker.verdicts[Verdict.GOOD] == len(times)
    assert 1.15 * LIMITS.rate < used < 1.25 * LIMITS.rate


def test_after_a_gap_a_pose_that_the_vehicle_contradicts_is_recorded_and_not_used():
    tracker = PoseTracker(LIMITS)
    for time in TIMES[:50]:
        sense(tracker, time)
        tracker.take(pose(time, straight(time)))
    sense(tracker, 0.8)
    assert tracker.take(pose(0.8, (straight(0.8)[0] + 0.4, *straight(0.8)[1:])))
    assert tracker.fault == Verdict.ASTRAY
    assert tracker.last.time == TIMES[49]


def test_a_vehicle_that_was_silent_in_the_gap_is_not_asked():
    tracker = PoseTracker(LIMITS)
    for time in TIMES[:50]:
        sense(tracker, time)
        tracker.take(pose(time, straight(time)))
    tracker.sense(0.7, None, None, airborne=True, fresh=False)
    sense(tracker, 0.8)
    tracker.take(pose(0.8, (straight(0.8)[0] + 0.4, *straight(0.8)[1:])))
    assert not tracker.fault


@pytest.mark.parametrize(("slow", "off"), [(True, 0.25), (True, 0.1), (False, 0.25)])
def test_poses_that_move_otherwise_than_the_vehicle_are_distrusted_for_good(slow, off):
    tracker = PoseTracker(LIMITS)
    for time in TIMES:
        sense(tracker, time, velocity=(2.0 + off, -1.0, 0.0))
        tracker.take(pose(time, straight(time)))
        tracker.compare_motion(time, 0.5, slow=slow)
        assert bool(tracker.distrusted) == (slow and off > 0.2 and time > 0.55) or time < 0.6
    assert bool(tracker.fault) == bool(tracker.distrusted)


# Where the vehicle is.


def test_steady_motion_is_carried_on_exactly():
    tracker = tracked(straight)
    assert tracker.velocity == pytest.approx((2.0, -1.0, 0.0))
    assert tracker.position(0.21) == pytest.approx((0.42, -0.21, 1.0))


def test_before_there_are_some_poses_there_is_no_line():
    assert tracked(straight, TIMES[:2]).velocity == (0.0, 0.0, 0.0)
    assert tracked(lambda _: (1.0, 2.0, 3.0), [0.0]).position(0.01) == (1.0, 2.0, 3.0)


def test_hard_acceleration_costs_millimetres():
    tracker, ahead = tracked(lambda t: (2.5 * t**2, 0.0, 1.0)), 0.19 + 0.017
    assert tracker.position(ahead)[0] == pytest.approx(2.5 * ahead**2, abs=0.005)


def test_noise_grows_by_less_than_a_third():
    chance = np.random.default_rng(3)
    errors = [tracked(lambda _: tuple(chance.normal(1.0, 0.001, 3))).position(0.19 + 0.017) for _ in range(300)]
    assert np.std(errors) < 0.0013


def test_nothing_is_carried_far_by_the_line_and_old_poses_do_not_count():
    tracker = tracked(straight)
    assert tracker.position(9.0)[0] == pytest.approx(2.0 * (0.19 + MAX_EXTRAPOLATION))
    assert tracker.take(pose(1.0, (1.0, 0.0, 1.0)))
    assert tracker.velocity == (0.0, 0.0, 0.0)


def test_heights_reach_back_or_are_none():
    tracker = tracked(straight, TIMES[:100])
    assert len(tracker.heights(0.5)) == pytest.approx(49, abs=1)
    assert tracker.heights(-0.1) == []
    assert tracker.heights(0.98) == []


# Sending.


def test_a_late_pose_is_carried_on_by_the_sensors_or_not_sent():
    for heard in (True, False):
        tracker = PoseTracker(LIMITS)
        for time in TIMES[:50]:
            sense(tracker, time)
            tracker.take(pose(time, straight(time)))
        now = TIMES[49] + 0.12
        for time in np.arange(0.5, now, 0.01).tolist() if heard else ():
            sense(tracker, time)
        position = tracker.to_send(now)
        assert position == (pytest.approx(straight(now)), LEVEL) if heard else position is None


def test_a_pose_of_the_age_that_brakes_is_not_sent():
    assert tracked(straight).to_send(_FEW[-1] + LIMITS.age_brake - 0.001) is not None
    assert tracked(straight).to_send(_FEW[-1] + LIMITS.age_brake + 0.001) is None


# Steps.


def test_poses_that_do_not_step_stay_as_they_are():
    chance = np.random.default_rng(1)
    for time in TIMES[:3]:
        tracker = PoseTracker(LIMITS)
        sense(tracker, time)
        tracker.take(pose(time, place := tuple((np.array(straight(time)) + chance.normal(0.0, 0.002, 3)).tolist())))
        assert tracker.position(time) == place
    assert np.abs(sent(lambda time: 0.002 * math.sin(1e3 * time))).max() < 0.003
    assert not tracker.step


@pytest.mark.parametrize("size", [-0.14, 0.05])
def test_a_step_comes_in_at_a_decimetre_a_second_and_completely(size):
    off = sent(lambda time: size if time >= 1.0 else 0.0)
    assert abs(off[100]) < 0.002
    assert np.abs(np.diff(off)).max() < 0.1 * 0.01 + 1e-6
    assert off[-1] == pytest.approx(size)


def test_a_step_there_and_back_leaves_little_behind():
    off = sent(lambda time: 0.1 if 1.0 <= time < 1.2 else 0.0)
    assert np.abs(off).max() < 0.025
    assert off[-1] == pytest.approx(0.0, abs=1e-9)


def test_more_than_a_jump_is_not_kept_back():
    off = sent(lambda time: 0.1 * (time >= 1.0) + 0.1 * (time >= 1.02))
    assert off[101] < 0.01
    assert off[102:] == pytest.approx(0.2)


def test_small_steps_and_steps_that_the_log_does_not_show_pass():
    assert sent(lambda time: 0.9 * SMALLEST_STEP * (time >= 1.0))[100] == pytest.approx(0.9 * SMALLEST_STEP)
    assert sent(lambda time: 0.1 * (time >= 1.0), senses=False)[100] == pytest.approx(0.1)


def test_after_a_gap_poses_count_as_they_are():
    times = [time for time in TIMES if not 1.05 < time < 1.2]
    off = sent(lambda time: 0.1 if time >= 1.0 else 0.0, times)
    assert math.isclose(off[times.index(1.2)], 0.1)
