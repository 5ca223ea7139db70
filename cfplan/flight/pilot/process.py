"""The pilot's process, and the main process's side of it."""

import contextlib
import gc
import logging
import multiprocessing
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from types import TracebackType

from cfplan.errors import CfplanError, LinkError
from cfplan.flight.clock import REAL_CLOCK
from cfplan.flight.mocap.poses import PoseSource
from cfplan.flight.pilot.conducted import NO_CONDUCTOR, ConductorMessage, HeldConductor, PilotMessage
from cfplan.flight.pilot.keys import HeldOrders, Keyboard, Order
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.pilot.outcome import FlightOutcome
from cfplan.flight.pilot.pilot import Pilot
from cfplan.flight.pilot.proposals import ReceivedProposals
from cfplan.flight.pilot.reporter import Reporter
from cfplan.flight.radio.connection import connect
from cfplan.flight.real_time import STREAM_PRIORITY, lock_memory, shorten_time_slice, use_fifo_scheduling
from cfplan.flight.telemetry import Telemetry

_SWITCH_INTERVAL = 0.0001  # s, longest time until the stream gets the interpreter back
_THREAD_PRIORITY = STREAM_PRIORITY // 2
_POLL_PERIOD = 0.02  # s between two polls for orders that are not keys
HUNG = 180.0  # s without telemetry until a pilot's process is killed; it compiles and reads tables in less
LANDING_TIMEOUT = 60.0  # s for a pilot without a main process to land


@dataclass(frozen=True, slots=True)
class _Assignment:
    """The assignment that the pilot's process receives once its flight is prepared."""

    mission: Mission
    uri: str
    pose_source: PoseSource
    environment: Mapping[str, str]  # of the main process now: a lab started meanwhile is named there
    conducted: bool  # it is a vehicle of a fleet


class PilotProcess:
    """The pilot's process, which completes its imports before it is assigned a mission; a context manager."""

    def __init__(self, process: BaseProcess, telemetry: Connection, orders: Connection, proposals: Connection):
        self.process, self.telemetry = process, telemetry
        self.orders = orders  # also for messages to and from a fleet's conductor
        self.proposals = proposals  # for a planner's process: it sends proposals, and hears answers
        self._assigned = False

    def assign(self, mission: Mission, uri: str, pose_source: PoseSource, *, conducted: bool = False) -> None:
        """Start the flight, as a vehicle of a fleet if `conducted`. Raises LinkError if the process has died."""
        try:
            self.orders.send(_Assignment(mission, uri, pose_source, dict(os.environ), conducted))
        except OSError as why:
            raise pilot_died(self.process) from why
        self._assigned = True

    def close(self) -> None:
        """End the process: at once on the ground, in flight after its landing. May be called twice."""
        self.orders.close()  # if this end fails, the pilot notices and lands
        self.telemetry.close()
        self.proposals.close()
        self.process.join(LANDING_TIMEOUT if self._assigned else 0.0)
        if self.process.is_alive():
            self.process.kill()

    def __enter__(self) -> "PilotProcess":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def start_pilot(drivers: Sequence[type] = ()) -> PilotProcess:
    """Start the pilot's process, ahead of its mission. `drivers` are cflib link drivers tried before cflib's own."""
    context = multiprocessing.get_context("spawn")
    telemetry, telemetry_end = context.Pipe(duplex=False)
    orders_end, orders = context.Pipe()
    proposals_end, proposals = context.Pipe()
    process = context.Process(
        target=_run, args=(tuple(drivers), telemetry_end, orders_end, proposals_end), name="pilot"
    )
    with _signals_ignored():
        process.start()
    telemetry_end.close()
    orders_end.close()
    proposals_end.close()
    return PilotProcess(process, telemetry, orders, proposals)


