"""Fly a fleet in real time: one process a pilot, and the conductor in the main process.

The main process passes everything that pilots say to the conductor and to a listener, and the conductor's messages and
the operator's orders to the pilots. The listener has its own thread, so the conductor never waits for what is printed
or written. If the main process dies or this loop fails, all pilots notice at once and land.
"""

import contextlib
import select
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from queue import SimpleQueue

from cfplan.errors import CfplanError, ExitCode
from cfplan.flight.clock import REAL_CLOCK
from cfplan.flight.fleet.conductor import ConductedFlight, Conductor, FlightEnded, Stage
from cfplan.flight.mocap.poses import PoseSource
from cfplan.flight.pilot.conducted import ConductorMessage, PilotMessage
from cfplan.flight.pilot.keys import Keyboard, Order
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.pilot.outcome import FlightOutcome
from cfplan.flight.pilot.process import HUNG, PilotProcess, pilot_died
from cfplan.flight.telemetry import Telemetry

_PERIOD = 0.005  # s between looks of the conductor, if nothing comes meanwhile
_BEAT = 0.05  # s between messages of the conductor that say nothing new; pilots brake after CONDUCTOR_SILENT without

Listen = Callable[[str, Telemetry], None]


@dataclass(frozen=True, slots=True)
class FleetPilot:
    """A vehicle that is to fly, and the process of its pilot."""

    flight: ConductedFlight
    mission: Mission
    uri: str
    pose_source: PoseSource
    process: PilotProcess


@dataclass(frozen=True, slots=True)
class FleetOutcome:
    """How a flight of a fleet ended, each by the names of the vehicles."""

    outcomes: dict[str, FlightOutcome]  # of pilots that ended in order
    ends: dict[str, FlightEnded]
    brakes: str  # why the conductor let all brake; empty where it did not
    begins: float  # s on the flight's clock, when the fleet's clock was at 0; infinity where it never was
    nearest: float  # m between the columns of two vehicles in the air, as measured

    @property
    def exit_code(self) -> ExitCode:
        """Return the worst exit code of vehicles that ended for their own reasons; the others braked with them."""
        own = [end.exit_code for end in self.ends.values() if not _only_braked(end.reason)]
        if not own and not any(outcome.first_setpoint for outcome in self.outcomes.values()):
            return ExitCode.PREFLIGHT
        worst = max(own, default=ExitCode.ENDED_BY_SAFETY)
        return ExitCode.ENDED_BY_SAFETY if worst is ExitCode.OK and self.brakes else worst


def _only_braked(reason: str) -> bool:
    """Return whether a vehicle ended its flight because the fleet braked, and for no graver reason afterwards."""
    return reason.startswith("the fleet brakes") and ", then " not in reason  # by which a pilot joins its reasons


def fly_together(
    pilots: Sequence[FleetPilot],
    conductor: Conductor,
    *,
    listen: Listen,
    keyboard: Keyboard,
    more_orders: Callable[[], Iterable[Order]] = tuple,
    hung_after: float = HUNG,
) -> FleetOutcome:
    """Fly missions as their conductor allows, and return when all vehicles are down.

    `listen` gets every message of every pilot, in order, in another thread. The keyboard is one that was entered in the
    main thread, so that Ctrl-C lands all. `more_orders` returns the orders since its last call that came neither by key
    nor by signal. If one of these three raises, all land, and the first exception is raised here afterwards. Pilots
    are killed if none of those that remain has sent anything for `hung_after`, s.
    """
    fleet = _Fleet(pilots, conductor, listen)
    with contextlib.ExitStack() as flight:
        flight.enter_context(fleet.listening())
        for pilot in pilots:
            flight.enter_context(pilot.process)
        flight.callback(fleet.release)  # runs first: all pilots notice before any of them is waited for
        for pilot in pilots:
            pilot.process.assign(pilot.mission, pilot.uri, pilot.pose_source, conducted=True)
        while conductor.stage is not Stage.ENDED:
            fleet.take_orders(keyboard.orders)
            fleet.take_orders(more_orders)
            fleet.pass_on()
            fleet.end_hung_pilots(hung_after)
    if fleet.failure is not None:
        raise fleet.failure
    return FleetOutcome(fleet.outcomes, fleet.ends, conductor.brakes, conductor.begins, conductor.nearest)


