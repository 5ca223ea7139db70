"""Telemetry gets out when it can and never holds the pilot up."""

import multiprocessing
import select

import pytest
from waiting import until

from cfplan.flight.clock import REAL_CLOCK, SteppedClock
from cfplan.flight.pilot.keys import Order
from cfplan.flight.pilot.process import OrderReceiver
from cfplan.flight.pilot.reporter import Reporter
from cfplan.flight.telemetry import Event, Level


def event(number: int) -> Event:
    return Event(float(number), Level.INFO, "x" * 100)


@pytest.fixture
def pipe():
    reader, writer = multiprocessing.Pipe(duplex=False)
    yield reader, writer
    reader.close()
    writer.close()


def received(reader):
    messages, last = [], None
    while last is None:
        part = reader.recv()
        if isinstance(part, list):
            messages += part
        else:
            last = part
    return messages, last


def test_messages_go_out_in_batches_fifty_times_a_second(pipe):
    reader, writer = pipe
    clock = SteppedClock()
    report = Reporter(writer, clock=clock)
    clock.sleep(0.005)
    for number in range(200):
        report(event(number))
    assert not reader.poll()
    clock.sleep(0.02)
    assert reader.recv() == [event(number) for number in range(200)]
    clock.sleep(1.0)
    assert not reader.poll()


@pytest.mark.parametrize("clock", [REAL_CLOCK, SteppedClock()], ids=["real", "stepped"])
def test_every_message_arrives_in_order_and_the_last_word_is_last(pipe, clock):
    reader, writer = pipe
    report = Reporter(writer, clock=clock)
    for number in range(200):
        report(event(number))
    report.close("done")
    messages, last = received(reader)
    assert messages == [event(number) for number in range(200)]
    assert last == "done"
    assert report.dropped == 0


def test_a_reader_that_is_stuck_costs_the_oldest_messages_and_no_time(pipe):
    reader, writer = pipe
    report = Reporter(writer, capacity=500)

    def stuck():
        """Whether the pipe is full, in which the sending thread sticks with its next batch."""
        for _ in range(100):
            report(event(0))
        return not select.select([], [writer], [], 0)[1]

    assert until(stuck)
    before = report.dropped
    for number in range(1, 5001):
        report(event(number))
    assert report.dropped >= before + 4000  # all but a batch with the thread and a batch that waits
    messages = []
    while not messages or messages[-1] != event(5000):
        messages += reader.recv()
    assert messages[-500:] == [event(number) for number in range(4501, 5001)]


def test_a_reader_that_is_gone_is_no_error(pipe):
    reader, writer = pipe
    report = Reporter(writer)
    reader.close()
    for number in range(100):
        report(event(number))
    report.close("done")


def test_the_gravest_order_stays(pipe):
    reader, writer = pipe
    orders = OrderReceiver(reader)
    for order in (Order.LAND, Order.CUT, Order.LAND):
        writer.send(order)
    assert until(lambda: orders.worst is Order.CUT)
    assert not orders.gone


def test_a_connection_that_closes_here_while_it_is_read_is_no_traceback():
    class ClosedWhileRead:
        def recv(self):
            raise TypeError("'NoneType' object cannot be interpreted as an integer")

    orders = OrderReceiver(ClosedWhileRead())
    assert until(lambda: orders.gone)


def test_a_main_process_that_ends_is_noticed(pipe):
    reader, writer = pipe
    orders = OrderReceiver(reader)
    writer.close()
    assert until(lambda: orders.gone)
    assert orders.worst is None


def test_a_message_that_cannot_be_sent_costs_none_that_comes_later(pipe):
    reader, writer = pipe
    report = Reporter(writer)
    report(lambda: "no pickle")
    assert until(lambda: report.dropped == 1)
    report(event(1))
    report.close("done")
    assert received(reader) == ([event(1)], "done")
