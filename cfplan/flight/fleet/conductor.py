"""The conductor of a fleet: it starts all vehicles together, and lets all brake when one must.

Each vehicle has its own pilot, which may end its flight at any time. The conductor adds what one pilot cannot know:

    preflight     until every vehicle has passed its checks, and stands under its start; nothing is armed before
    arming        until every vehicle is armed
    take-off      one after another: the next when poses show that the one before has risen, so that bodies that are
                  swapped in motion capture are noticed while one vehicle flies
    at the start  until every vehicle hovers at its start, and `holds` is false; then all have the same time at which
                  the fleet begins
    flying        each on its own clock, which is that of this computer
    braking       all vehicles brake along their paths and land, once one of them leaves its plan, ends early, does not
                  answer, is farther off its path or nearer to another than the fleet's certificate allows

It is a pure core: a driver tells it what it hears, and passes on what it says. Its silence is an order too: a pilot
that has not heard it for `CONDUCTOR_SILENT` brakes.
"""

import itertools
import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from cfplan.errors import ExitCode
from cfplan.flight.pilot.conducted import ClearanceAsked, ConductorMessage, PilotMessage, PlanLeft
from cfplan.flight.setpoints.encoding import LEAD, RATE
from cfplan.flight.telemetry import (
    Estimate,
    Event,
    Level,
    Phase,
    PhaseEntered,
    PoseReceived,
    SetpointSent,
    Telemetry,
    Triple,
    VehicleStatus,
)
from cfplan.planning.fleet.separation import CLEAR, allowed_deviation

STANDS_WITHIN = 0.05  # m beside the column of its start that a vehicle may stand
OFF_BY_MORE = 0.05  # m beyond the deviation that `apart` allows: all brake if a vehicle is farther off
"""With another vehicle off by what is allowed, 0.15 m are left, and vehicles touch at 0.14 m."""
STANDS_NEARER = 0.02  # m by which vehicles may stand nearer than they fly: error of the poses
PILOT_SILENT = 0.5  # s without a message of the tick loop of a pilot whose vehicle has passed preflight
PREFLIGHT_SILENT = 60.0  # s without one before that; a lossy radio takes half of it to read the vehicle's tables
START_LEAD = 1.2  # s from the last vehicle's readiness to the start of all, for the message to arrive
"""Longer than CONDUCTOR_SILENT: a pilot that hears of its start too late has braked before."""
FOR_ORDERS = 0.01  # s, largest difference between the arrivals of an order to brake at two pilots
"""The certified skew covers this plus the difference between the delays of two starts."""
OBEYS_LATE = 0.05  # s from a command to a vehicle that flies on board until it obeys; a command sent again comes later
RISEN = 0.15  # m above where it stood, from which on a vehicle has taken off
_POSES = 32  # of each vehicle that are remembered, and as many setpoints
_OLD = 0.2  # s; the pilot of a vehicle without a newer pose brakes by itself
_OF_THE_RADIO = (Estimate, VehicleStatus, Event)  # may come from another thread of the pilot, whose tick loop hangs
_DESCENDING, _DOWN = (Phase.LAND, Phase.DISARM, Phase.CLOSED), (Phase.DISARM, Phase.CLOSED)


class Stage(StrEnum):
    """The stages of a fleet's flight."""

    PREFLIGHT = "preflight"
    ARMING = "arming"
    TAKE_OFF = "take-off"
    FLYING = "flying"
    BRAKING = "braking"
    ENDED = "ended"


@dataclass(frozen=True, slots=True)
class ConductedFlight:
    """A vehicle of the fleet, as the conductor knows it."""

    name: str
    start: Triple  # m, where its plan begins
    delay: float  # s after the fleet's start at which its plan begins


@dataclass(frozen=True, slots=True)
class FlightEnded:
    """A pilot has ended, in order or not."""

    exit_code: ExitCode
    reason: str


@dataclass
class _Vehicle:
    """What is known of a vehicle."""

    flight: ConductedFlight
    asked: set[Phase] = field(default_factory=set)
    cleared: dict[Phase, float] = field(default_factory=dict)
    heard: float = -math.inf  # s, when its pilot's tick loop was heard last
    poses: deque[PoseReceived] = field(default_factory=lambda: deque(maxlen=_POSES))
    setpoints: deque[SetpointSent] = field(default_factory=lambda: deque(maxlen=_POSES))  # of its plan
    late: float = -math.inf  # s from the time at which its plan was to begin until it began; -inf before that
    phase: Phase | None = None  # the last that it has entered
    stood: Triple | None = None  # m, when it passed preflight
    risen: bool = False  # it has taken off, by its poses; its start may be lower
    descending: bool = False
    down: bool = False  # its motors are off
    left: bool = False  # its plan, for whatever reason
    ended: bool = False

    @property
    def name(self) -> str:
        return self.flight.name

    @property
    def is_high(self) -> bool:
        return self.stood is not None and self.poses[-1].position[2] - self.stood[2] > RISEN

    def place(self, time: float) -> Triple:
        """Return where it was at a time, s, between two of its poses."""
        return _between(self.poses, time)

    @property
    def deviation(self) -> float:
        """Return how far, m, it was from its place when it was seen last; 0 on its way up and down.

        Its place is its start until its plan begins, then on its path, and at last where it hovers at the end. Height
        counts: a vehicle that is too low would stop from an earlier setpoint than the others.
        """
        if self.descending or Phase.STREAM not in self.asked:
            return 0.0
        pose = self.poses[-1]
        place = _between(self.setpoints, pose.time - LEAD) if self.setpoints else self.flight.start
        return math.dist(pose.position, place)