class _Fleet:
    """The main process's side of the pilots' connections."""

    def __init__(self, pilots: Sequence[FleetPilot], conductor: Conductor, listen: Listen):
        self._pilots = {pilot.flight.name: pilot for pilot in pilots}
        self._conductor, self._listen = conductor, listen
        self._said: dict[str, tuple[ConductorMessage, float]] = {}  # what each was told last, and when, s
        self.outcomes: dict[str, FlightOutcome] = {}
        self.ends: dict[str, FlightEnded] = {}
        self._orders = {name: deque[Order]() for name in self._pilots}  # that a pilot does not have yet
        self._news: SimpleQueue[tuple[str, Telemetry] | None] = SimpleQueue()  # for the listener; None ends it
        self.failure: BaseException | None = None  # the first one of the listener or a source of orders
        self._begun = REAL_CLOCK.now()

    @contextlib.contextmanager
    def listening(self) -> Iterator[None]:
        """Let the listener hear of all news in its thread; at the end, wait until it has."""
        thread = threading.Thread(target=self._tell_listener, name="listener")
        thread.start()
        try:
            yield
        finally:
            self._news.put(None)
            thread.join()

    def _tell_listener(self) -> None:
        while (news := self._news.get()) is not None:
            if self.failure is None:
                try:
                    self._listen(*news)
                except BaseException as error:  # a fault here must not break the flight
                    self._fail(error)

    def take_orders(self, source: Callable[[], Iterable[Order]]) -> None:
        """Take the orders that a source returns."""
        try:
            self._order(*source())
        except BaseException as error:  # the other source still counts
            self._fail(error)

    def _order(self, *orders: Order) -> None:
        for waiting in self._orders.values():
            waiting.extend(orders)

    def _fail(self, error: BaseException) -> None:
        if self.failure is None:
            self.failure = error
            self._order(Order.LAND)

    def release(self) -> None:
        """Let all pilots notice that they are alone; those that still fly land."""
        for pilot in self._pilots.values():
            pilot.process.orders.close()

    def pass_on(self) -> None:
        """Pass on orders, and what has come from pilots, at most after a moment."""
        for name, waiting in self._orders.items():
            while waiting and self._send(name, waiting[0]):
                waiting.popleft()
        ready = set(wait([connection for _, connection in self._connections()], _PERIOD))
        for name, connection in self._connections():
            if connection in ready and name not in self.ends:
                self._take(name, connection)
        self._conduct(REAL_CLOCK.now())

    def end_hung_pilots(self, silence: float) -> None:
        """Kill the remaining pilots after `silence`, s, without a message of any; their vehicles are down by then."""
        last = [name for name in self._pilots if name not in self.ends]
        heard = max([self._begun, *(self._conductor.heard(name) for name in last)])
        if REAL_CLOCK.now() - heard > silence:
            for name in last:
                self._pilots[name].process.process.kill()  # its end is noticed like that of any process

    def _connections(self) -> Iterator[tuple[str, Connection]]:
        """Yield the connections of pilots that have not ended: what they ask of the conductor, then telemetry."""
        for name, pilot in self._pilots.items():
            if name not in self.ends:
                yield name, pilot.process.orders
                yield name, pilot.process.telemetry

    def _take(self, name: str, connection: Connection) -> None:
        """Take a message of a pilot, or notice that its process has died."""
        process = self._pilots[name].process
        try:
            message = connection.recv()
        except (EOFError, OSError):
            if connection is process.telemetry:  # that of orders closes first when it ends
                self._tell_conductor(name, FlightEnded(ExitCode.LINK_LOST, "its pilot's process died"))
                died = pilot_died(process.process)  # waits for the exit code
                self._end(name, FlightEnded(died.exit_code, str(died)))
            else:
                wait([process.telemetry], _PERIOD)
            return
        if connection is process.orders:
            self._tell_conductor(name, message)
        elif isinstance(message, list):
            now = REAL_CLOCK.now()
            for each in message:
                self._conductor.hear(name, each, now)
                self._news.put((name, each))
        elif isinstance(message, FlightOutcome):
            self.outcomes[name] = message
            self._end(name, FlightEnded(message.exit_code, message.reason))
        elif isinstance(message, CfplanError):
            self._end(name, FlightEnded(message.exit_code, str(message)))

    def _end(self, name: str, end: FlightEnded) -> None:
        self.ends[name] = end
        self._tell_conductor(name, end)

    def _tell_conductor(self, name: str, message: PilotMessage | FlightEnded) -> None:
        """Pass on a message that may let all brake, and the orders that follow from it."""
        now = REAL_CLOCK.now()
        self._conductor.hear(name, message, now)
        self._conduct(now)

    def _conduct(self, now: float) -> None:
        """Tell each pilot what is new, or that the conductor is alive."""
        for name, message in self._conductor.say(now).items():
            before = self._said.get(name)
            due = before is None or before[0] != message or now - before[1] > _BEAT
            if due and self._send(name, message):
                self._said[name] = message, now

    def _send(self, name: str, message: Order | ConductorMessage) -> bool:
        """Send a message, and return True; return False where the pilot's pipe is full, as sending would block."""
        orders = self._pilots[name].process.orders
        with contextlib.suppress(OSError):  # a pilot that is gone is noticed by its telemetry
            if not select.select([], [orders], [], 0.0)[1]:
                return False
            orders.send(message)
        return True
