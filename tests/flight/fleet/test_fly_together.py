"""The main process's side of a fleet: an order to brake or land waits for nothing."""

import contextlib
import multiprocessing
import select
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from unittest.mock import Mock

import pytest

from cfplan.errors import ExitCode, LinkError
from cfplan.flight.fleet.conductor import ConductedFlight, Conductor, FlightEnded
from cfplan.flight.fleet.fly_together import FleetOutcome, FleetPilot, fly_together
from cfplan.flight.pilot.conducted import ConductorMessage, PlanLeft
from cfplan.flight.pilot.keys import Keyboard, Order
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.pilot.process import PilotProcess
from cfplan.flight.telemetry import Event, Level

NAMES = ("left", "right")
IN_THE_AIR = [Event(1.0, Level.INFO, "in the air")]


@dataclass
class StillPilot:
    """A pilot's process that sends nothing by itself."""

    process: PilotProcess = field(init=False)
    orders: Connection = field(init=False)
    telemetry: Connection = field(init=False)

    def __post_init__(self):
        telemetry, self.telemetry = multiprocessing.Pipe(duplex=False)
        orders, self.orders = multiprocessing.Pipe()
        self.process = PilotProcess(Mock(exitcode=0), telemetry, orders, Mock())

    def hears(self, wanted):
        """Return once it has got a message that is wanted."""
        while True:
            assert self.orders.poll(60.0)
            if wanted(self.orders.recv()):
                return

    def noticed(self):
        """Return whether it knows that it is alone."""
        try:
            while self.orders.poll():
                self.orders.recv()
        except EOFError:
            return True
        return False

    def end(self):
        if not self.telemetry.closed:
            self.telemetry.send(LinkError("it is down"))


@pytest.fixture
def pilots():
    return {name: StillPilot() for name in NAMES}


@contextlib.contextmanager
def flying(pilots, **options):
    """Fly beside the block, at whose end the vehicles are down; yield the future outcome."""
    with ThreadPoolExecutor() as beside:
        flown = beside.submit(fly, pilots, **options)
        try:
            yield flown
        finally:
            for pilot in pilots.values():
                pilot.end()


def fly(pilots, conductor=None, keyboard=None, **options):
    flights = [ConductedFlight(name, (float(number), 0.0, 0.6), 0.0) for number, name in enumerate(NAMES)]
    return fly_together(
        [FleetPilot(flight, None, "", None, pilots[flight.name].process) for flight in flights],
        conductor or Conductor(flights, 0.3, 0.03),
        keyboard=keyboard or Keyboard(keys=False),
        **{"listen": lambda name, message: None} | options,
    )


def test_an_order_to_brake_waits_for_no_listener(pilots):
    hears, goes_on, heard = threading.Event(), threading.Event(), []

    def listen(name, message):
        hears.set()
        assert goes_on.wait(60.0)
        heard.append((name, message))

    with flying(pilots, listen=listen) as flown:
        pilots["left"].telemetry.send(IN_THE_AIR)
        assert hears.wait(60.0)
        pilots["left"].orders.send(PlanLeft(Rung.BRAKE, "late"))
        pilots["right"].hears(lambda message: isinstance(message, ConductorMessage) and message.brakes == "left: late")
        assert not heard
        goes_on.set()
    assert flown.result().brakes == "left: late"
    assert heard == [("left", IN_THE_AIR[0])]


@pytest.mark.parametrize("source", ["keyboard", "more_orders", "listen"])
def test_a_keyboard_or_a_listener_that_fails_lands_all(pilots, source):
    def fail(*_):
        raise ZeroDivisionError

    failing = Mock(orders=fail) if source == "keyboard" else fail
    with flying(pilots, **{source: failing}) as flown:
        pilots["left"].telemetry.send(IN_THE_AIR)
        for pilot in pilots.values():
            pilot.hears(lambda message: message is Order.LAND)
    with pytest.raises(ZeroDivisionError):
        flown.result()


def test_a_pilot_that_reads_nothing_keeps_no_order_from_the_others(pilots):
    stuck = pilots["left"].process.orders
    while select.select([], [stuck], [], 0.0)[1]:
        stuck.send("not read")
    orders = iter([[Order.CUT]])
    with flying(pilots, more_orders=lambda: next(orders, ())):
        pilots["right"].hears(lambda message: message is Order.CUT)
        pilots["left"].hears(lambda message: message is Order.CUT)  # once it reads


@pytest.mark.parametrize(
    ("code", "reason", "expected"),
    [
        (ExitCode.OK, "landed", ExitCode.ENDED_BY_SAFETY),
        (ExitCode.ENDED_BY_SAFETY, "the fleet brakes: b: it is 0.30 m from its place", ExitCode.ENDED_BY_SAFETY),
        (ExitCode.LINK_LOST, "the fleet brakes: b: it is late, then the link was lost", ExitCode.LINK_LOST),
        (ExitCode.ENDED_BY_OPERATOR, "the operator landed it", ExitCode.ENDED_BY_OPERATOR),
    ],
)
def test_a_fleet_that_had_to_brake_did_not_end_well_although_one_vehicle_had_landed(code, reason, expected):
    ends = {"a": FlightEnded(ExitCode.OK, "landed"), "b": FlightEnded(code, reason)}
    assert FleetOutcome({}, ends, "b: it is late", begins=0.0, nearest=1.0).exit_code is expected


@pytest.mark.parametrize("others", ["have ended", "hang too"])
def test_pilots_that_hang_are_killed_once_all_others_have_ended(pilots, others):
    for pilot in pilots.values():
        pilot.process.process.kill = pilot.telemetry.close
    with flying(pilots, hung_after=0.5) as flown:
        if others == "have ended":
            pilots["right"].end()
            pilots["right"].telemetry.close()
        ends = flown.result(60.0).ends
    assert "died" in ends["left"].reason
    assert ("died" in ends["right"].reason) is (others == "hang too")


def test_if_the_conductor_fails_all_pilots_notice_before_one_is_waited_for(pilots):
    noticed = []

    def join(_):
        noticed.extend(pilot.noticed() for pilot in pilots.values())

    for pilot in pilots.values():
        pilot.process.process.join = join
    with pytest.raises(ZeroDivisionError):
        fly(pilots, conductor=Mock(hear=Mock(), say=Mock(side_effect=ZeroDivisionError)))
    assert noticed == [True] * 4


def test_the_others_brake_before_the_exit_code_of_a_pilot_that_died_is_known(pilots):
    waits, goes_on = threading.Event(), threading.Event()

    def join(_):
        waits.set()
        assert goes_on.wait(60.0)

    pilots["left"].process.process.join = join
    with flying(pilots) as flown:
        pilots["left"].telemetry.close()
        pilots["right"].hears(lambda message: isinstance(message, ConductorMessage) and "died" in message.brakes)
        assert waits.wait(60.0)
        goes_on.set()
    assert "exit code" in flown.result().ends["left"].reason
