"""Setpoints sampled by the clock, and the deadlines they are sent at."""

import numpy as np
import pytest

from cfplan.flight.clock import SteppedClock
from cfplan.flight.pilot.deadlines import Deadlines, Lateness
from cfplan.flight.pilot.stream import Stream
from cfplan.flight.setpoints.packets import decode


@pytest.fixture
def payloads(mission):
    return mission.payloads


def test_the_setpoint_is_that_of_the_moment(payloads):
    stream = Stream(payloads, 100.0, start=50.0)
    assert stream.index(49.0) == 0
    assert stream.index(50.0) == 0
    assert stream.index(51.004) == 100
    assert stream.index(51.006) == 101
    assert stream.index(99.0) == len(payloads) - 1


def test_the_packet_carries_the_payload_to_the_generic_commander(payloads):
    stream = Stream(payloads, 100.0)
    assert stream.packet(7) == b"\x7c" + payloads[7].tobytes()


def test_the_reference_between_setpoints_is_between_them(payloads):
    stream = Stream(payloads, 100.0, start=50.0)
    places = decode(payloads).position
    assert stream.position(51.0) == pytest.approx(places[100])
    assert stream.position(51.005) == pytest.approx((places[100] + places[101]) / 2)
    assert stream.position(49.0) == pytest.approx(places[0])
    assert stream.position(60.0) == pytest.approx(places[-1])


def test_deadlines_do_not_drift_when_every_sleep_is_long():
    clock = SteppedClock(10.0, lambda end: clock.reach(end + 0.002))
    deadlines = Deadlines(100.0, clock)
    due = [deadlines.wait() for _ in range(500)]
    assert due == pytest.approx(10.0 + np.arange(1, 501) / 100.0)
    assert deadlines.skipped == 0


def test_a_stall_skips_deadlines_and_keeps_the_schedule():
    clock = SteppedClock(10.0)
    deadlines = Deadlines(100.0, clock)
    deadlines.wait()
    clock.sleep(0.2)
    due = deadlines.wait()
    assert due <= clock.now()
    assert clock.now() - due < 0.0101
    assert (due - 10.0) * 100.0 == pytest.approx(round((due - 10.0) * 100.0))
    assert deadlines.skipped in (18, 19)


def test_lateness_of_nothing_is_zero():
    assert Lateness.of([], 0) == Lateness(0.0, 0.0, 0.0, 0, 0)
