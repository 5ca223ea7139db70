"""A step of the poses reaches the vehicle slowly, and motion at once."""

import math

import numpy as np
import pytest

from cfplan.flight.mocap.pose_steps import SMALLEST, PoseSteps
from cfplan.flight.mocap.poses import Pose

LEVEL = (0.0, 0.0, 0.0, 1.0)
JUMP = 0.15  # m
TIMES = (0.01 * np.arange(400)).tolist()


def true_place(time):
    return 2.0 * time, -time, 1.0


def flown(step, times=TIMES, knows=true_place):
    """The x by which smoothed poses are off, with poses off by `step(time)` along x."""
    steps, off = PoseSteps(JUMP), []
    for time in times:
        x, y, z = true_place(time)
        expected = knows(time)
        if expected is not None and off:
            expected = (expected[0] + off[-1], *expected[1:])  # where the poses before lead
        smoothed = steps.smooth(Pose(time, time, (x + step(time), y, z), LEVEL), expected)
        assert smoothed.position[1:] == (y, z)
        off.append(smoothed.position[0] - x)
    return np.array(off)


def test_poses_that_do_not_step_stay_as_they_are():
    chance, steps = np.random.default_rng(1), PoseSteps(JUMP)
    for time in TIMES:
        x, y, z = np.array(true_place(time)) + chance.normal(0.0, 0.002, 3)
        pose = Pose(time, time, (float(x), float(y), float(z)), LEVEL)
        assert steps.smooth(pose, true_place(time)) is pose


@pytest.mark.parametrize("size", [-0.14, 0.05])
def test_a_step_comes_in_at_a_decimetre_a_second_and_whole(size):
    off = flown(lambda time: size if time >= 1.0 else 0.0)
    assert abs(off[100]) < 0.002
    assert np.abs(np.diff(off)).max() < 0.1 * 0.01 + 1e-9
    assert off[-1] == pytest.approx(size)


def test_a_step_there_and_back_leaves_little_behind():
    off = flown(lambda time: 0.1 if 1.0 <= time < 1.2 else 0.0)
    assert np.abs(off).max() < 0.025
    assert off[-1] == 0.0


def test_more_than_a_jump_is_not_kept_back():
    off = flown(lambda time: 0.1 * (time >= 1.0) + 0.1 * (time >= 1.02))
    assert off[101] < 0.01
    assert off[102:] == pytest.approx(0.2)


def test_small_steps_and_steps_of_which_nobody_knows_pass():
    assert flown(lambda time: 0.9 * SMALLEST * (time >= 1.0))[100] == pytest.approx(0.9 * SMALLEST)
    assert flown(lambda time: 0.1 * (time >= 1.0), knows=lambda _: None)[100] == pytest.approx(0.1)


def test_after_a_gap_poses_count_as_they_are():
    times = [time for time in TIMES if not 1.05 < time < 1.2]
    off = flown(lambda time: 0.1 if time >= 1.0 else 0.0, times)
    assert math.isclose(off[times.index(1.2)], 0.1)
