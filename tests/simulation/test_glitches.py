"""A gap in setpoints, poses or both: against the dry run's own loop, and in limit cases."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from cfplan.flight.firmware import gains_for
from cfplan.flight.setpoints.packets import decode, encode
from cfplan.preparation.prepare_flight import prepare_mission
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.engine.flight import Conditions, EstimateErrors, fly_setpoints
from cfplan.simulation.engine.layout import hovering
from cfplan.simulation.glitches import (
    AFTERWARDS,
    CRITICAL_USAGE,
    GAP,
    KINDS,
    LATENCY,
    TURNED_OVER,
    WITHOUT_POSES_EVERY,
    glitch_at_every_setpoint,
    glitch_at_sampled_setpoints,
    glitch_near_critical_setpoints,
)
from studies.random_faults import PATIENT

REPOSITORY = Path(__file__).parents[2]
LATE = Conditions(estimate=EstimateErrors(latency=LATENCY))


@pytest.fixture(scope="module")
def limits():
    """Limits of a vehicle whose motors and thrust are known exactly, so that it flies alone."""
    return with_spread(load_limits(REPOSITORY / "safety.yaml"), thrust_scale=0.0, motor_time_constant=0.0)


def with_spread(limits, **spread):
    airframe = limits.airframe
    return replace(limits, airframe=replace(airframe, spread=replace(airframe.spread, **spread)))


@pytest.fixture(scope="module")
def line(limits):
    return prepare_mission(REPOSITORY / "flights" / "line.yaml", limits, PATIENT).payloads


@pytest.fixture(scope="module")
def found(line, limits):
    return glitch_at_every_setpoint(line, limits)


@pytest.mark.parametrize("number", [0, 57, 120, 301])
def test_a_gap_in_setpoints_does_what_the_dry_run_says_of_a_flight_with_that_gap(found, line, limits, number):
    rows = np.arange(len(line))
    held = np.where((rows > number) & (rows < number + round(100 * GAP)), number, rows)
    start = hovering(limits.airframe, decode(line).position[0])
    end = number / 100 + GAP + AFTERWARDS
    flown = fly_setpoints(decode(line[held]), rows / 100, limits.airframe, start, end, LATE)
    since = np.arange(10 * number, round(1000 * end))
    due = decode(line).position[np.minimum(since // 10, len(line) - 1)]
    off = np.linalg.norm(flown.position[since] - due, axis=1).max()
    x, y = flown.quaternion[since, 0], flown.quaternion[since, 1]
    assert found.deviation[0, number] == pytest.approx(off, rel=0.03, abs=0.005)
    assert found.tilt[0, number] == pytest.approx(np.arccos(1 - 2 * (x * x + y * y)).max(), abs=np.radians(2.0))


def test_without_poses_a_right_attitude_flies_on_as_the_dry_run_does(line, limits):
    found = glitch_at_every_setpoint(line, replace(limits, link_loss=replace(limits.link_loss, attitude_error=0.0)))
    start = hovering(limits.airframe, decode(line).position[0])
    seconds = GAP + AFTERWARDS
    end = len(line) / 100 + seconds
    flown = fly_setpoints(
        decode(line),
        np.arange(len(line)) / 100,
        limits.airframe,
        start,
        duration=end,
        conditions=LATE,
    )
    since = np.arange(round(1000 * end))
    off = np.linalg.norm(
        flown.position[since + 1] - decode(line).position[np.minimum(since // 10, len(line) - 1)], axis=1
    )
    x, y = flown.quaternion[since + 1, 0], flown.quaternion[since + 1, 1]
    tilt = np.arccos(1 - 2 * (x * x + y * y))
    for number in range(len(line)):
        some = slice(10 * number, 10 * number + round(1000 * seconds))
        assert found.deviation[1, number] == pytest.approx(off[some].max(), rel=1e-9)
        assert found.tilt[1, number] == pytest.approx(tilt[some].max(), rel=1e-6)


def test_a_flight_without_a_gap_stays_on_its_setpoints(line, limits):
    """It flies ahead by its speed times the lateness of its estimate."""
    without = glitch_at_every_setpoint(line, limits, gap=0.0)
    assert without.deviation.max() < 0.03 + limits.plan.speed * LATENCY
    assert not without.lost.any()


def test_the_longer_the_gap_the_farther_off(line, limits, found):
    longer = glitch_at_every_setpoint(line, limits, gap=0.3)
    assert longer.deviation[0].max() > 1.5 * found.deviation[0].max()
    assert found.deviation.shape == found.tilt.shape == found.lost.shape == (len(KINDS), len(line))


def test_without_poses_a_wrong_attitude_carries_the_vehicle_off(line, limits):
    def poses_missing(degrees):
        wrong = replace(limits, link_loss=replace(limits.link_loss, attitude_error=np.radians(degrees)))
        return glitch_at_every_setpoint(line, wrong).deviation[1]

    right, wrong = poses_missing(0.0), poses_missing(3.0)
    assert right.max() < 0.03 + limits.plan.speed * LATENCY
    assert 0.005 < (wrong - right).max() < 0.1  # 0.5 m/s² for 0.2 s is 1 cm, and 10 cm/s to be taken back


def test_between_setpoints_at_which_poses_stop_too_the_worse_one_counts(found, line):
    sampled = np.unique(np.append(np.arange(0, len(line), WITHOUT_POSES_EVERY), len(line) - 1))
    for kind, least in ((1, 0.0), (2, found.deviation[0])):
        assert np.all(found.deviation[kind] >= least)
        for first, last in pairwise(sampled):
            assert np.all(found.deviation[kind, first + 1 : last] >= found.deviation[kind, first])
            assert np.all(found.tilt[kind, first + 1 : last] >= found.tilt[kind, first])


def test_sampled_gaps_say_the_same_where_the_vehicle_is_nearly_lost_and_little_less_elsewhere(found, line, limits):
    sampled = glitch_at_sampled_setpoints(line, limits)
    assert sampled.deviation.max() == found.deviation.max()
    assert np.all(sampled.deviation > found.deviation - 0.1 * limits.flight.deviation.cut)
    cut = found.deviation.max() / 0.9  # then some are nearly lost
    strict = replace(limits, flight=replace(limits.flight, deviation=replace(limits.flight.deviation, cut=cut)))
    sampled = glitch_at_sampled_setpoints(line, strict)
    nearly = (np.fmax(found.deviation / cut, found.tilt / TURNED_OVER) > CRITICAL_USAGE + 0.15).any(axis=0)
    assert 0 < np.count_nonzero(nearly) < len(line)
    np.testing.assert_array_equal(sampled.deviation[:, nearly], found.deviation[:, nearly])
    np.testing.assert_array_equal(sampled.tilt[:, nearly], found.tilt[:, nearly])


def test_gaps_near_critical_setpoints_are_the_same_where_the_vehicle_is_nearly_lost(found, line, limits):
    cut = found.deviation.max() / 0.9
    strict = replace(limits, flight=replace(limits.flight, deviation=replace(limits.flight.deviation, cut=cut)))
    some = glitch_near_critical_setpoints(line, strict)
    nearly = (np.fmax(found.deviation / cut, found.tilt / TURNED_OVER) > CRITICAL_USAGE + 0.15).any(axis=0)
    assert 0 < np.count_nonzero(nearly) < len(line)
    np.testing.assert_array_equal(some.deviation[:, nearly], found.deviation[:, nearly])
    np.testing.assert_array_equal(some.tilt[:, nearly], found.tilt[:, nearly])
    lost = replace(
        strict, flight=replace(strict.flight, deviation=replace(strict.flight.deviation, cut=0.9 * cut / 1.1))
    )
    assert glitch_near_critical_setpoints(line, lost).lost.any()


@pytest.mark.parametrize("unknown", ["motor_time_constant", "thrust_scale"])
def test_where_the_vehicle_strays_a_slower_and_a_stronger_one_count_too(found, line, limits, unknown):
    worst = glitch_at_every_setpoint(line, with_spread(limits, **{unknown: 0.3}))
    strays = found.usage(limits).max(axis=0) >= 0.4
    assert 0 < np.count_nonzero(strays) < len(line)
    np.testing.assert_array_equal(worst.deviation[:, ~strays], found.deviation[:, ~strays])
    assert np.all(worst.deviation >= found.deviation)
    sampled = glitch_at_sampled_setpoints(line, with_spread(limits, **{unknown: 0.3}))
    assert sampled.deviation.max() == pytest.approx(worst.deviation.max(), abs=0.1 * limits.flight.deviation.cut)
    other = replace(limits.airframe, **{unknown: 1.3 * getattr(limits.airframe, unknown)})
    rows = np.arange(len(line))
    for number in rows[strays & (rows % WITHOUT_POSES_EVERY == 0)]:
        held = np.where((rows > number) & (rows < number + round(100 * GAP)), number, rows)
        end = number / 100 + GAP + AFTERWARDS
        flown = fly_setpoints(
            decode(line[held]), rows / 100, other, hovering(other, decode(line).position[0]), end,
            replace(LATE, gains=gains_for(limits.airframe)),
        )  # fmt: skip
        since = np.arange(10 * number, round(1000 * end))
        off = np.linalg.norm(
            flown.position[since] - decode(line).position[np.minimum(since // 10, len(line) - 1)], axis=1
        ).max()
        assert worst.deviation[0, number] > off - 0.005 - 0.03 * off


@pytest.mark.parametrize("count", [1, 2, 8, 30])
def test_flights_of_few_setpoints_have_gaps_too(line, limits, count):
    cut = replace(limits.flight.deviation, cut=0.01)  # the other vehicles fly, too
    strict = with_spread(replace(limits, flight=replace(limits.flight, deviation=cut)), thrust_scale=0.06)
    for simulate in (glitch_at_every_setpoint, glitch_at_sampled_setpoints, glitch_near_critical_setpoints):
        assert simulate(line[:count], strict).deviation.shape == (3, count)


def test_a_vehicle_that_turns_over_is_lost(line, limits):
    told = decode(line)
    told.body_rate[:, 0] += 9.0
    tumbling = glitch_at_every_setpoint(encode(told)[:120], limits)
    assert tumbling.lost.any()
    assert "it is lost" in str(tumbling)


def test_line_takes_a_gap(found):
    assert not found.lost.any()
    kind, number = found.worst
    assert f"{found.deviation[KINDS.index(kind), number]:.2f} m off" in str(found)
