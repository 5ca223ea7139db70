"""Several vehicles in one stepped lab: the pilots of a fleet and its conductor in turns, on one clock.

Each vehicle has its own stepped lab, with its radio, and cameras that see its own body. A pilot is a thread, of which
one runs at a time: the one whose clock is behind all others, so every flight can be repeated to the last bit. Every
10 ms the vehicles push each other down by the air beneath them, and the conductor hears and speaks.
"""

import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from cfplan.errors import CfplanError, ExitCode
from cfplan.flight.clock import BEGIN, SteppedClock
from cfplan.flight.fleet.conductor import Conductor, FlightEnded
from cfplan.flight.pilot.conducted import HeldConductor, PilotMessage
from cfplan.flight.pilot.keys import HeldOrders
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.pilot.outcome import FlightOutcome
from cfplan.flight.pilot.pilot import Pilot
from cfplan.flight.telemetry import Quaternion, Telemetry, Triple
from cfplan.simulation.lab.downwash import Contact, contacts, share_air
from cfplan.simulation.lab.lab import Truth
from cfplan.simulation.lab.radio import RadioFault, RadioFaultKind
from cfplan.simulation.lab.stepped_lab import SteppedLab
from cfplan.simulation.lab.stepped_link import SteppedPoses, connect
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_crazyflie.supervisor import State
from cfplan.simulation.virtual_vicon.cameras import Cameras, ViconSettings
from cfplan.simulation.virtual_vicon.faults import Seen

PERIOD = 0.01  # s between looks of the room and of the conductor
_SETTLING = 0.1  # s until a supervisor has disarmed its vehicle, and the truth shows it
_AFTERWARDS = 6.0  # s that vehicles get to come to rest after the last pilot has ended
_LEFT_ALONE = 36.0  # s, the same for those that must disarm; on the floor they do so 30 s after arming
_FLYING = (State.FLYING, State.WARNING_LEVEL_OUT)
ARMED = (State.ARMING, State.READY_TO_FLY, *_FLYING, State.LANDED)
Message = PilotMessage | FlightEnded | Telemetry


class PilotDied(BaseException):
    """Simulates the sudden death of a pilot's process."""


class _Turns:
    """Lets one thread run at a time: the one whose time is least, of several the first."""

    def __init__(self, count: int, between: Callable[[float], None]):
        self._times, self._running = [BEGIN] * count, set(range(count))
        self._gates = [threading.Semaphore(0) for _ in range(count)]
        self._between, self._ended = between, threading.Event()
        self.failure: BaseException | None = None  # the first one

    def run(self, acts: list[Callable[[], None]]) -> None:
        """Run the acts, each in its thread, until all have ended. Raises what the first of them raises."""
        threads = [
            threading.Thread(target=self._run, args=(number, act), daemon=True) for number, act in enumerate(acts)
        ]
        for thread in threads:
            thread.start()
        self._gates[0].release()
        self._ended.wait()
        if self.failure is not None:
            raise self.failure

    def _run(self, number: int, act: Callable[[], None]) -> None:
        self._gates[number].acquire()
        try:
            act()
        except BaseException as error:
            self.failure = self.failure or error
        self._running.discard(number)
        if self._running:
            self._gates[self._next()].release()
        else:
            self._ended.set()

    def pass_on(self, number: int, now: float) -> None:
        """Let others run that are behind the time, s, that a thread has reached; return when it is its turn again."""
        self._times[number] = now
        after = self._next()
        if after != number:
            self._gates[after].release()
            self._gates[number].acquire()

    def _next(self) -> int:
        number = min(self._running, key=lambda each: (self._times[each], each))
        try:
            self._between(self._times[number])
        except BaseException as error:
            self.failure = self.failure or error
        return number


class _SharedClock(SteppedClock):
    """A stepped clock of one lab, whose thread lets others run whenever it has slept."""

    def __init__(self, pass_time: Callable[[float], None], slept: Callable[[float], None]):
        super().__init__(BEGIN, pass_time)
        self._slept = slept

    def sleep(self, duration: float, /) -> None:
        super().sleep(duration)
        self._slept(self.now())


class _BodyCameras(Cameras):
    """Cameras that see a body that may be fixed to another vehicle."""

    def __init__(self, settings: ViconSettings, sees: Callable[[], Seen]):
        super().__init__(settings, BEGIN)
        self._sees = sees

    def look(
        self, time: float, position: Triple, quaternion: Quaternion, moving: Mapping[str, Seen] | None = None
    ) -> None:
        super().look(time, *self._sees(), moving)


class VehicleLab(SteppedLab):
    """The lab of one vehicle of a room."""

    def __init__(self, mission: Mission, settings: VehicleSettings, slept: Callable[[float], None], *, seed: int):
        super().__init__(mission.limits.airframe, vehicle=settings, seed=seed)
        self.clock = _SharedClock(self._advance, slept)
        self.body: SteppedLab = self  # the vehicle that its cameras take for this one
        self.cameras = _BodyCameras(ViconSettings(seed=7 + seed), self._body_seen)
        self.orders = HeldOrders()
        self.deaf = False  # the conductor's messages do not reach its pilot
        self.died = False

    @property
    def must_disarm(self) -> bool:
        """Return whether a flight must end with the vehicle disarmed: only one that does not arm itself stays so."""
        return self.vehicle.settings.auto_arming is False

    def kill_pilot(self) -> None:
        """Let the pilot's process die now: nothing of it reaches the vehicle any more. Call it in the pilot's turn."""
        self.died = True
        self.disturb(RadioFault(RadioFaultKind.DEAD))
        raise PilotDied

    def _body_seen(self) -> Seen:
        truth = self.body.vehicle.truth.tolist()
        return (truth[0], truth[1], truth[2]), (truth[6], truth[7], truth[8], truth[9])


