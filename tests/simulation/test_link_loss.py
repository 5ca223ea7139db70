"""Where a vehicle goes after link loss: the quick loop against the whole virtual Crazyflie, and limit cases."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from link_loss_oracle import fly_on

from cfplan.flight.pilot.mission import Mission
from cfplan.flight.setpoints.packets import FullStateSetpoints, decode, encode
from cfplan.preparation.prepare_flight import prepare_mission
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.link_loss import (
    link_loss_at_every_setpoint,
    link_loss_of_stops,
    link_loss_of_transfer,
    simulate_link_loss,
    swept_after_link_loss,
)
from cfplan.studies.fault_scenarios import SCENARIOS
from cfplan.studies.faults import fly_stepped

REPOSITORY = Path(__file__).parents[2]
KILLED = next(row for row in SCENARIOS if row.name == "pilot killed")


@pytest.fixture(scope="module")
def limits():
    return load_limits(REPOSITORY / "safety.yaml")


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
    lost = simulate_link_loss(straight(0.0), limits)
    assert lost.distance < 0.05
    assert lost.beyond < -0.9
    assert "inside the walls" in str(lost)


def test_the_faster_it_flies_the_farther_it_goes(limits):
    distances = [simulate_link_loss(straight(speed), limits).distance for speed in (0.5, 1.0, 1.5)]
    assert distances == sorted(distances)
    assert distances[0] > 0.05


def test_roll_and_pitch_rates_in_the_last_packet_carry_it_away_and_the_watchdog_ends_that_sooner(line, limits):
    told = decode(line.payloads)
    told.body_rate[:, 1] += 3.0
    lost = simulate_link_loss(encode(told)[:200], limits)
    watching = replace(limits, firmware=replace(limits.firmware, watchdog=True))
    assert lost.distance > 4.0
    assert simulate_link_loss(encode(told)[:200], watching).distance < lost.distance / 2


@pytest.mark.parametrize("lag", [0.07, 0.13])
@pytest.mark.parametrize("rates", [(0.0, 0.0), (1.0, -2.5)], ids=["as sent", "with rates"])
def test_it_sweeps_what_a_whole_simulation_sweeps(line, limits, rates, lag):
    """4 ms steps and an attitude that stands still once settled, against steps of 1 ms to the floor."""
    alone = replace(limits.link_loss, motor_lags=(lag,), attitude_error=0.0)
    airframe = replace(limits.airframe, motor_time_constant=lag)
    limits = replace(limits, airframe=airframe, link_loss=alone)
    for last in (40, 171, 260, 390):
        told = decode(line.payloads)
        told.body_rate[last, :2] += rates
        sent = encode(told)
        found = link_loss_at_every_setpoint(sent, limits)
        places = fly_on(sent, airframe, last, lag=lag)
        far = np.ptp(places[:, :2], axis=0).max()
        assert found.low[last, :2] == pytest.approx(places.min(axis=0)[:2], abs=0.01 + 0.02 * far)
        assert found.high[last] == pytest.approx(places.max(axis=0), abs=0.01 + 0.02 * far)


def test_the_worst_of_all_motor_lags_counts(line, limits):
    def judged(*lags):
        alone = replace(limits.link_loss, motor_lags=lags)
        airframe = replace(limits.airframe, motor_time_constant=lags[0])
        return link_loss_at_every_setpoint(line.payloads, replace(limits, airframe=airframe, link_loss=alone))

    each, both = [judged(0.07), judged(0.13)], judged(0.07, 0.13)
    np.testing.assert_array_equal(both.low, np.minimum(each[0].low, each[1].low))
    np.testing.assert_array_equal(both.high, np.maximum(each[0].high, each[1].high))


def test_an_attitude_that_is_wrong_drifts_to_all_sides(limits):
    """Half a degree is 0.086 m/s² for two seconds, less the drag of what speed that makes."""
    wrong = replace(limits, link_loss=replace(limits.link_loss, attitude_error=np.radians(0.5)))
    right = replace(limits, link_loss=replace(limits.link_loss, attitude_error=0.0))
    hover = straight(0.0)
    with_error, without = (link_loss_at_every_setpoint(hover, each) for each in (wrong, right))
    aside = without.low[0] - with_error.low[0]
    assert aside == pytest.approx(with_error.high[0] - without.high[0])
    assert aside[2] == 0.0
    fall = np.sqrt(2 * 1.0 / 9.81)
    undamped = 0.5 * 0.0856 * 2.04**2 + 0.0856 * 2.04 * fall
    assert 0.7 * undamped < aside[0] < undamped


def test_it_says_which_wall(limits):
    found = link_loss_at_every_setpoint(straight(1.0, 2.0), limits)
    assert found.name_of_wall(0, limits) == f"the wall x = {limits.space.low[0]:g} m"  # it begins 2 m to the left
    assert found.worst.beyond == found.beyond.max()
    assert found.worst.moment == found.time[np.argmax(found.beyond)]


def test_stops_from_a_flight_are_harmless_too(line, limits):
    flight = link_loss_at_every_setpoint(line.payloads, limits)
    every = link_loss_of_stops(line.payloads, line.stops, limits, every=10, each=8)
    assert len(every.time) == 11 * len(range(0, len(line.payloads), 10))
    assert every.worst.beyond < 0.0
    first = np.flatnonzero(np.isin(every.time, flight.time) & (np.arange(len(every.time)) % 11 == 0))
    rows = np.round(every.time[first] * 100).astype(int)
    # A stop begins as the flight goes on, but brakes harder within its first setpoints.
    assert every.high[first] == pytest.approx(flight.high[rows], abs=0.25)


@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_take_off_and_the_way_to_the_start_are_harmless_from_corner_to_corner(limits, yaw):
    space, height = limits.space, limits.ground.take_off_height
    x, y = np.add(space.low, space.margin)[:2].tolist()
    far_x, far_y = np.subtract(space.high, space.margin)[:2].tolist()
    corners = (x, y, height), (far_x, far_y, space.high[2] - space.margin)
    across = np.linalg.norm(np.subtract(*corners)) / limits.ground.go_to_speed
    for begin, end, duration in (
        ((x, y, 0.0), corners[0], height / limits.ground.take_off_speed),
        (*corners, across),
        (*corners[::-1], across),
    ):
        found = link_loss_of_transfer(begin, 0.0, end, yaw, max(float(duration), 1.5), limits)
        assert found.worst.beyond < 0.0, (begin, end, found.worst)


def test_setpoints_as_they_are_sent_are_harmless_when_they_stop(line, limits):
    lost = simulate_link_loss(line.payloads, limits)
    assert lost.beyond < 0.0
    assert lost.distance < 1.2


def test_the_virtual_crazyflie_goes_there_too(line, limits):
    moments = np.round(np.array([0.3, 0.5, 0.7]) * line.motion_ends, 2)
    places, swept = swept_after_link_loss(line.payloads, limits, moments)
    for moment, place, box in zip(moments, places, swept, strict=True):
        flown = fly_stepped(replace(KILLED, moment=float(moment)), line)
        alone = flown.truth.position[flown.truth.time >= flown.struck]
        # 0.35 m: its own estimate drifts so far in two seconds without poses.
        assert alone.min(axis=0) == pytest.approx(box[0], abs=0.35)
        assert alone.max(axis=0) == pytest.approx(box[1], abs=0.35)
        assert np.abs(box - place)[:, 1].max() < 1.1
