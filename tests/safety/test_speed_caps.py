"""Speed caps: sound where they exist, and certified between samples too."""

from itertools import pairwise

import numpy as np
import pytest
from certificate_oracle import AIRFRAME, LIMITS
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from cfplan.errors import InputError
from cfplan.geometry.min_snap import min_snap
from cfplan.safety.certificate import CAPPED_SPEED, certify
from cfplan.safety.slowing import slow_until_certified
from cfplan.safety.speed_caps import SpeedCaps, allowed_speed
from cfplan.vehicle.trajectory import Trajectory

pytestmark = pytest.mark.unit
PATH = min_snap([[0, 0, 1], [1, 1.5, 1.3], [-1, 2, 0.7]])
sound = st.lists(st.tuples(st.floats(0.0, 1.0), st.floats(0.1, 2.5)), min_size=1, max_size=12, unique_by=lambda p: p[0])


def caps_of(points, end=PATH.end) -> SpeedCaps:
    s, speed = np.array(sorted(points)).T
    assume(len(s) < 2 or np.diff(s).min() > 1e-3)
    return SpeedCaps.of(end * s, speed)


@given(
    st.lists(st.floats(allow_nan=True, allow_infinity=True), max_size=4),
    st.lists(st.floats(allow_nan=True, allow_infinity=True), max_size=4),
)
def test_caps_are_sound_or_refused(places, speeds):
    rising = all(a < b for a, b in pairwise(places)) and np.isfinite(places).all()
    positive = np.isfinite(speeds).all() and all(speed > 0 for speed in speeds)
    if places and len(places) == len(speeds) and rising and positive:
        assert np.isfinite(SpeedCaps.of(places, speeds).at(np.linspace(-1, 1, 9))).all()
    else:
        with pytest.raises(InputError):
            SpeedCaps.of(places, speeds)


@given(sound, st.floats(0.0, 0.6), st.floats(0.1, 0.4))
def test_a_part_has_the_caps_of_the_whole_from_its_beginning(points, begin, length):
    caps = caps_of(points, end=1.0)
    part = caps.part(begin, begin + length)
    within = np.linspace(0.0, length, 50)
    assert part.at(within) == pytest.approx(caps.at(begin + within), rel=1e-9)
    assert part.lie_within(length)


def test_the_lower_of_limit_and_cap_is_allowed():
    caps = SpeedCaps((1.0, 2.0), (1.0, 3.0))
    assert allowed_speed(2.0, caps, np.array([0.0, 1.25, 2.0])).tolist() == [1.0, 1.5, 2.0]
    assert allowed_speed(2.0, None, np.array([0.0])) == 2.0


@settings(max_examples=25, deadline=None)
@given(sound, st.lists(st.floats(0.05, 6.0), min_size=5, max_size=25))
def test_no_speed_between_the_samples_is_nearer_to_a_cap_than_the_certificate_says(make_profile, points, rates):
    caps, trajectory = caps_of(points), Trajectory(PATH, make_profile(PATH.end, np.array(rates)), AIRFRAME)
    margin = certify(trajectory, LIMITS, caps=caps).margins[-1]
    s = np.linspace(0.0, PATH.end, 200_001)
    true = np.sqrt(trajectory.profile.at(s).h) * np.linalg.norm(PATH(s, 1), axis=1) / np.interp(s, caps.s, caps.speed)
    assert margin.name == CAPPED_SPEED
    assert true.max() - 1e-12 <= margin.share <= 1.01 * true.max() + 1e-3
    assert margin.worst == pytest.approx(margin.share * margin.limit)
    assert margin.limit == pytest.approx(float(caps.at(margin.s)))


@settings(max_examples=10, deadline=None)
@given(sound, st.lists(st.floats(0.05, 6.0), min_size=5, max_size=25))
def test_a_profile_too_fast_for_its_caps_is_slowed_until_it_keeps_them(make_profile, points, rates):
    caps, trajectory = caps_of(points), Trajectory(PATH, make_profile(PATH.end, np.array(rates)), AIRFRAME)
    slowed = slow_until_certified(trajectory, LIMITS, caps=caps)
    state = slowed.trajectory.at(np.linspace(0.0, slowed.trajectory.duration, 20_000))
    assert slowed.certificate.passed
    assert (np.linalg.norm(state.velocity, axis=1) <= caps.at(state.s)).all()


def test_without_caps_the_certificate_has_no_row_for_them(make_profile):
    trajectory = Trajectory(PATH, make_profile(PATH.end, np.full(20, 0.3)), AIRFRAME)
    assert CAPPED_SPEED not in [margin.name for margin in certify(trajectory, LIMITS).margins]
