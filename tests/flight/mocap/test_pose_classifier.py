"""Poses that may be used, and those that may not."""

import math

import numpy as np
import pytest

from cfplan.flight.mocap.frames import TrackedBody
from cfplan.flight.mocap.pose_classifier import PoseClassifier, Verdict

PERIOD, JUMP = 0.01, 0.15
RADIUS, SPEED = 1.0, 2.0  # m, m/s of the circle that is flown


def flown(t, *, offset=(0.0, 0.0, 0.0), turned=0.0):
    """On a circle at 2 m/s, with a millimetre of noise, nose along the motion."""
    noise = np.random.default_rng(round(t * 1e6)).normal(0, 0.001, 3)
    angle = SPEED / RADIUS * t
    position = np.array([RADIUS * math.cos(angle), RADIUS * math.sin(angle), 1.0]) + noise + offset
    yaw = angle + math.pi / 2 + turned
    return TrackedBody("cf1", tuple(position.tolist()), (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)))


def classifier_after(seconds=0.5):
    """A classifier that has seen good poses for a while, and the time of the next."""
    classifier, steps = PoseClassifier(JUMP), round(seconds / PERIOD)
    for i in range(steps):
        assert classifier.classify(i * PERIOD, flown(i * PERIOD), i) is Verdict.GOOD
    return classifier, steps


def test_fast_flight_with_noise_is_good_throughout():
    classifier, _ = classifier_after(4.0)
    assert classifier.counts == {Verdict.GOOD: 400}


@pytest.mark.parametrize("gap", [0.05, 0.1, 0.2, 0.3])
def test_flight_goes_on_after_an_occlusion(gap):
    classifier, i = classifier_after()
    hidden = round(gap / PERIOD)
    for k in range(i, i + hidden):
        assert classifier.classify(k * PERIOD, None, k) is Verdict.OCCLUDED
    assert classifier.classify((i + hidden) * PERIOD, flown((i + hidden) * PERIOD), i + hidden) is Verdict.GOOD


def test_a_body_sent_as_zeros_is_occluded():
    classifier, i = classifier_after()
    assert (
        classifier.classify(i * PERIOD, TrackedBody("cf1", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)), i)
        is Verdict.OCCLUDED
    )


def test_the_same_frame_again_is_repeated():
    classifier, i = classifier_after()
    assert classifier.classify((i - 1) * PERIOD, flown((i - 1) * PERIOD), i - 1) is Verdict.REPEATED


@pytest.mark.parametrize("numbers", [True, False], ids=["numbered", "without numbers"])
def test_new_frames_with_the_old_pose_are_frozen(numbers):
    classifier, i = classifier_after()
    stuck = flown((i - 1) * PERIOD)
    for k in range(i, i + 50):
        assert classifier.classify(k * PERIOD, stuck, k if numbers else None) is Verdict.FROZEN


@pytest.mark.parametrize("size", [0.3, 1.0, 20.0])
@pytest.mark.parametrize("lasting", [0.05, 0.5, 10.0])
def test_a_jump_is_not_believed_however_long_and_its_end_is_good(size, lasting):
    classifier, i = classifier_after()
    end = i + round(lasting / PERIOD)
    for k in range(i, end):
        assert classifier.classify(k * PERIOD, flown(k * PERIOD, offset=(size, 0, 0)), k) is Verdict.JUMPED
    after = [classifier.classify(k * PERIOD, flown(k * PERIOD), k) for k in range(end, end + 10)]
    assert after[-1] is Verdict.GOOD


@pytest.mark.parametrize("angle", [math.pi, math.pi / 2, -2.0])
@pytest.mark.parametrize("lasting", [0.05, 0.5, 10.0])
def test_a_flip_is_not_believed_however_long(angle, lasting):
    classifier, i = classifier_after()
    for k in range(i, i + round(lasting / PERIOD)):
        assert classifier.classify(k * PERIOD, flown(k * PERIOD, turned=angle), k) is Verdict.FLIPPED


def test_a_single_outlier_costs_only_itself():
    classifier, i = classifier_after()
    assert classifier.classify(i * PERIOD, flown(i * PERIOD, offset=(0.16, 0, 0)), i) is Verdict.JUMPED
    assert classifier.classify((i + 1) * PERIOD, flown((i + 1) * PERIOD), i + 1) is Verdict.GOOD


def test_a_body_carried_elsewhere_is_believed_after_a_while():
    classifier, i = classifier_after()
    verdicts = [classifier.classify(k * PERIOD, flown(k * PERIOD, offset=(5, 0, 0)), k) for k in range(i, i + 3100)]
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
    classifier, i = classifier_after()
    assert classifier.classify(i * PERIOD, body, i) is Verdict.BROKEN
    assert classifier.classify((i + 1) * PERIOD, flown((i + 1) * PERIOD), i + 1) is Verdict.GOOD
    assert classifier.counts[Verdict.BROKEN] == 1


@pytest.mark.parametrize("gap", [0.8, 1.2])
def test_a_vehicle_that_turned_while_it_was_not_seen_is_told_from_a_pattern_turned_over(gap):
    for turned, expected in ((0.0, Verdict.GOOD), (math.pi, Verdict.FLIPPED)):
        classifier, i = classifier_after()
        k = i + round(gap / PERIOD)
        classifier.attitude = flown(k * PERIOD).quaternion
        assert classifier.classify(k * PERIOD, flown(k * PERIOD, turned=turned), k) is expected


def test_without_the_vehicles_word_a_large_turn_is_not_believed():
    classifier, i = classifier_after()
    k = i + 120
    assert classifier.classify(k * PERIOD, flown(k * PERIOD), k) is Verdict.FLIPPED