@dataclass(frozen=True, slots=True)
class FleetFlight:
    """What a flight of a fleet left behind, each by the names of the vehicles."""

    outcomes: Mapping[str, FlightOutcome]  # of pilots that ended in order
    reasons: Mapping[str, str]  # why each ended
    exit_codes: Mapping[str, ExitCode]
    truths: Mapping[str, Truth]
    telemetry: Mapping[str, tuple[Telemetry, ...]]
    contacts: tuple[Contact, ...]  # of which there should be none
    brakes: str  # why the conductor let all brake; empty where it did not
    nearest: float  # m between the columns of two vehicles in the air, as the conductor measured it


@dataclass
class _Notes:
    outcomes: dict[str, FlightOutcome] = field(default_factory=dict)
    ends: dict[str, FlightEnded] = field(default_factory=dict)
    telemetry: dict[str, list[Telemetry]] = field(default_factory=dict)


class SteppedFleet:
    """A room with a lab for each mission, whose vehicles stand under their starts; `fly` once."""

    def __init__(
        self,
        missions: Mapping[str, Mission],
        conductor: Conductor,
        *,
        settings: Mapping[str, VehicleSettings] | None = None,
        seed: int = 0,
    ):
        self._missions, self._conductor = missions, conductor
        self._turns = _Turns(len(missions), self._between)
        self.labs: dict[str, VehicleLab] = {}
        for number, (name, mission) in enumerate(missions.items()):
            (x, y, _), yaw = mission.start
            own = (settings or {}).get(name) or VehicleSettings(position=(x, y, 0.0), yaw=yaw)
            self.labs[name] = VehicleLab(mission, own, self._slept(number), seed=seed + 101 * number)
        self.conductor_dies_at = float("inf")  # s
        self._heard: deque[tuple[str, Message]] = deque()
        self._conductors: dict[str, HeldConductor] = {}
        self._looked, self._notes = BEGIN - PERIOD, _Notes(telemetry={name: [] for name in missions})

    def fly(self, react: Callable[[str, Telemetry], None] = lambda name, message: None) -> FleetFlight:
        """Fly until all vehicles have come to rest; `react` sees each message in the turn of its pilot."""
        self._turns.run([self._act(name, react) for name in self._missions])
        notes, truths = self._notes, {name: lab.truth() for name, lab in self.labs.items()}
        return FleetFlight(
            outcomes=notes.outcomes,
            reasons={name: notes.ends[name].reason for name in self._missions},
            exit_codes={name: notes.ends[name].exit_code for name in self._missions},
            truths=truths,
            telemetry={name: tuple(messages) for name, messages in notes.telemetry.items()},
            contacts=contacts(truths, next(iter(self._missions.values())).limits.airframe),
            brakes=self._conductor.brakes,
            nearest=self._conductor.nearest,
        )

    def _slept(self, number: int) -> Callable[[float], None]:
        return lambda now: self._turns.pass_on(number, now)

    def _act(self, name: str, react: Callable[[str, Telemetry], None]) -> Callable[[], None]:
        """Return what the thread of a vehicle does: its pilot's flight, then to wait until all are at rest."""
        lab = self.labs[name]

        def act() -> None:
            end = self._flown(name, react)
            self._notes.ends[name] = end
            if not lab.died:  # else nobody says so, and the conductor must notice
                self._heard.append((name, end))
            while len(self._notes.ends) < len(self.labs):
                lab.clock.sleep(PERIOD)
            moves, patience = (ARMED, _LEFT_ALONE) if lab.must_disarm else (_FLYING, _AFTERWARDS)
            until = lab.now + patience
            while lab.vehicle.supervisor_state in moves and lab.now < until:
                lab.clock.sleep(PERIOD)
            lab.clock.sleep(_SETTLING)

        return act

    def _flown(self, name: str, react: Callable[[str, Telemetry], None]) -> FlightEnded:
        """Fly a vehicle; return how it ended."""
        lab, mission, telemetry = self.labs[name], self._missions[name], self._notes.telemetry[name]

        def hear(message: Telemetry) -> None:
            if not lab.died:
                telemetry.append(message)
                self._heard.append((name, message))
                react(name, message)

        conductor = self._conductors[name] = HeldConductor(
            lambda message: self._heard.append((name, message)), lab.clock.now
        )
        pilot = Pilot(
            mission,
            connect=lambda _: connect(lab, hear),
            source=SteppedPoses(lab, mission.limits.pose),
            report=hear,
            orders=lab.orders,
            conductor=conductor,
            clock=lab.clock,
        )
        try:
            outcome = self._notes.outcomes[name] = pilot.fly()
        except PilotDied:
            return FlightEnded(ExitCode.LINK_LOST, "its pilot died")
        except CfplanError as error:
            return FlightEnded(error.exit_code, str(error))
        return FlightEnded(outcome.exit_code, outcome.reason)

    def _between(self, now: float) -> None:
        """Let the room and the conductor act at each time that all vehicles have reached."""
        while self._looked + PERIOD <= now:
            self._looked += PERIOD
            share_air([lab.vehicle for lab in self.labs.values()])
            if self._looked < self.conductor_dies_at:
                self._conduct(self._looked)

    def _conduct(self, now: float) -> None:
        while self._heard:
            name, message = self._heard.popleft()
            self._conductor.hear(name, message, now)
        for name, order in self._conductor.say(now).items():
            if name in self._conductors and not self.labs[name].deaf:
                self._conductors[name].give(order)
