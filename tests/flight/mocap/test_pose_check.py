"""Poses that may be used, and those that may not."""

import math

import numpy as np
import pytest

from cfplan.flight.mocap.frames import TrackedBody
from cfplan.flight.mocap.pose_check import PoseCheck, Verdict

PERIOD, JUMP = 0.01, 0.15
RADIUS, SPEED = 1.0, 2.0  # m, m/s of the circle that is flown


def flown(t, *, offset=(0.0, 0.0, 0.0), turned=0.0):
    """On a circle at 2 m/s, with a millimetre of noise, nose along the motion."""
    noise = np.random.default_rng(round(t * 1e6)).normal(0, 0.001, 3)
    angle = SPEED / RADIUS * t
    position = np.array([RADIUS * math.cos(angle), RADIUS * math.sin(angle), 1.0]) + noise + offset
    yaw = angle + math.pi / 2 + turned
    return TrackedBody("cf1", tuple(position.tolist()), (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)))


def check_after(seconds=0.5):
    """A check that has seen good poses for a while, and the time of the next."""
    check, steps = PoseCheck(JUMP), round(seconds / PERIOD)
    for i in range(steps):
        assert check.judge(i * PERIOD, flown(i * PERIOD), i) is Verdict.GOOD
    return check, steps


def test_fast_flight_with_noise_is_good_throughout():
    check, _ = check_after(4.0)
    assert check.counts == {Verdict.GOOD: 400}


@pytest.mark.parametrize("gap", [0.05, 0.1, 0.2, 0.3])
def test_flight_goes_on_after_an_occlusion(gap):
    check, i = check_after()
    hidden = round(gap / PERIOD)
    for k in range(i, i + hidden):
        assert check.judge(k * PERIOD, None, k) is Verdict.OCCLUDED
    assert check.judge((i + hidden) * PERIOD, flown((i + hidden) * PERIOD), i + hidden) is Verdict.GOOD


def test_a_body_sent_as_zeros_is_occluded():
    check, i = check_after()
    assert check.judge(i * PERIOD, TrackedBody("cf1", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)), i) is Verdict.OCCLUDED


def test_the_same_frame_again_is_repeated():
    check, i = check_after()
    assert check.judge((i - 1) * PERIOD, flown((i - 1) * PERIOD), i - 1) is Verdict.REPEATED


@pytest.mark.parametrize("frames", [1, 3, 30])
def test_an_older_frame_that_comes_late_is_repeated(frames):
    check, i = check_after()
    time = (i - 1 - frames) * PERIOD
    assert check.judge(time, flown(time), i - 1 - frames) is Verdict.REPEATED


@pytest.mark.parametrize("numbers", [True, False], ids=["numbered", "without numbers"])
def test_new_frames_with_the_old_pose_are_frozen(numbers):
    check, i = check_after()
    stuck = flown((i - 1) * PERIOD)
    for k in range(i, i + 50):
        assert check.judge(k * PERIOD, stuck, k if numbers else None) is Verdict.FROZEN


@pytest.mark.parametrize("size", [0.3, 1.0, 20.0])
@pytest.mark.parametrize("lasting", [0.05, 0.5, 10.0])
def test_a_jump_is_not_believed_however_long_and_its_end_is_good(size, lasting):
    check, i = check_after()
    end = i + round(lasting / PERIOD)
    for k in range(i, end):
        assert check.judge(k * PERIOD, flown(k * PERIOD, offset=(size, 0, 0)), k) is Verdict.JUMPED
    after = [check.judge(k * PERIOD, flown(k * PERIOD), k) for k in range(end, end + 10)]
    assert after[-1] is Verdict.GOOD


@pytest.mark.parametrize("angle", [math.pi, math.pi / 2, -2.0])
@pytest.mark.parametrize("lasting", [0.05, 0.5, 10.0])
def test_a_flip_is_not_believed_however_long(angle, lasting):
    check, i = check_after()
    for k in range(i, i + round(lasting / PERIOD)):
        assert check.judge(k * PERIOD, flown(k * PERIOD, turned=angle), k) is Verdict.FLIPPED


