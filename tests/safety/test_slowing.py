"""Whatever fails is slowed until it passes, and no more than it must."""

from dataclasses import replace

import numpy as np
import pytest
from certificate_oracle import AIRFRAME, LIMITS
from hypothesis import given, settings
from hypothesis import strategies as st

from cfplan.errors import InfeasibleError
from cfplan.geometry.min_snap import min_snap
from cfplan.safety.certificate import WALLS, certify
from cfplan.safety.slowing import RESOLUTION, slow_until_certified
from cfplan.safety.space import Space
from cfplan.vehicle.trajectory import Trajectory

PATH = min_snap([[0, 0, 1], [1, 1.5, 1.3], [-1, 2, 0.7]])


@settings(max_examples=20, deadline=None)
@given(st.lists(st.floats(0.05, 6.0), min_size=5, max_size=40), st.floats(0.2, 30.0))
def test_any_profile_ends_certified_and_hardly_slower_than_it_must(make_profile, rates, scale):
    trajectory = Trajectory(PATH, make_profile(PATH.end, scale * np.array(rates)), AIRFRAME)
    slowed = slow_until_certified(trajectory, LIMITS)
    assert slowed.certificate.passed
    assert certify(slowed.trajectory, LIMITS) == slowed.certificate
    assert slowed.trajectory.duration == pytest.approx(trajectory.duration / slowed.speed_factor, rel=1e-9)
    if slowed.speed_factor < 1.0:
        faster = trajectory.profile.slowed(slowed.speed_factor * (1 + 20 * RESOLUTION))
        assert not certify(Trajectory(PATH, faster, AIRFRAME), LIMITS).passed


def test_what_passes_stays_as_it_is(make_profile):
    trajectory = Trajectory(PATH, make_profile(PATH.end, np.full(20, 0.3)), AIRFRAME)
    slowed = slow_until_certified(trajectory, LIMITS)
    assert slowed.trajectory is trajectory
    assert slowed.speed_factor == 1.0


def test_a_speed_limit_alone_is_met_by_its_ratio(make_profile):
    trajectory = Trajectory(PATH, make_profile(PATH.end, np.full(20, 1.0)), AIRFRAME)
    speed = certify(trajectory, LIMITS).margins[0].worst
    slowed = slow_until_certified(trajectory, replace(LIMITS, speed=0.4 * speed))
    assert slowed.speed_factor == pytest.approx(0.4, rel=5 * RESOLUTION)


def test_flying_upside_down_is_slowed_too(make_profile):
    # Straight up so fast that the thrust must point down on the way: the attitude is no number there.
    path = min_snap([[0, 0, 0.5], [0, 0, 1.5]])
    trajectory = Trajectory(path, make_profile(path.end, np.full(20, 9.0)), AIRFRAME)
    assert np.isnan(certify(trajectory, LIMITS).worst.share)
    assert slow_until_certified(trajectory, LIMITS).certificate.passed


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"motor_thrust_max": 0.07}, "hovering takes"),
        ({"motor_thrust_min": 0.08}, "hovering takes"),
        ({"specific_thrust_min": 9.9}, "hovering takes"),
        ({"speed": 1e-9}, "speed exceeds its limit at any speed"),
        ({"tilt": float("nan")}, "tilt exceeds its limit at any speed"),
    ],
)
def test_limits_that_no_flight_keeps_are_named(make_profile, changes, message):
    trajectory = Trajectory(PATH, make_profile(PATH.end, np.full(20, 4.0)), AIRFRAME)
    with pytest.raises(InfeasibleError, match=message):
        slow_until_certified(trajectory, replace(LIMITS, **changes))


def test_a_path_along_a_wall_is_slowed_no_more_than_one_in_the_open(make_profile):
    trajectory = Trajectory(PATH, make_profile(PATH.end, np.full(20, 4.0)), AIRFRAME)
    far = Space(low=(-4.0, -4.0, 0.0), high=(4.0, 4.0, 4.0), margin=0.1)
    highest = max(PATH(np.linspace(0.0, PATH.end, 20_001))[:, 2])
    touching = replace(far, high=(4.0, 4.0, float(highest) + far.margin + 1e-6))
    slowed = {space: slow_until_certified(trajectory, LIMITS, space) for space in (far, touching)}
    assert slowed[touching].certificate.worst.name == WALLS
    assert slowed[touching].speed_factor == pytest.approx(slowed[far].speed_factor, rel=RESOLUTION)


def test_slowing_does_not_help_against_walls(make_profile):
    trajectory = Trajectory(PATH, make_profile(PATH.end, np.full(20, 0.3)), AIRFRAME)
    with pytest.raises(InfeasibleError, match="of the walls") as error:
        slow_until_certified(trajectory, LIMITS, Space(low=(-2.0, -2.0, 0.0), high=(2.0, 2.0, 2.0), margin=0.2))
    assert "2." in error.value.where
