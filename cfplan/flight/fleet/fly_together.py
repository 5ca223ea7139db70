"""Fly a fleet in real time: one process a pilot, and the conductor in the main process.

The main process passes everything that pilots say to the conductor and to listeners, and the conductor's messages and
the operator's orders to the pilots. If it dies, each pilot notices and lands.
"""

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait

from cfplan.errors import CfplanError, ExitCode
from cfplan.flight.clock import REAL_CLOCK
from cfplan.flight.fleet.conductor import ConductedFlight, Conductor, FlightEnded, Stage
from cfplan.flight.mocap.poses import PoseSource
from cfplan.flight.pilot.conducted import ConductorMessage
from cfplan.flight.pilot.keys import Keyboard, Order
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.pilot.outcome import FlightOutcome
from cfplan.flight.pilot.process import PilotProcess, pilot_died
from cfplan.flight.telemetry import Telemetry

_PERIOD = 0.005  # s between looks of the conductor, if nothing comes meanwhile
_BEAT = 0.1  # s between messages of the conductor that say nothing new; pilots brake after 1 s without any

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
    begins: float  # s on the clock of time.monotonic(), when the fleet's clock was at 0; infinity where it never was
    nearest: float  # m between the columns of two vehicles in the air, as measured

    @property
    def exit_code(self) -> ExitCode:
        """Return the worst of those that ended for their own reason; the others braked with them."""
        own = [end.exit_code for end in self.ends.values() if not end.reason.startswith(_BRAKES_WITH)]
        if not own and not any(outcome.first_setpoint for outcome in self.outcomes.values()):
            return ExitCode.PREFLIGHT
        return max(own, default=ExitCode.ENDED_BY_SAFETY)


_BRAKES_WITH = "the fleet brakes"


def fly_together(
    pilots: Sequence[FleetPilot],
    conductor: Conductor,
    *,
    listen: Listen,
    keyboard: Keyboard,
    more_orders: Callable[[], Iterable[Order]] = tuple,
) -> FleetOutcome:
    """Fly missions as their conductor allows, and return when all vehicles are down.

    `listen` gets every message of every pilot, in order; what it raises is raised here after all have landed. The
    keyboard is one that was entered in the main thread, so that Ctrl-C lands all. `more_orders` returns the orders
    since its last call that came neither by key nor by signal.
    """
    fleet = _Fleet(pilots, conductor, listen)
    with contextlib.ExitStack() as processes:
        for pilot in pilots:
            processes.enter_context(pilot.process)
            pilot.process.assign(pilot.mission, pilot.uri, pilot.pose_source, conducted=True)
        while conductor.stage is not Stage.ENDED:
            fleet.pass_on([*keyboard.orders(), *more_orders()])
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
        self.failure: BaseException | None = None  # of the listener

    def pass_on(self, orders: Iterable[Order]) -> None:
        """Pass on orders, and what has come from pilots, at most after a moment."""
        for order in orders:
            self._order(order)
        ready = set(wait([connection for _, connection in self._connections()], _PERIOD))
        for name, connection in self._connections():
            if connection in ready and name not in self.ends:
                self._take(name, connection)
        self._conduct(REAL_CLOCK.now())

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
                died = pilot_died(process.process)
                self._end(name, FlightEnded(died.exit_code, str(died)))
            else:
                wait([process.telemetry], _PERIOD)
            return
        if connection is process.orders:
            self._conductor.hear(name, message, REAL_CLOCK.now())
        elif isinstance(message, list):
            self._hear(name, message)
        elif isinstance(message, FlightOutcome):
            self.outcomes[name] = message
            self._end(name, FlightEnded(message.exit_code, message.reason))
        elif isinstance(message, CfplanError):
            self._end(name, FlightEnded(message.exit_code, str(message)))

    def _hear(self, name: str, messages: list[Telemetry]) -> None:
        now = REAL_CLOCK.now()
        for message in messages:
            self._conductor.hear(name, message, now)
            if self.failure is None:
                try:
                    self._listen(name, message)
                except BaseException as error:  # a fault here must not break the flight
                    self.failure = error
                    self._order(Order.LAND)

    def _end(self, name: str, end: FlightEnded) -> None:
        self.ends[name] = end
        self._conductor.hear(name, end, REAL_CLOCK.now())

    def _order(self, order: Order) -> None:
        for name in self._pilots:
            self._send(name, order)

    def _conduct(self, now: float) -> None:
        """Tell each pilot what is new, or that the conductor is alive."""
        for name, message in self._conductor.say(now).items():
            before = self._said.get(name)
            if before is None or before[0] != message or now - before[1] > _BEAT:
                self._said[name] = message, now
                self._send(name, message)

    def _send(self, name: str, message: Order | ConductorMessage) -> None:
        with contextlib.suppress(OSError):  # a pilot that is gone is noticed by its telemetry
            self._pilots[name].process.orders.send(message)