def test_a_single_outlier_costs_only_itself():
    check, i = check_after()
    assert check.judge(i * PERIOD, flown(i * PERIOD, offset=(0.16, 0, 0)), i) is Verdict.JUMPED
    assert check.judge((i + 1) * PERIOD, flown((i + 1) * PERIOD), i + 1) is Verdict.GOOD


def test_a_body_carried_elsewhere_is_believed_after_a_while():
    check, i = check_after()
    verdicts = [check.judge(k * PERIOD, flown(k * PERIOD, offset=(5, 0, 0)), k) for k in range(i, i + 3100)]
    assert verdicts[0] is Verdict.JUMPED
    assert verdicts[2990] is Verdict.JUMPED
    assert verdicts[-1] is Verdict.GOOD


@pytest.mark.parametrize(
    "body",
    [
        TrackedBody("cf1", (math.nan, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0)),
        TrackedBody("cf1", (1.0, math.inf, 1.0), (0.0, 0.0, 0.0, 1.0)),
        TrackedBody("cf1", (1.0, 0.0, 1.0), (math.nan, 0.0, 0.0, 1.0)),
        TrackedBody("cf1", (1.0, 0.0, 1.0), (0.0, 0.0, 0.0, 0.0)),
        TrackedBody("cf1", (1.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.1)),
    ],
)
def test_what_is_no_pose_is_broken_and_forgotten(body):
    check, i = check_after()
    assert check.judge(i * PERIOD, body, i) is Verdict.BROKEN
    assert check.judge((i + 1) * PERIOD, flown((i + 1) * PERIOD), i + 1) is Verdict.GOOD
    assert check.counts[Verdict.BROKEN] == 1


@pytest.mark.parametrize("gap", [0.8, 1.2])
def test_a_vehicle_that_turned_while_it_was_not_seen_is_told_from_a_pattern_turned_over(gap):
    for turned, expected in ((0.0, Verdict.GOOD), (math.pi, Verdict.FLIPPED)):
        check, i = check_after()
        k = i + round(gap / PERIOD)
        check.attitude = flown(k * PERIOD).quaternion
        assert check.judge(k * PERIOD, flown(k * PERIOD, turned=turned), k) is expected


def test_without_the_vehicles_word_a_large_turn_is_not_believed():
    check, i = check_after()
    k = i + 120
    assert check.judge(k * PERIOD, flown(k * PERIOD), k) is Verdict.FLIPPED


def test_after_a_gap_a_pose_must_agree_with_what_the_vehicle_believes():
    for offset, expected in ((0.0, Verdict.GOOD), (0.4, Verdict.ASTRAY)):
        check, i = check_after()
        time = (i + 30) * PERIOD
        seen = flown(time, offset=(offset, 0, 0))
        assert check.judge(time, seen, believed=flown(time).position) is expected


def test_without_a_gap_the_vehicle_is_not_asked_and_in_a_long_one_it_may_drift():
    check, i = check_after()
    assert check.judge(i * PERIOD, flown(i * PERIOD), believed=(5.0, 0.0, 1.0)) is Verdict.GOOD
    time = i * PERIOD + 2.0
    check.attitude = flown(time).quaternion
    assert check.judge(time, flown(time, offset=(0.9, 0, 0)), believed=flown(time).position) is Verdict.GOOD


def test_poses_that_are_astray_do_not_become_the_vehicles_place():
    check, i = check_after()
    for k in range(i + 30, i + 40):
        believed = flown(k * PERIOD).position
        assert check.judge(k * PERIOD, flown(k * PERIOD, offset=(0.4, 0, 0)), believed=believed) is Verdict.ASTRAY


def test_more_than_any_vehicle_flies_is_a_jump():
    check, i = check_after()
    time = i * PERIOD + 1.0
    check.attitude = flown(time).quaternion
    assert check.judge(time, flown(time, offset=(0.0, 0.0, 9.0))) is Verdict.JUMPED