def fly(
    mission: Mission,
    *,
    uri: str,
    pose_source: PoseSource,
    drivers: Sequence[type] = (),
    pilot: PilotProcess | None = None,
    on_telemetry: Callable[[Telemetry], None] = lambda _: None,
    more_orders: Callable[[], Iterable[Order]] = tuple,
    keyboard: Keyboard | None = None,
    hung_after: float = HUNG,
) -> FlightOutcome:
    """Fly a mission and return when the vehicle is down. Call from the main thread, so that Ctrl-C lands.

    `pilot` is a process that was started before, with `drivers`; without one it is started now. `pose_source` and
    `drivers` go there by pickle. `on_telemetry` gets every message, in order; what it raises is raised here after the
    vehicle has landed. `more_orders` returns the orders since its last call that came neither by key nor by signal; it
    is called in another thread, and must not wait. `keyboard` is one that was entered before; without one it is entered
    for the flight. A pilot that sends nothing for `hung_after`, s, is killed. Raises LinkError if the vehicle cannot be
    reached or the pilot's process dies, and what the pose source raises.
    """
    held = Keyboard() if keyboard is None else contextlib.nullcontext(keyboard)
    with held as entered, pilot or start_pilot(drivers) as started:
        started.assign(mission, uri, pose_source)
        attendant = Attendant(partial(_send, started.orders, threading.Lock()), entered, on_telemetry, more_orders)
        with _orders_passed(entered, attendant):
            return _attend(started, attendant, hung_after)


class Attendant:
    """The main process's side of a flight: it passes telemetry one way and orders the other.

    A listener or a source of orders that fails lands the vehicle, and its failure is raised when the flight has ended.
    """

    def __init__(
        self,
        give: Callable[[Order], None],
        keyboard: Keyboard,
        on_telemetry: Callable[[Telemetry], None],
        more_orders: Callable[[], Iterable[Order]],
    ):
        self._give, self._keyboard, self._on_telemetry, self._more_orders = give, keyboard, on_telemetry, more_orders
        self.failure: BaseException | None = None  # the first one of a listener or a source of orders

    def pass_orders(self) -> None:
        """Give the pilot the orders since the last call."""
        for source in (self._keyboard.orders, self._more_orders):
            try:
                for order in source():
                    self._give(order)
            except BaseException as error:  # the other source still counts
                self._fail(error)

    def tell(self, messages: Sequence[Telemetry]) -> None:
        """Pass messages to the listener, unless it has failed."""
        if self.failure is None:
            try:
                for message in messages:
                    self._on_telemetry(message)
            except BaseException as error:  # a fault here must not break the flight
                self._fail(error)

    def _fail(self, error: BaseException) -> None:
        if self.failure is None:
            self.failure = error
            self._give(Order.LAND)

    def conclude(self, last: FlightOutcome | CfplanError) -> FlightOutcome:
        """Return the outcome from the pilot's last message. Raises the failure, here or in the pilot."""
        if self.failure is not None:
            raise self.failure
        if isinstance(last, CfplanError):
            raise last
        return last


@contextlib.contextmanager
def _orders_passed(keyboard: Keyboard, attendant: Attendant) -> Iterator[None]:
    """Pass orders to the pilot in a thread during the block, so that no order waits for a listener."""
    ended = threading.Event()

    def pass_orders() -> None:
        while not ended.is_set():
            wait([keyboard.descriptor] if keyboard.descriptor is not None else [], _POLL_PERIOD)
            attendant.pass_orders()

    passing = threading.Thread(target=pass_orders, name="keys", daemon=True)
    passing.start()
    try:
        yield
    finally:
        ended.set()
        passing.join()


def _attend(pilot: PilotProcess, attendant: Attendant, hung_after: float) -> FlightOutcome:
    """Pass on the telemetry of a pilot's process until its last message."""
    while True:
        if not pilot.telemetry.poll(hung_after):
            pilot.process.kill()
        try:
            message = pilot.telemetry.recv()
        except (EOFError, OSError):
            raise pilot_died(pilot.process) from attendant.failure
        if not isinstance(message, list):
            return attendant.conclude(message)
        attendant.tell(message)