def _between(seen: Sequence[PoseReceived | SetpointSent], time: float) -> Triple:
    """Return the position, m, at a time, s, between two that are known."""
    times = [each.time for each in seen]
    x, y, z = (float(np.interp(time, times, [each.position[axis] for each in seen])) for axis in range(3))
    return x, y, z


class Conductor:
    """Decides when each vehicle may arm, take off and begin, and when all brake."""

    def __init__(self, flights: Sequence[ConductedFlight], apart: float, skew: float, *, holds: bool = False):
        self._vehicles = {flight.name: _Vehicle(flight) for flight in flights}
        self._apart, self._skew = apart, skew  # m between columns and s between clocks, as certified
        self.holds = holds  # all hover at their starts until a program sets it to false
        self.brakes = ""  # why all brake; the first reason stays
        self.begins = math.inf  # s, when the fleet's clock is at 0
        self.nearest = math.inf  # m between the columns of two vehicles in the air, so far

    @property
    def stage(self) -> Stage:
        """Return how far the flight has come."""
        vehicles = self._vehicles.values()
        if all(vehicle.ended for vehicle in vehicles):
            return Stage.ENDED
        if self.brakes:
            return Stage.BRAKING
        if self.begins < math.inf:
            return Stage.FLYING
        if any(Phase.TAKE_OFF in vehicle.cleared for vehicle in vehicles):
            return Stage.TAKE_OFF
        return Stage.ARMING if any(vehicle.cleared for vehicle in vehicles) else Stage.PREFLIGHT

    @property
    def flights(self) -> tuple[ConductedFlight, ...]:
        """Return the vehicles, in the order in which they take off."""
        return tuple(vehicle.flight for vehicle in self._vehicles.values())

    @property
    def ready(self) -> bool:
        """Return whether every vehicle hovers at its start, and none has begun."""
        return self._all_wait_for(Phase.STREAM)

    def position(self, name: str) -> Triple | None:
        """Return where a vehicle was seen last, m; None before its first pose."""
        poses = self._vehicles[name].poses
        return poses[-1].position if poses else None

    def heard(self, name: str) -> float:
        """Return when a pilot's tick loop was heard last, s; -inf before that."""
        return self._vehicles[name].heard

    def hear(self, name: str, message: PilotMessage | FlightEnded | Telemetry, now: float) -> None:
        """Take what a vehicle's pilot says at a time, s."""
        vehicle = self._vehicles[name]
        if not isinstance(message, _OF_THE_RADIO):
            vehicle.heard = now
        match message:
            case PoseReceived():
                vehicle.poses.append(message)
                vehicle.risen |= vehicle.is_high
                allowed = allowed_deviation(self._apart) + OFF_BY_MORE
                if not (off := vehicle.deviation) <= allowed:
                    self._brake(f"{name}: it is {off:.2f} m from its place, at most {allowed:.2f} m")
            case SetpointSent(due=due, index=index):
                vehicle.setpoints.append(message)
                if vehicle.phase is Phase.STREAM and not vehicle.left:
                    late = due - index / RATE - vehicle.cleared.get(Phase.STREAM, -math.inf)
                    vehicle.late = max(vehicle.late, late)  # less where a stalled pilot skips setpoints
                    self._compare_start_delays(vehicle)
            case PhaseEntered(phase=phase):
                if phase is Phase.DISARM and Phase.ARM in vehicle.cleared and not vehicle.descending:
                    self._brake(f"{name}: its flight ended before it landed")  # its reason comes later, with its end
                vehicle.phase = phase
                vehicle.descending |= phase in _DESCENDING
                vehicle.down |= phase in _DOWN
            case ClearanceAsked(phase=phase):
                vehicle.asked.add(phase)
            case Event(level=Level.ERROR, text=text) if Phase.TAKE_OFF in vehicle.cleared:  # as when the link is lost
                self._brake(f"{name}: {text}")
            case PlanLeft(reason=reason):
                vehicle.left = True
                self._brake(f"{name}: {reason}")
            case FlightEnded(exit_code=exit_code, reason=reason):
                vehicle.ended = True
                if exit_code is not ExitCode.OK:
                    self._brake(f"{name}: {reason}")

    def say(self, now: float) -> Mapping[str, ConductorMessage]:
        """Return what each vehicle that still flies is told at a time, s. Call it a hundred times a second."""
        self._watch(now)
        if not self.brakes:
            self._clear(now)
        return {
            vehicle.name: ConductorMessage(dict(vehicle.cleared), self._reason_for(vehicle))
            for vehicle in self._vehicles.values()
            if not vehicle.ended
        }

    def _reason_for(self, vehicle: _Vehicle) -> str:
        """Return why a vehicle must brake; one that has flown its plan lands anyway."""
        return "" if vehicle.descending and not vehicle.left else self.brakes

    def _compare_start_delays(self, vehicle: _Vehicle) -> None:
        """Let all brake if a plan began too late, by itself or compared with that of another vehicle."""
        begun = [each.late for each in self._vehicles.values() if each.late > -math.inf]
        apart, allowed = max(begun) - min(begun), self._skew - FOR_ORDERS
        if vehicle.late > self._skew:
            self._brake(f"{vehicle.name}: it began its path {vehicle.late:.3f} s late (limit {self._skew:.3f} s)")
        elif apart > allowed:
            self._brake(
                f"{vehicle.name}: the delays of its start and of another's differ by {apart:.3f} s "
                f"(limit {allowed:.3f} s)"
            )

    def _brake(self, reason: str) -> None:
        self.brakes = self.brakes or reason

    # What ends the flight of all.

    def _watch(self, now: float) -> None:
        begun = [vehicle for vehicle in self._vehicles.values() if vehicle.heard > -math.inf and not vehicle.ended]
        for vehicle in begun:
            allowed = PILOT_SILENT if Phase.ARM in vehicle.asked else PREFLIGHT_SILENT
            if not vehicle.down and now - vehicle.heard > allowed:
                self._brake(f"{vehicle.name}: neither setpoints nor poses came from its pilot for {allowed:g} s")
        for a, b in itertools.combinations([each for each in begun if Phase.ARM in each.asked], 2):
            self._watch_pair(a, b, now)

    def _watch_pair(self, a: _Vehicle, b: _Vehicle, now: float) -> None:
        """Compare two vehicles of which one at least flies, at the newest moment at which both were seen."""
        if not (a.is_high or b.is_high) or now - min(a.poses[-1].time, b.poses[-1].time) > _OLD:
            return
        moment = min(a.poses[-1].time, b.poses[-1].time)
        distance = math.dist(a.place(moment)[:2], b.place(moment)[:2])
        self.nearest = min(self.nearest, distance)
        if distance < CLEAR:
            self._brake(f"{a.name} and {b.name} are {distance:.2f} m apart, which must be {CLEAR:.2f} m")

    # What lets it go on.

    def _clear(self, now: float) -> None:
        """Clear what all vehicles are ready for."""
        vehicles = list(self._vehicles.values())
        if self._all_wait_for(Phase.ARM):
            self._take_places(vehicles)
            if not self.brakes:
                for vehicle in vehicles:
                    vehicle.cleared[Phase.ARM] = now
        if all(Phase.TAKE_OFF in vehicle.asked for vehicle in vehicles):
            waiting = [vehicle for vehicle in vehicles if Phase.TAKE_OFF not in vehicle.cleared]
            if waiting and all(vehicle.risen for vehicle in vehicles if vehicle not in waiting):
                waiting[0].cleared[Phase.TAKE_OFF] = now
        if self.ready and not self.holds:
            self.begins = now + START_LEAD
            for vehicle in vehicles:
                vehicle.cleared[Phase.STREAM] = self.begins + vehicle.flight.delay

    def _all_wait_for(self, phase: Phase) -> bool:
        return all(phase in vehicle.asked and phase not in vehicle.cleared for vehicle in self._vehicles.values())

    def _take_places(self, vehicles: Sequence[_Vehicle]) -> None:
        """Note where all stand, and end the flight on the floor unless each stands under its start, apart."""
        for vehicle in vehicles:
            vehicle.stood = vehicle.poses[-1].position
            beside = math.dist(vehicle.stood[:2], vehicle.flight.start[:2])
            if not beside <= STANDS_WITHIN:
                self._require_not_swapped(vehicle, vehicle.stood, vehicles)
                self._brake(
                    f"{vehicle.name} stands {beside:.2f} m beside its start at "
                    f"({vehicle.flight.start[0]:.2f}, {vehicle.flight.start[1]:.2f}) m, at most {STANDS_WITHIN:g} m"
                )
        for a, b in itertools.combinations(vehicles, 2):
            assert a.stood is not None
            assert b.stood is not None
            distance = math.dist(a.stood[:2], b.stood[:2])
            allowed = self._apart - STANDS_NEARER
            if not distance >= allowed:
                self._brake(f"{a.name} and {b.name} stand {distance:.2f} m apart, which must be {allowed:.2f} m")

    def _require_not_swapped(self, vehicle: _Vehicle, stood: Triple, vehicles: Sequence[_Vehicle]) -> None:
        """End the flight on the floor if a vehicle stands under the start of another."""
        for other in vehicles:
            if other is not vehicle and math.dist(stood[:2], other.flight.start[:2]) <= STANDS_WITHIN:
                self._brake(
                    f"{vehicle.name} stands at the start of {other.name}: the two vehicles, or their bodies in motion "
                    "capture, are swapped"
                )
