"""Dates of frames."""

import numpy as np
import pytest

from cfplan.flight.mocap.clock import FrameClock

RATE, LATENCY = 100.0, 0.01


def arrivals(count, *, jitter=0.004, drift=0.0, seed=1):
    """Frame numbers and when they came: at a steady rate, each late by a chance."""
    late = np.random.default_rng(seed).exponential(jitter, count)
    late[0] = 0.0
    return [(1000 + i, 50.0 + i / RATE * (1 + drift) + late[i]) for i in range(count)]


def test_late_arrival_does_not_move_the_date():
    clock = FrameClock(LATENCY)
    dates = np.array([clock.taken(received, number, RATE) for number, received in arrivals(1000)])
    expected = 50.0 - LATENCY + np.arange(1000) / RATE
    assert np.allclose(dates[210:400], expected[210:400], atol=2e-4)
    assert np.abs(dates - expected)[:200].max() > 0.01, "until the rate is proven, arrival counts"


def test_a_delay_that_begins_is_seen_as_age():
    clock = FrameClock(LATENCY)
    for number, received in arrivals(300):
        clock.taken(received, number, RATE)
    ages = [received + 0.2 - clock.taken(received + 0.2, number, RATE) for number, received in arrivals(600)[300:]]
    assert min(ages[:150]) > 0.2 + LATENCY - 1e-3


def test_a_delay_that_lasts_is_seen_until_long_after_any_landing():
    clock = FrameClock(LATENCY)
    for number, received in arrivals(300):
        clock.taken(received, number, RATE)
    late = [received + 0.2 - clock.taken(received + 0.2, number, RATE) for number, received in arrivals(6300)[300:]]
    assert min(late) > 0.17


def test_clocks_that_drift_apart_do_not_age_the_poses():
    for drift in (-1e-4, 1e-4):
        clock = FrameClock(LATENCY)
        errors = [
            received - LATENCY - clock.taken(received, number, RATE)
            for number, received in arrivals(60_000, jitter=0.0, drift=drift)
        ]
        assert min(errors) + 1e-9 >= 0.0
        assert max(errors) < 0.0005


@pytest.mark.parametrize("announced", [50.0, 200.0, 1000.0, 100.5])
def test_a_rate_that_the_numbers_do_not_count_at_is_not_believed(announced):
    clock = FrameClock(LATENCY)
    for number, received in arrivals(1000):
        assert clock.taken(received, number, announced) == pytest.approx(received - LATENCY)


def test_a_count_that_begins_anew_begins_a_new_clock():
    clock = FrameClock(LATENCY)
    clock.taken(50.0, 5000, RATE)
    assert clock.taken(60.0, 3, RATE) == pytest.approx(60.0 - LATENCY)


@pytest.mark.parametrize(("number", "rate"), [(None, RATE), (7, float("nan")), (7, 0.0)])
def test_without_numbers_or_rate_a_frame_was_just_taken(number, rate):
    assert FrameClock(LATENCY).taken(5.0, number, rate) == pytest.approx(5.0 - LATENCY)


def test_the_larger_of_configured_and_announced_latency_counts():
    assert FrameClock(0.010).taken(5.0, 1, RATE, 0.025) == pytest.approx(4.975)
    assert FrameClock(0.010).taken(5.0, 1, RATE, 0.002) == pytest.approx(4.990)