def pilot_died(process: BaseProcess) -> LinkError:
    process.join(5.0)
    return LinkError(
        f"the pilot's process died (exit code {process.exitcode})",
        hint="the vehicle levels out after 0.5 s without setpoints; its motors stop after 1 s (2 s without watchdog)",
    )


def _send(orders: Connection, lock: threading.Lock, order: Order) -> None:
    with lock, contextlib.suppress(OSError):  # a pilot that is gone shows in its telemetry
        orders.send(order)


@contextlib.contextmanager
def _signals_ignored():
    """Block the terminal's signals, so that a process started meanwhile never receives a Ctrl-C."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP, signal.SIGTSTP})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


class OrderReceiver(HeldOrders):
    """Orders of the main process to the pilot, read by a thread; `gone` once reading has ended, for any reason.

    Messages of a fleet's conductor come the same way, for `conductor`.
    """

    def __init__(self, connection: Connection, conductor: HeldConductor | None = None):
        super().__init__()
        self._connection, self._conductor = connection, conductor
        threading.Thread(target=self._run, name="orders", daemon=True).start()

    def _run(self) -> None:
        with contextlib.suppress(Exception):  # an invalid message ends it too: later ones cannot be trusted
            while True:
                message = self._connection.recv()
                if self._conductor is not None and isinstance(message, ConductorMessage):
                    self._conductor.give(message)
                else:
                    self.give(message)
        self.gone = True


def _run(
    drivers: tuple[type, ...], telemetry: Connection, orders_connection: Connection, proposals: Connection
) -> None:
    """Run the pilot's process, from its first line to its last."""
    with contextlib.suppress(OSError):
        os.setsid()  # the terminal's signals are for the main process
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTSTP):
        signal.signal(number, signal.SIG_IGN)
    logging.getLogger("cflib").setLevel(logging.CRITICAL)  # its warnings are reported as telemetry
    warnings.filterwarnings("ignore", module="cflib")
    try:
        assignment: _Assignment = orders_connection.recv()
    except (EOFError, OSError):
        os._exit(0)  # no flight
    os.environ.update(assignment.environment)
    uri = assignment.uri
    conductor = _conductor(orders_connection) if assignment.conducted else None
    orders, report = OrderReceiver(orders_connection, conductor), Reporter(telemetry)
    signal.signal(signal.SIGTERM, lambda *_: orders.give(Order.LAND))
    sys.setswitchinterval(_SWITCH_INTERVAL)
    last: FlightOutcome | CfplanError
    try:
        pilot = Pilot(
            assignment.mission,
            connect=lambda waiting: connect(uri, report, drivers, waiting=waiting),
            source=assignment.pose_source,
            report=report,
            orders=orders,
            enter_real_time=_enter_real_time,
            proposals=ReceivedProposals(proposals),
            conductor=conductor or NO_CONDUCTOR,
        )
        last = replace(pilot.fly(), telemetry_dropped=report.dropped)
    except CfplanError as error:
        last = error
    except Exception as error:  # before take-off, or if even the cut failed
        last = CfplanError(f"fault in the pilot: {error!r}", where=uri, hint="please report this")
    report.close(last)
    os._exit(0)  # cflib leaves threads that never end


def _conductor(connection: Connection) -> HeldConductor:
    """Return the conductor at the other end of a connection."""

    def tell(message: PilotMessage) -> None:
        with contextlib.suppress(OSError):  # a main process that is gone shows in its orders
            connection.send(message)

    return HeldConductor(tell, REAL_CLOCK.now)


def _enter_real_time() -> None:
    """Run in real time: no garbage collection, and scheduled before ordinary programs."""
    gc.collect()
    gc.freeze()
    gc.disable()
    with contextlib.suppress(OSError):
        # Other threads too: one that holds the interpreter while it waits for the processor delays the stream.
        for thread in map(int, os.listdir("/proc/self/task")):
            if not use_fifo_scheduling(_THREAD_PRIORITY, thread):
                shorten_time_slice(thread)
    use_fifo_scheduling()
    lock_memory()
