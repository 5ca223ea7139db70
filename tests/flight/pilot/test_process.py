"""Messages between the pilot's process and the main process: orders wait for nothing, and faults are noticed."""

import multiprocessing
import pickle
import threading
from concurrent.futures import ThreadPoolExecutor
from unittest.mock import Mock

import numpy as np
import pytest
from waiting import until

from cfplan.errors import LinkError
from cfplan.flight.pilot.keys import Keyboard, Order
from cfplan.flight.pilot.process import OrderReceiver, PilotProcess, fly
from cfplan.flight.pilot.proposals import ReceivedProposals
from cfplan.flight.setpoints.commitment import Proposal
from cfplan.flight.setpoints.packets import PAYLOAD_SIZE
from cfplan.flight.telemetry import Event, Level


@pytest.mark.parametrize("message", [b"", b"no pickle", pickle.dumps("no order")[:-3], pickle.dumps("no order")])
def test_orders_that_cannot_be_read_count_as_a_main_process_that_ended(message):
    reader, writer = multiprocessing.Pipe(duplex=False)
    orders = OrderReceiver(reader)
    writer.send(Order.LAND)
    writer.send_bytes(message)
    assert until(lambda: orders.gone)
    assert orders.worst is Order.LAND


def test_a_proposal_whose_reading_fails_is_none_and_the_next_one_counts(monkeypatch):
    ours, theirs = multiprocessing.Pipe()
    payloads = np.zeros((1, PAYLOAD_SIZE), np.uint8)
    good = Proposal(0, 0, payloads, payloads[None], 0)

    def of_bytes(message):
        if message == b"huge":
            raise MemoryError
        return good

    monkeypatch.setattr(Proposal, "of_bytes", of_bytes)
    proposals = ReceivedProposals(ours)
    theirs.send_bytes(b"huge")
    theirs.send_bytes(b"good")
    assert until(lambda: proposals.newest() is good)


class StillPilot:
    """A pilot's process that sends nothing by itself; `orders` are those that it is given."""

    def __init__(self):
        telemetry, self.telemetry = multiprocessing.Pipe(duplex=False)
        self.orders, orders = multiprocessing.Pipe(duplex=False)
        self.process = PilotProcess(Mock(exitcode=0), telemetry, orders, Mock())

    def next_order(self):
        assert self.orders.poll(60.0)
        return self.orders.recv()


@pytest.fixture
def still_pilot():
    return StillPilot()


def fly_with(pilot: StillPilot, **listening):
    return fly(None, uri="", pose_source=None, pilot=pilot.process, keyboard=Keyboard(keys=False), **listening)


def test_a_pilot_that_hangs_is_killed(still_pilot):
    killed = []
    still_pilot.process.process.kill = lambda: (killed.append(True), still_pilot.telemetry.close())
    with pytest.raises(LinkError, match="died"):
        fly_with(still_pilot, hung_after=0.05)
    assert killed


def test_an_order_waits_for_no_listener(still_pilot):
    hears, goes_on, given = threading.Event(), threading.Event(), [Order.CUT]

    def listen(_):
        hears.set()
        assert goes_on.wait(60.0)

    def more_orders():
        return [given.pop()] if hears.is_set() and given else []

    with ThreadPoolExecutor() as beside:
        flown = beside.submit(fly_with, still_pilot, on_telemetry=listen, more_orders=more_orders)
        still_pilot.next_order()  # the mission
        still_pilot.telemetry.send([Event(1.0, Level.INFO, "in the air")])
        assert still_pilot.next_order() is Order.CUT
        assert not goes_on.is_set()
        goes_on.set()
        still_pilot.telemetry.send("ended")
        assert flown.result() == "ended"


def test_a_source_of_orders_that_fails_lands_the_vehicle(still_pilot):
    with ThreadPoolExecutor() as beside:
        flown = beside.submit(fly_with, still_pilot, more_orders=lambda: 1 / 0)
        still_pilot.next_order()  # the mission
        assert still_pilot.next_order() is Order.LAND
        still_pilot.telemetry.send("ended")
        with pytest.raises(ZeroDivisionError):
            flown.result()
