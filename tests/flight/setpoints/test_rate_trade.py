"""The trade of rates for attitude: exact, bounded, and braking where setpoints stop."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from cfplan.flight.setpoints.byte_check import check_bytes, harmless_rates
from cfplan.flight.setpoints.encoding import encode_trajectory
from cfplan.flight.setpoints.level_out import UNTIL_WATCHDOG
from cfplan.flight.setpoints.packets import FullStateSetpoints
from cfplan.flight.setpoints.rate_trade import (
    LEAN_MAX,
    TRADED_RATE_MAX,
    AttitudeGains,
    ahead,
    gains_under,
    trade_rates,
    turns_for,
)
from cfplan.planners.baselines.convex import plan_convex
from cfplan.planners.task import PlanningTask
from cfplan.planning.repair import repair
from cfplan.safety.limit_sets import BOXES, LIMIT_SETS
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.rotations import rotations_of
from studies.drawn_paths import random_path

GRAVITATION = np.array([0.0, 0.0, GRAVITY])


def motion_of(velocity, rate, thrust=9.0, rotvec=(0.3, -0.2, 1.0)) -> FullStateSetpoints:
    turn = Rotation.from_rotvec([rotvec])
    return FullStateSetpoints(
        position=np.zeros((1, 3)),
        velocity=np.array([velocity], dtype=float),
        acceleration=turn.apply([[0.0, 0.0, thrust]]) - GRAVITATION,
        quaternion=turn.as_quat(),
        body_rate=np.array([rate], dtype=float),
    )


vectors = arrays(float, 3, elements=st.floats(-5.0, 5.0))


@settings(deadline=None)
@given(vectors, vectors, st.floats(3.0, 15.0), arrays(float, 3, elements=st.floats(-1.0, 1.0)), vectors)
def test_torque_and_thrust_are_those_of_the_motion(velocity, rate, thrust, rotvec, coming):
    """Twice kR times the sine of the turn from the attitude believed, 7 ms old, and kw times the rates: written out."""
    motion = motion_of(velocity, rate, thrust, rotvec)
    sent = trade_rates(motion, coming[None])
    believed = Rotation.from_quat(motion.quaternion) * Rotation.from_rotvec([-0.007 * rate * (1.0, 1.0, 0.0)])
    turned = (believed.inv() * Rotation.from_quat(sent.quaternion)).as_rotvec()[0]
    size = np.linalg.norm(turned)
    sine = np.sin(size) / size * turned if size else turned
    torque = 2 * 70000.0 * sine[:2] + 20000.0 * sent.body_rate[0, :2]
    assert torque == pytest.approx(20000.0 * rate[:2], abs=1e-3)
    assert turned[2] == pytest.approx(0.0, abs=1e-9)
    force = sent.acceleration[0] + GRAVITATION
    assert force / np.linalg.norm(force) == pytest.approx(Rotation.from_quat(sent.quaternion).apply([0, 0, 1])[0])
    assert force @ Rotation.from_quat(motion.quaternion).as_matrix()[0, :, 2] == pytest.approx(thrust)
    assert sent.body_rate[0, 2] == rate[2]


@settings(deadline=None)
@given(vectors, vectors, vectors)
def test_rates_are_what_brakes_and_what_exceeds_the_most(velocity, rate, coming):
    motion = motion_of(velocity, rate)
    sent = trade_rates(motion, coming[None]).body_rate
    assert sent[:, :2] == pytest.approx(harmless_rates(motion, coming[None]), abs=0.51e-3)
    assert np.linalg.norm(rate[:2] - sent[0, :2]) <= TRADED_RATE_MAX + 1e-3
    excess = max(np.linalg.norm(rate[:2]) + UNTIL_WATCHDOG.rate_max - TRADED_RATE_MAX, 0.0)
    assert np.linalg.norm(sent[0, :2]) <= UNTIL_WATCHDOG.rate_max + excess + 1e-3


@settings(deadline=None)
@given(st.floats(-np.pi, np.pi), st.floats(0.1, 1.0), st.floats(-np.pi, np.pi))
def test_the_tilt_at_which_level_out_settles_brakes_the_speed_left(direction, speed, yaw):
    """That tilt turns the torque of the rate off: asin of the rate over 7 rad/s, about the axis of the rate."""
    velocity = speed * np.array([np.cos(direction), np.sin(direction), 0.0])
    sent = trade_rates(motion_of(velocity, (0.0, 0.0, 0.0), rotvec=(0.0, 0.0, yaw)), np.zeros((1, 3)))
    settled = Rotation.from_euler("z", yaw) * Rotation.from_matrix(rotations_of(turns_for(sent.body_rate[:, :2]))[0])
    axis = settled.apply([0.0, 0.0, 1.0])
    # All of the speed left, in the half second until the watchdog stops the motors.
    assert GRAVITY * axis[:2] / axis[2] == pytest.approx(-0.41 * velocity[:2] / 0.5, abs=2e-3)


tilts = st.floats(0.0, np.radians(57.0))
angles = st.floats(-np.pi, np.pi)


def leaning(tilt, direction, yaw, rate) -> FullStateSetpoints:
    """A motion at rest whose attitude leans by `tilt`."""
    lean = Rotation.from_rotvec(tilt * np.array([np.cos(direction), np.sin(direction), 0.0]))
    return motion_of((0.0, 0.0, 0.0), rate, rotvec=(lean * Rotation.from_euler("z", yaw)).as_rotvec())


def lean_of(sent: FullStateSetpoints) -> float:
    force = sent.acceleration[0] + GRAVITATION
    return float(np.arccos(force[2] / np.linalg.norm(force)))


@settings(deadline=None)
@given(tilts, angles, angles, vectors)
def test_thrust_that_is_sent_does_not_lean_too_far_and_nothing_else_is_held_back(tilt, direction, yaw, rate):
    motion = leaning(tilt, direction, yaw, rate)
    sent = trade_rates(motion, np.zeros((1, 3)))
    assert lean_of(sent) <= LEAN_MAX + 1e-3
    assert sent.body_rate[:, :2] == pytest.approx(harmless_rates(motion, np.zeros((1, 3))), abs=0.51e-3)
    kept = np.linalg.norm(sent.body_rate[0, :2])
    if lean_of(sent) < LEAN_MAX - 1e-3:
        assert kept == pytest.approx(max(np.linalg.norm(rate[:2]) - TRADED_RATE_MAX, 0.0), abs=1e-3)


@settings(deadline=None)
@given(tilts, angles, angles, vectors, vectors)
def test_rates_that_are_sent_change_steadily_with_the_motion(tilt, direction, yaw, rate, onward):
    """From one motion to another in small steps no rate jumps, also where the bounds of the trade begin to act."""
    share = np.linspace(0.0, 1.0, 20_000)[:, None]
    axis = np.concatenate([np.cos(direction + share), np.sin(direction + share), 0.0 * share], axis=1)
    turn = Rotation.from_rotvec(tilt * axis) * Rotation.from_euler("z", yaw)
    none = np.zeros((len(share), 3))
    motion = FullStateSetpoints(
        position=none, velocity=none, acceleration=9.0 * turn.as_matrix()[:, :, 2] - GRAVITATION,
        quaternion=turn.as_quat(), body_rate=rate + share * (onward - rate),
    )  # fmt: skip
    assert np.abs(np.diff(trade_rates(motion, none).body_rate, axis=0)).max() < 0.1


@pytest.mark.parametrize("count", [1, 7, 8, 63, 64, 65, 130])
def test_a_setpoint_does_not_depend_on_those_beside_it(count):
    """Wherever it lies among those that are computed at once; half of them may not be traded whole."""
    rng = np.random.default_rng(count)
    turns = [Rotation.from_rotvec(tilt * np.array([1.0, 0.0, 0.0])) for tilt in rng.uniform(0.0, LEAN_MAX + 0.2, count)]
    motion = FullStateSetpoints(
        *rng.uniform(-2.0, 2.0, (3, count, 3)), np.array([turn.as_quat() for turn in turns]),
        rng.uniform(-4.0, 4.0, (count, 3)),
    )  # fmt: skip
    coming = rng.uniform(-3.0, 3.0, (count, 3))
    together, harmless = trade_rates(motion, coming), harmless_rates(motion, coming)
    for n in range(count):
        one = FullStateSetpoints(*(getattr(motion, name)[n : n + 1] for name in FullStateSetpoints.__slots__))
        alone = trade_rates(one, coming[n : n + 1])
        for name in FullStateSetpoints.__slots__:
            np.testing.assert_array_equal(getattr(together, name)[n], getattr(alone, name)[0], err_msg=name)
        assert harmless[n] == pytest.approx(harmless_rates(one, coming[n : n + 1])[0], abs=1e-12)


def test_an_attitude_that_leans_as_far_itself_is_only_righted():
    """Roll by a rate that turns it on stays a rate; one that rights it is traded as ever."""
    on, back = (leaning(LEAN_MAX + 0.02, 0.0, 0.0, (rate, 0.0, 0.0)) for rate in (2.0, -2.0))
    assert trade_rates(on, np.zeros((1, 3))).body_rate[0] == pytest.approx([2.0, 0.0, 0.0])
    assert trade_rates(back, np.zeros((1, 3))).body_rate[0] == pytest.approx([0.0, 0.0, 0.0])


@settings(max_examples=12, deadline=None)
@given(st.sampled_from(sorted(BOXES)), st.integers(0, 100_000))
def test_bytes_of_fast_plans_along_random_paths_pass(box, seed):
    """At 5 m/s and 60° of tilt the whole of the rates does not fit into the attitude."""
    fast = LIMIT_SETS["simulation"]
    task = PlanningTask(random_path(seed, box), fast.airframe, fast.limits, 40)
    trajectory = repair(task, plan_convex(task).profile).trajectory
    assume(np.abs(trajectory.at(np.linspace(0.0, trajectory.duration, 500)).position).max() < 32.0)  # fits a packet
    check_bytes(encode_trajectory(trajectory), trajectory, fast.limits)


def test_a_hover_sends_no_rates():
    sent = trade_rates(motion_of((0, 0, 0), (0, 0, 0.5), 9.81, (0, 0, 2.0)), np.zeros((1, 3)))
    assert np.all(sent.body_rate == [0.0, 0.0, 0.5])
    assert sent.acceleration == pytest.approx(0.0, abs=1e-12)


def test_other_gains_make_other_turns():
    strong = AttitudeGains(kR_xy=140000.0)
    assert strong.full_rate == pytest.approx(14.0)
    assert turns_for(np.array([[3.5, 0.0]]))[0, 0] == pytest.approx(np.radians(30.0))
    assert turns_for(np.array([[7.0, 0.0]]), strong)[0, 0] == pytest.approx(np.radians(30.0))


def test_the_acceleration_ahead_is_that_of_fifteen_setpoints_later_and_the_last_holds():
    values = np.arange(40.0)[:, None] * np.ones(3)
    assert ahead(values, 100.0)[:, 0] == pytest.approx(np.minimum(np.arange(40) + 15, 39))


def test_without_the_watchdog_level_out_brakes_less_as_it_lasts_longer(limits):
    unwatched = replace(limits, firmware=replace(limits.firmware, watchdog=False))
    flying = motion_of((0.5, 0.0, 0.0), (0.0, 0.0, 0.0), rotvec=(0.0, 0.0, 0.0))
    watched, alone = (trade_rates(flying, np.zeros((1, 3)), gains_under(each)) for each in (limits, unwatched))
    assert 0.0 > alone.body_rate[0, 1] > watched.body_rate[0, 1]
    assert harmless_rates(flying, np.zeros((1, 3)), gains_under(unwatched)) == pytest.approx(
        alone.body_rate[:, :2], abs=0.51e-3
    )
