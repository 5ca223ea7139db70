"""Where a vehicle goes after link loss: the quick loop against the whole virtual Crazyflie, and limit cases."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from link_loss_oracle import fly_on

from cfplan.flight.firmware import gains_for
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.setpoints.encoding import RATE, encode_motion
from cfplan.flight.setpoints.hover_to_hover import hover_to_hover
from cfplan.flight.setpoints.packets import FullStateSetpoints, decode, encode
from cfplan.flight.setpoints.rate_trade import ahead, gains_under
from cfplan.preparation.prepare_flight import prepare_mission
from cfplan.safety.limits import Limits
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.link_loss import (
    ALLOWANCE,
    TUBE_PART,
    foreseen_link_loss,
    link_loss_at_every_setpoint,
    link_loss_at_walls,
    link_loss_near_walls,
    link_loss_of_slow_motion,
    link_loss_tubes,
    link_loss_within_stops,
    simulate_link_loss,
)
from cfplan.vehicle.airframe import GRAVITY
from studies.blind_link_loss import measure as lose_link_and_poses
from studies.faults import SCENARIOS
from studies.stepped_flight import fly_stepped

REPOSITORY = Path(__file__).parents[2]
KILLED = next(row for row in SCENARIOS if row.name == "pilot killed")


@pytest.fixture(scope="module")
def limits():
    return load_limits(REPOSITORY / "safety.yaml")


@pytest.fixture(scope="module")
def unwatched(limits):
    """Without the watchdog the vehicle levels out for three times as long."""
    return replace(limits, firmware=replace(limits.firmware, watchdog=False))


def without_errors(limits: Limits, **changes) -> Limits:
    """A vehicle that has attitude, acceleration and velocity right."""
    right = {"attitude_error": 0.0, "vertical_acceleration_error": 0.0, "velocity_error": 0.0}
    return replace(limits, link_loss=replace(limits.link_loss, **right | changes))


@pytest.fixture(scope="module")
def line() -> Mission:
    return prepare_mission(REPOSITORY / "flights" / "line.yaml", load_limits(REPOSITORY / "safety.yaml"))


def straight(speed: float, seconds: float = 1.0) -> np.ndarray:
    """Along x from the middle of the room, at one speed."""
    time = np.arange(round(100 * seconds) + 1) / 100.0
    zero = np.zeros_like(time)
    return encode(
        FullStateSetpoints(
            position=np.stack([speed * (time - seconds), zero, zero + 1.0], axis=1),
            velocity=np.stack([zero + speed, zero, zero], axis=1),
            acceleration=np.zeros((len(time), 3)),
            quaternion=np.stack([zero, zero, zero, zero + 1.0], axis=1),
            body_rate=np.zeros((len(time), 3)),
        )
    )


def test_a_vehicle_that_hovers_comes_down_below_where_it_was(limits):
    lost = simulate_link_loss(straight(0.0), without_errors(limits))
    assert lost.distance < 0.05
    assert lost.beyond < -0.9
    assert "inside the walls" in str(lost)


def test_where_it_comes_down_is_the_same_in_a_room_whose_floor_is_lower(line, limits):
    (low, high), down = (limits.space.low, limits.space.high), np.array([0.0, 0.0, 1.0])
    lower = replace(limits, space=replace(limits.space, low=tuple(low - down), high=tuple(high - down)))
    state = decode(line.payloads)
    payloads = encode(replace(state, position=state.position - down))
    ours, theirs = simulate_link_loss(line.payloads, limits), simulate_link_loss(payloads, lower)
    assert (theirs.moment, theirs.beyond) == pytest.approx((ours.moment, ours.beyond), abs=1e-3)
    assert theirs.distance == pytest.approx(ours.distance, abs=1e-3) != 0.0
    rows = np.arange(0, len(payloads), 40)
    tubes = link_loss_tubes(line.payloads, limits, rows), link_loss_tubes(payloads, lower, rows)
    np.testing.assert_allclose(*tubes, atol=1e-3)


def test_the_faster_it_flies_the_farther_it_goes(limits):
    distances = [simulate_link_loss(straight(speed), limits).distance for speed in (0.5, 1.0, 1.5)]
    assert distances == sorted(distances)
    assert distances[0] > 0.05


def test_rates_in_the_last_packet_carry_it_away_and_the_watchdog_ends_that_sooner(line, limits, unwatched):
    told = decode(line.payloads)
    told.body_rate[:, 1] += 3.0
    lost = simulate_link_loss(encode(told)[:200], unwatched)
    assert lost.distance > 4.0
    assert simulate_link_loss(encode(told)[:200], limits).distance < lost.distance / 2


@pytest.mark.parametrize("lag", [0.07, 0.13])
@pytest.mark.parametrize(("watchdog", "off_after", "share"), [(True, 1040, 0.02), (False, 2040, 0.04)])
@pytest.mark.parametrize("rates", [(0.0, 0.0), (1.0, -2.5)], ids=["as sent", "with rates"])
def test_it_sweeps_what_a_whole_simulation_sweeps(line, limits, unwatched, rates, watchdog, off_after, share, lag):
    """4 ms steps and an attitude that stands still once settled, against steps of 1 ms to the floor.

    Unwatched it levels out for longer than its setpoints are meant for, and flies back.
    """
    airframe = replace(limits.airframe, motor_time_constant=lag)
    limits = replace(without_errors(limits if watchdog else unwatched, motor_lags=(lag,)), airframe=airframe)
    for last in (40, 171, 260, 390):
        told = decode(line.payloads)
        told.body_rate[last, :2] += rates
        sent = encode(told)
        found = link_loss_at_every_setpoint(sent, limits)
        alone = fly_on(sent, airframe, last, lag=lag, off_after=off_after)
        places = np.concatenate([alone, fly_on(sent, airframe, last, lag=lag, off_after=0)])
        far = np.ptp(places[:, :2], axis=0).max()
        assert found.low[last, :2] == pytest.approx(places.min(axis=0)[:2], abs=0.01 + share * far)
        assert found.high[last] == pytest.approx(places.max(axis=0), abs=0.01 + share * far)


@pytest.mark.parametrize("lag", [0.07, 0.13])
def test_a_vehicle_whose_motors_stop_at_once_falls_inside_the_box(line, limits, lag):
    """From 2 m/s, before it brakes, that takes it farther on than link loss does; the thrust fades while it falls."""
    airframe = replace(limits.airframe, motor_time_constant=lag)
    limits = replace(without_errors(limits, motor_lags=(lag,)), airframe=airframe)
    found = link_loss_at_every_setpoint(line.payloads, limits)
    fastest = int(np.abs(decode(line.payloads).velocity[:, 1]).argmax())
    for last in (40, fastest, 260, 330):
        fall = fly_on(line.payloads, airframe, last, lag=lag, off_after=0)
        assert np.all(found.low[last, :2] <= fall.min(axis=0)[:2] + 0.02)
        assert np.all(found.high[last] >= fall.max(axis=0) - 0.02)
    on = fly_on(line.payloads, airframe, fastest, lag=lag, off_after=1040)[:, 1]
    fall = fly_on(line.payloads, airframe, fastest, lag=lag, off_after=0)[:, 1]
    side, begin = np.sign(fall[-1] - fall[0]), fall[0]
    assert np.max(side * (fall - begin)) > np.max(side * (on - begin)) + 0.05
    reached = (found.high if side > 0 else found.low)[fastest, 1]
    assert reached == pytest.approx(fall[-1], abs=0.02)


def test_a_velocity_that_is_wrong_carries_it_to_all_sides(limits):
    """From hover at 1 m it is a second until the motors stop, and 0.45 s until it lies on the floor, less drag."""
    hover = straight(0.0)
    right, wrong = (
        link_loss_at_every_setpoint(hover, without_errors(limits, velocity_error=error)) for error in (0.0, 0.2)
    )
    aside = right.low[0] - wrong.low[0]
    assert aside == pytest.approx(wrong.high[0] - right.high[0])
    assert aside[2] == 0.0
    undamped = 0.2 * (1.04 + np.sqrt(2 * 1.0 / 9.81))
    assert 0.7 * undamped < aside[0] < undamped


def test_the_worst_of_all_motor_lags_counts(line, limits):
    def judged(*lags):
        alone = replace(limits.link_loss, motor_lags=lags)
        airframe = replace(limits.airframe, motor_time_constant=lags[0])
        return link_loss_at_every_setpoint(line.payloads, replace(limits, airframe=airframe, link_loss=alone))

    each, both = [judged(0.07), judged(0.13)], judged(0.07, 0.13)
    np.testing.assert_array_equal(both.low, np.minimum(each[0].low, each[1].low))
    np.testing.assert_array_equal(both.high, np.maximum(each[0].high, each[1].high))


def test_an_attitude_that_is_wrong_drifts_to_all_sides(unwatched):
    """Half a degree is 0.086 m/s² for two seconds, less the drag of what speed that makes."""
    wrong = replace(unwatched, link_loss=replace(unwatched.link_loss, attitude_error=np.radians(0.5)))
    right = replace(unwatched, link_loss=replace(unwatched.link_loss, attitude_error=0.0))
    hover = straight(0.0)
    with_error, without = (link_loss_at_every_setpoint(hover, each) for each in (wrong, right))
    aside = without.low[0] - with_error.low[0]
    assert aside == pytest.approx(with_error.high[0] - without.high[0])
    assert aside[2] == 0.0
    fall = np.sqrt(2 * 1.0 / 9.81)
    undamped = 0.5 * 0.0856 * 2.04**2 + 0.0856 * 2.04 * fall
    assert 0.7 * undamped < aside[0] < undamped


def test_the_drift_at_a_place_is_that_of_the_time_until_there(unwatched):
    """A vehicle that flies back is farthest out before it has drifted as far as it will."""
    wrong = without_errors(unwatched, attitude_error=np.radians(1.0))
    sent = straight(1.0)
    right, found = (
        link_loss_at_every_setpoint(sent, without_errors(unwatched)),
        link_loss_at_every_setpoint(sent, wrong),
    )
    at_end = GRAVITY * np.radians(1.0) * (2.04**2 / 2 + 2.04 * 0.45)  # less what drag takes
    assert 0.0 <= (right.low[-1] - found.low[-1])[0] < 0.05 * at_end  # behind it lies where it began
    assert 0.7 * at_end < (found.high[-1] - right.high[-1])[0] < at_end


def test_an_accelerometer_that_says_too_little_lifts_the_vehicle_and_one_that_says_too_much_counts_too(line, unwatched):
    def with_error(error):
        wrong = replace(unwatched.link_loss, vertical_acceleration_error=error)
        return link_loss_at_every_setpoint(line.payloads, replace(unwatched, link_loss=wrong))

    lifted, right, sunk = (with_error(error) for error in (0.1, 0.0, -0.1))
    rise = (lifted.high - right.high)[:, 2]
    assert rise[-1] == pytest.approx(0.5 * 0.1 * 2.04**2, rel=0.15)
    assert np.all((rise > 0.0) & (rise < 0.25))
    near = lifted.beyond > -0.1
    assert near.any()
    assert np.all(sunk.beyond[near] <= lifted.beyond[near] + 1e-9)
    assert np.all(sunk.beyond <= lifted.beyond + 0.02)


@pytest.mark.parametrize("speed", [0.8, -0.8])
def test_it_climbs_on_with_the_vertical_speed_of_its_last_setpoint(unwatched, speed):
    """Level-out keeps height and vertical speed of the setpoint: kp (z - z₀) = kd v ends kd/kp · v above it."""
    time = np.arange(101) / 100.0
    told = decode(straight(0.0))
    told.position[:, 2], told.velocity[:, 2] = 1.0 + speed * (time - 1.0), speed
    found = link_loss_at_every_setpoint(encode(told), without_errors(unwatched))
    places = fly_on(encode(told), unwatched.airframe, 100, lag=unwatched.airframe.motor_time_constant)
    assert found.high[100, 2] == pytest.approx(places[:, 2].max(), abs=0.02)
    if speed > 0:
        gains = gains_for(unwatched.airframe)
        assert found.high[100, 2] == pytest.approx(1.0 + gains.kd_z / gains.kp_z * speed, abs=0.06)


def test_it_says_which_wall(limits):
    found = link_loss_at_every_setpoint(straight(1.0, 2.0), limits)
    assert limits.space.faces[found.face[0]] == f"the wall x = {limits.space.low[0]:g} m"  # it begins 2 m to the left
    assert found.worst.beyond == found.beyond.max()
    assert found.worst.moment == found.time[np.argmax(found.beyond)]


@pytest.mark.parametrize("name", ["line", "loop3d", "slalom"])
@pytest.mark.parametrize("speed", [2.0, 3.0])
def test_what_may_end_near_a_wall_is_simulated_and_of_the_rest_is_known_how_far_it_ends_at_most(name, speed, limits):
    fast = replace(limits, plan=replace(limits.plan, speed=speed, acceleration=2.5 * speed))
    payloads = prepare_mission(REPOSITORY / "flights" / f"{name}.yaml", fast).payloads
    for within in (0.0, 0.45):
        all_of_them, found = link_loss_at_every_setpoint(payloads, fast), link_loss_near_walls(payloads, fast, within)
        assert found.worst == all_of_them.worst
        near = all_of_them.beyond > -within
        assert within == 0.0 or near.any()
        np.testing.assert_array_equal(found.beyond[near], all_of_them.beyond[near])
        np.testing.assert_array_equal(found.face[near], all_of_them.face[near])
        assert np.all(found.beyond >= all_of_them.beyond)
        assert np.all(found.beyond <= all_of_them.beyond + 2.5 * ALLOWANCE)
        np.testing.assert_array_equal(found.snapshots, all_of_them.snapshots)


@pytest.mark.parametrize("name", ["line", "scan"])
def test_whether_any_ends_beyond_a_wall_is_known_without_the_worst_moment(name, limits):
    """In the shipped room none does; in one whose walls are where the vehicle comes to, some do."""
    payloads = prepare_mission(REPOSITORY / "flights" / f"{name}.yaml", limits).payloads
    exact = link_loss_at_every_setpoint(payloads, limits)
    found = link_loss_at_walls(payloads, limits)
    assert exact.worst.beyond <= found.worst.beyond <= 0.0
    np.testing.assert_array_equal(found.snapshots, exact.snapshots)
    narrow = replace(limits.space, high=(*(exact.high[:, :2].max(axis=0) - 0.01), limits.space.high[2]))
    narrow = replace(limits, space=narrow)
    exact, found = link_loss_at_every_setpoint(payloads, narrow), link_loss_at_walls(payloads, narrow)
    assert found.worst == exact.worst
    assert found.worst.beyond > 0.0
    beyond = exact.beyond > 0.0
    np.testing.assert_array_equal(found.beyond[beyond], exact.beyond[beyond])
    assert np.all(foreseen_link_loss(payloads, narrow).beyond[beyond] > -ALLOWANCE)


def test_stops_from_a_flight_are_harmless_too(line, limits):
    limits, begin = without_errors(limits), np.arange(0, len(line.payloads), 10)
    flight = link_loss_at_every_setpoint(line.payloads, limits)
    forks = np.zeros((len(begin), line.stops.shape[1]), dtype=np.bool_)
    forks[:, ::8] = True
    within = link_loss_within_stops(line.stops[begin], flight.snapshots[:, begin], limits, forks)
    assert len(within.time) == forks.sum()
    assert within.worst.beyond < 0.0
    # A stop begins as the flight goes on, but brakes harder within its first setpoints.
    assert within.high[within.time == 0.0] == pytest.approx(flight.high[begin], abs=0.25)


@pytest.mark.parametrize("away", [0.2, 0.75, 3.0])
def test_slow_motion_looked_at_coarsely_is_what_a_whole_simulation_gives_and_near_a_wall_it_is_that(limits, away):
    edge = limits.space.low[0] + limits.space.margin
    for begin in (edge, edge + 1.0):
        motion = hover_to_hover((begin, 0.0, 0.5), 1.0, (begin + away, 0.0, 1.0), 0.0, max(1.5, 2.0 * away), RATE)
        payloads = encode_motion(motion, ahead(motion.acceleration, RATE), gains_under(limits), space=limits.space)
        found = link_loss_of_slow_motion(payloads, limits)
        whole = link_loss_at_every_setpoint(payloads, limits)
        assert found.worst.beyond == pytest.approx(whole.worst.beyond, abs=0.01)
    fast = hover_to_hover((edge + 1.0, 0.0, 0.5), 0.0, (edge, 0.0, 1.0), 0.0, 1.1, RATE)
    payloads = encode_motion(fast, ahead(fast.acceleration, RATE), gains_under(limits), space=limits.space)
    found, whole = link_loss_of_slow_motion(payloads, limits), link_loss_at_every_setpoint(payloads, limits)
    near = whole.beyond > -0.05
    assert near.any()
    np.testing.assert_array_equal(found.beyond[near], whole.beyond[near])


def test_setpoints_as_they_are_sent_are_harmless_when_they_stop(line, limits):
    lost = simulate_link_loss(line.payloads, limits)
    assert lost.beyond < 0.0
    assert lost.distance < 1.2


def test_a_tube_holds_the_vehicle_at_each_time_and_sweeps_what_the_whole_fall_sweeps(line, limits):
    rows = np.arange(0, len(line.payloads), 40)
    tubes, whole = link_loss_tubes(line.payloads, limits, rows), link_loss_at_every_setpoint(line.payloads, limits)
    low, high = tubes[..., 0, :].min(axis=(0, 2)), tubes[..., 1, :].max(axis=(0, 2))
    assert np.all(low <= whole.low[rows])
    assert np.all(high >= whole.high[rows])
    assert np.abs(low - whole.low[rows]).max() < 0.03  # the accelerometer that reads too much
    assert np.abs(high - whole.high[rows]).max() < 0.03
    assert not np.any(tubes[:, :, -1, 1, 2])  # it lies
    lag = limits.airframe.motor_time_constant
    for at in range(0, len(rows), 3):
        for tube, times in zip(tubes[:, at], ({"off_after": 0}, {"off_after": 1040}), strict=True):
            places = fly_on(line.payloads, limits.airframe, int(rows[at]), lag=lag, **times)
            part = np.minimum((np.arange(len(places)) + 1) // TUBE_PART, len(tube) - 1)
            assert np.all(places >= tube[part, 0] - 0.01)
            assert np.all(places <= tube[part, 1] + 0.01)
            assert np.all(places[-1, :2] >= tube[-1, 0, :2] - 0.01)
            assert np.all(places[-1, :2] <= tube[-1, 1, :2] + 0.01)


def test_the_virtual_crazyflie_goes_there_too(line, limits):
    moments = np.round(np.array([0.3, 0.5, 0.7]) * line.motion_ends, 2)
    right = link_loss_at_every_setpoint(line.payloads, without_errors(limits))
    for moment in moments:
        row = round(100 * moment)
        flown = fly_stepped(replace(KILLED, moment=float(moment)), line)
        alone = flown.truth.position[flown.truth.time >= flown.struck]
        # 0.2 m: its own estimate drifts so far without poses.
        assert np.all(alone.min(axis=0) > right.low[row] - 0.2)
        assert np.all(alone.max(axis=0) < right.high[row] + 0.2)
        lag = limits.airframe.motor_time_constant
        on = fly_on(line.payloads, limits.airframe, row, lag=lag, off_after=1040)
        assert alone[-1] == pytest.approx(on[-1], abs=0.2)


@pytest.mark.parametrize(("path", "knows_drag"), [("line", "yes"), ("circle", "no")])
def test_a_vehicle_that_flies_on_its_estimate_comes_down_near_the_swept_box(path, knows_drag):
    """Without the allowances of firmware that knows no drag it comes down 0.3 m off."""
    lost = lose_link_and_poses((REPOSITORY / "flights" / f"{path}.yaml", knows_drag, 5, 6))
    assert lost["most"] < 0.08
    assert lost["outside"] == 0
