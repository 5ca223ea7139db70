"""Fly each FLEET in turn with one random fault per flight: no vehicles may touch, and each must land and disarm.

The seed of a flight determines its fleet, the fault with its duration and size, the vehicle that it strikes, the phase
and the moment, and where the vehicles stand. The pilots and the conductor run in one stepped lab; distances are those
of the true positions. To repeat a flight of the tables, give its seed and the same fleets.

Some faults are not covered by the certificate of a fleet (docs/fleets.md); their flights are counted apart.
"""

import math
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from itertools import combinations
from operator import attrgetter
from pathlib import Path

import numpy as np

from cfplan.errors import InputError
from cfplan.flight.fleet.conductor import ConductedFlight, Conductor
from cfplan.flight.pilot.keys import Order
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.setpoints.packets import decode
from cfplan.flight.telemetry import Phase, PhaseEntered, Telemetry
from cfplan.planning.fleet.lost import BACK
from cfplan.preparation.plan_fleet import plan_fleet, prepare_fleet
from cfplan.recording.fleet_record import read_fleet_record, write_fleet_file
from cfplan.recording.header import header_under
from cfplan.recording.writer import RecordWriter
from cfplan.simulation.lab.lab import Truth
from cfplan.simulation.lab.radio import RadioFault, RadioFaultKind
from cfplan.simulation.lab.stepped_fleet import ARMED, FleetFlight, SteppedFleet
from cfplan.simulation.virtual_crazyflie.faults import VehicleFault, VehicleFaultKind
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_vicon.faults import FaultKind, ViconFault
from studies.random_faults import PATIENT
from studies.runner.limits import limits_for
from studies.runner.options import argument, option
from studies.runner.reductions import count, smallest
from studies.runner.result import Column, Table, table
from studies.runner.study import Run, Study, Work
from studies.stepped_flight import on_floor, to_wall

_MEDIAN_DURATION, _LOG_DURATION_STD = 0.5, 1.0  # of a fault: s, and standard deviation of the logarithm
_PERMANENT_FRACTION = 0.5  # of the faults that may end
_MIN_LINK_LOSS = 0.05  # s
_MAX_START_OFFSET = 0.03  # m, horizontally, of a vehicle from its start
_AIRBORNE_HEIGHT = 0.05  # m above the floor
_MAX_STALL = 5.0  # s
_NEAREST = 10  # flights in the table of those in which vehicles came nearest


class Kind(StrEnum):
    """Faults of fleets; the value is the name in tables."""

    LINK = "link lost"  # for BACK or longer
    SHORT_LINK = "link lost briefly"  # for less
    DONGLE = "dongle of two lost"
    PILOT = "pilot killed"
    STALL = "pilot stalled"
    CONDUCTOR = "conductor silent"
    MAIN = "main process killed"
    POSES = "poses of one lost"
    ALL_POSES = "poses of all lost"
    LATE = "poses of one late"
    ALL_LATE = "poses of all late"
    SWAPPED = "bodies swapped"
    BATTERY = "low battery"
    TUMBLE = "tumble"
    LOCK = "motors cut on board"
    UNARMED = "arming refused"
    ORDER = "order to brake lost to one"  # while another vehicle lands


_LOST = (Kind.LINK, Kind.PILOT, Kind.STALL, Kind.TUMBLE, Kind.LOCK)  # the vehicle may leave its path
_COVERED = "covered by the certificate"
_WITHOUT_POSES = "left out: drift without poses"
_LEFT_OUT = {
    Kind.SHORT_LINK: "left out: short loss of a link",
    Kind.DONGLE: "left out: two lost at once that have a dongle each",
    Kind.POSES: _WITHOUT_POSES,
    Kind.ALL_POSES: _WITHOUT_POSES,
    Kind.LATE: _WITHOUT_POSES,  # the pilot does not use late poses
    Kind.ALL_LATE: _WITHOUT_POSES,
    Kind.ORDER: "left out: an order that one vehicle does not hear",
}
_LOST_WARNS = "left out: lost in a fleet that is planned without regard to lost vehicles"

# Phases of the struck vehicle, repeated by their weight, and the latest moment, s, after the phase began.
_PHASES: tuple[tuple[Phase, float], ...] = (
    (Phase.PREFLIGHT, 1.0),
    (Phase.ARM, 0.3),
    (Phase.TAKE_OFF, 2.0),
    (Phase.GO_TO_START, 5.0),  # includes waiting for the other vehicles
    *((Phase.STREAM, math.inf),) * 8,
    (Phase.HOLD, 1.0),
    *((Phase.LAND, 2.5),) * 2,
)


@dataclass(frozen=True, slots=True)
class Settings:
    """The flights to draw."""

    fleet_files: tuple[Path, ...] = argument()
    flights: int = option(2000, "Flights with one fault each.", least=1)
    seed: int = option(0, "Seed of the first flight.", least=0)


@dataclass(frozen=True, slots=True)
class FleetMissions:
    """A fleet, planned and ready to fly."""

    apart: float  # m
    skew: float  # s
    flights: tuple[ConductedFlight, ...]
    missions: Mapping[str, Mission]
    keeps_lost: bool  # the plans also keep clear of a lost vehicle


@dataclass(frozen=True, slots=True)
class FleetFault:
    """One fault of a flight."""

    kind: Kind
    vehicle: str  # that it strikes
    other: str  # the second vehicle, if the fault needs two
    phase: Phase  # of `vehicle`
    moment: float  # s after the phase began
    duration: float  # s
    size: float  # V of a low battery, s of late poses

    def __str__(self) -> str:
        size = {Kind.BATTERY: f" {self.size:.2f} V", Kind.LATE: f" {self.size:.2f} s"}
        size[Kind.ALL_LATE] = size[Kind.LATE]
        two = f" and {self.other}" if self.kind in (Kind.DONGLE, Kind.SWAPPED, Kind.ORDER) else ""
        ends = f" for {self.duration:.2f} s" if math.isfinite(self.duration) else ""
        return f"{self.kind}{size.get(self.kind, '')}{ends}: {self.vehicle}{two}, {self.moment:.2f} s"


@dataclass(frozen=True, slots=True)
class FaultyFleetFlight:
    """One flight of a fleet with a fault, judged by the truth."""

    seed: int
    fleet: str
    vehicles: int
    kind: str
    coverage: str  # whether the certificate covers the fault, and if not, why
    fault: str
    phase: str
    nearest: float  # m, least horizontal distance of two vehicles in the air; infinite if there never were two
    contacts: int  # pairs that touched
    contact: str  # the first contact; empty if there was none
    to_wall: float  # m, least distance of any vehicle from walls and ceiling; negative beyond them
    landed: bool  # all on the floor, motors off
    disarmed: bool  # all vehicles
    readable: bool  # every record can be read
    brakes: str  # why the conductor let all brake; empty if it did not
    ends: str  # exit code of each vehicle

    @property
    def bad(self) -> bool:
        """Return whether vehicles touched, or one left the walls, did not land or disarm, or has no readable record."""
        return not (not self.contacts and self.to_wall > 0.0 and self.landed and self.disarmed and self.readable)

    @property
    def size(self) -> str:
        """Return the number of vehicles and the name of the fleet, for tables."""
        return f"{self.vehicles}: {self.fleet}"


_COUNTS = (
    Column("flights", "flights", value=count()),
    Column("nearest", "nearest", "m", ".2f", meaning="least horizontal distance of two vehicles in the air, by their "
           "true positions", value=smallest("nearest")),
    Column("contacts", "contact", meaning="flights in which two vehicles touched", value=count("contacts")),
    Column("to_wall", "to the wall", "m", ".2f", meaning="the least of all flights; negative: beyond it",
           value=smallest("to_wall")),
    Column("outside", "outside the walls", value=count(lambda row: row.to_wall <= 0.0)),
    Column("armed", "not disarmed", meaning="or not on the floor with all motors off",
           value=count(lambda row: not (row.landed and row.disarmed))),
    Column("unreadable", "record not readable", value=count(lambda row: not row.readable)),
    Column("braked", "all braked", meaning="flights in which the conductor let all vehicles brake",
           value=count("brakes")),
)  # fmt: skip
FLIGHT_COLUMNS = (
    Column("seed", "seed"),
    Column("fleet", "fleet"),
    Column("phase", "phase", meaning="of the vehicle that the fault strikes"),
    Column("fault", "fault", meaning="its length, the vehicle, and when it began in the phase"),
    Column("nearest", "nearest", "m", ".3f"),
    Column("to_wall", "to the wall", "m", ".2f"),
    Column("brakes", "all brake because of"),
    Column("end", "end", value=lambda rows: _end(rows[0])),
    Column("ends", "exit codes"),
)  # fmt: skip


def _end(flight: FaultyFleetFlight) -> str:
    ends = (("landed", flight.landed), ("disarmed", flight.disarmed), ("readable record", flight.readable))
    states = ", ".join(text if holds else f"not {text}" for text, holds in ends)
    return f"{flight.contact}; {states}" if flight.contacts else states


def work(settings: Settings, run: Run) -> Work:
    """Return one case per seed; the fleets are planned once. Raises what planning raises."""
    fleets = {file.stem: prepare_missions(file) for file in settings.fleet_files}
    seeds = range(settings.seed, settings.seed + settings.flights)
    return Work({str(seed): seed for seed in seeds}, partial(fly_with_fault, fleets=fleets), FaultyFleetFlight)


def prepare_missions(file: Path) -> FleetMissions:
    """Plan, rehearse and encode a fleet as for a flight. Raises what plan_fleet() and prepare_fleet() raise."""
    planned = plan_fleet(file, limits_for(file), PATIENT)
    missions = {each.planned.name: each.mission for each in prepare_fleet(planned)}
    flights = tuple(ConductedFlight(each.name, missions[each.name].start[0], each.delay) for each in planned.members)
    keeps_lost = all(each.keeps(planned.lost_keep) for each in planned.losses)
    return FleetMissions(planned.apart, planned.skew, flights, missions, keeps_lost)


def random_fault(seed: int, missions: Mapping[str, Mission]) -> FleetFault:
    """Draw the fault of flight number `seed` of a fleet."""
    chance = np.random.default_rng(seed)
    kind = list(Kind)[chance.integers(len(Kind))]
    vehicle, other = (str(each) for each in chance.choice(list(missions), size=2, replace=False))
    phase, latest = _PHASES[chance.integers(len(_PHASES))]
    if kind is Kind.UNARMED:
        phase, latest = Phase.ARM, 0.1
    moment = float(chance.uniform(0.0, min(latest, missions[vehicle].duration)))
    permanent = chance.random() < _PERMANENT_FRACTION
    length = float(_MEDIAN_DURATION * np.exp(_LOG_DURATION_STD * chance.normal()))
    size = float(chance.uniform(0.0, 1.0))
    duration = math.inf if permanent else length
    match kind:
        case Kind.LINK:
            duration = max(duration, BACK)
        case Kind.SHORT_LINK:
            duration = _MIN_LINK_LOSS + (BACK - _MIN_LINK_LOSS) * size
        case Kind.STALL:
            duration = min(length, _MAX_STALL)
        case Kind.BATTERY:
            duration, size = math.inf, 3.0 + 0.4 * size
        case Kind.LATE | Kind.ALL_LATE:
            size = 0.02 + 0.48 * size
        case Kind.POSES | Kind.ALL_POSES | Kind.SWAPPED | Kind.TUMBLE:
            pass
        case _:
            duration = math.inf
    return FleetFault(kind, vehicle, other, phase, moment, duration, size)


def _coverage(kind: Kind, fleet: FleetMissions) -> str:
    if kind in _LOST and not fleet.keeps_lost:
        return _LOST_WARNS
    return _LEFT_OUT.get(kind, _COVERED)


def fly_with_fault(seed: int, fleets: Mapping[str, FleetMissions]) -> FaultyFleetFlight:
    """Fly flight number `seed` with one of the fleets, record it, and judge it by the truth."""
    names = sorted(fleets)
    name = names[seed % len(names)]
    fleet = fleets[name]
    fault = random_fault(seed, fleet.missions)
    lab = SteppedFleet(
        fleet.missions,
        Conductor(fleet.flights, fleet.apart, fleet.skew),
        settings=_standing(fleet.missions, seed),
        seed=seed,
    )
    with tempfile.TemporaryDirectory() as folder:
        flown = _recorded(lab, fault, fleet, Path(folder))
        readable = _readable(Path(folder))
    space = next(iter(fleet.missions.values())).limits.space
    truths = flown.truths.values()
    return FaultyFleetFlight(
        seed=seed,
        fleet=name,
        vehicles=len(fleet.missions),
        kind=str(fault.kind),
        coverage=_coverage(fault.kind, fleet),
        fault=str(fault),
        phase=str(fault.phase),
        nearest=nearest_in_air(tuple(truths)),
        contacts=len(flown.contacts),
        contact=str(flown.contacts[0]) if flown.contacts else "",
        to_wall=min(to_wall(truth, space) for truth in truths),
        landed=all(map(on_floor, truths)),
        disarmed=all(truth.supervisor[-1] not in ARMED for truth in truths),
        readable=readable,
        brakes=flown.brakes,
        ends=", ".join(f"{each} {int(code)}" for each, code in flown.exit_codes.items()),
    )


def _standing(missions: Mapping[str, Mission], seed: int) -> dict[str, VehicleSettings]:
    """Return each vehicle's place; none arms itself, so the last state shows whether it was disarmed."""
    chance, settings = np.random.default_rng((seed, 1)), {}
    for name, mission in missions.items():
        (x, y, _), yaw = mission.start
        radius, angle = _MAX_START_OFFSET * chance.random(), chance.uniform(0.0, 2.0 * np.pi)
        place = float(x + radius * np.cos(angle)), float(y + radius * np.sin(angle)), 0.0
        settings[name] = VehicleSettings(
            position=place,
            yaw=yaw + float(chance.uniform(-1.0, 1.0)),
            auto_arming=False,
            seed=int(chance.integers(1 << 30)),
        )
    return settings


def _recorded(lab: SteppedFleet, fault: FleetFault, fleet: FleetMissions, folder: Path) -> FleetFlight:
    """Fly with the fault, and write the records as `cfplan fly` does."""
    struck, closed, clock = False, set[str](), lab.labs[fault.vehicle].clock
    folders = {name: folder / str(number) for number, name in enumerate(fleet.missions)}
    write_fleet_file(folder, "faults", fleet.apart, folders)
    with ExitStack() as files:
        writers = {name: files.enter_context(_writer(lab, fleet, name, folders[name])) for name in folders}

        def strike_in_flight() -> None:
            if fault.vehicle not in closed:
                strike(fault, lab)

        def react(name: str, message: Telemetry) -> None:
            nonlocal struck
            writers[name].write(message)
            if not isinstance(message, PhaseEntered):
                return
            if message.phase is Phase.CLOSED:
                closed.add(name)
            if name == fault.vehicle and message.phase is fault.phase and not struck:
                struck = True
                clock.at(message.time + fault.moment, strike_in_flight)

        return lab.fly(react)


def _writer(lab: SteppedFleet, fleet: FleetMissions, name: str, folder: Path) -> RecordWriter:
    mission = fleet.missions[name]
    path, ends = decode(mission.payloads).position[::5], mission.motion_ends
    header = header_under(mission.limits, name=name, uri="stepped://0", path=path, travel_time=ends)
    return RecordWriter(folder, header, warn=lambda _: None, clock=lab.labs[name].clock)


def _readable(folder: Path) -> bool:
    try:
        fleet = read_fleet_record(folder)
        fleet.pairs()
    except InputError:
        return False
    return not fleet.notes and all(len(record.phases.time) > 0 for record in fleet.records.values())


def strike(fault: FleetFault, fleet: SteppedFleet) -> None:
    """Begin the fault now; call this in the turn of the struck vehicle's pilot."""
    lab, labs, lasts = fleet.labs[fault.vehicle], fleet.labs.values(), fault.duration
    match fault.kind:
        case Kind.LINK | Kind.SHORT_LINK:
            lab.disturb(RadioFault(RadioFaultKind.DEAD, 0.0, lasts))
        case Kind.DONGLE:
            for each in (lab, fleet.labs[fault.other]):
                each.disturb(RadioFault(RadioFaultKind.DEAD))
        case Kind.PILOT:
            lab.kill_pilot()
        case Kind.STALL:
            lab.clock.stall(lasts)
        case Kind.CONDUCTOR:
            fleet.conductor_dies_at = lab.now
        case Kind.MAIN:
            fleet.conductor_dies_at = lab.now
            for each in labs:
                each.orders.gone = True
        case Kind.POSES:
            lab.disturb(ViconFault(FaultKind.OCCLUDE, 0.0, lasts))
        case Kind.ALL_POSES:
            for each in labs:
                each.disturb(ViconFault(FaultKind.STALL, 0.0, lasts))
        case Kind.LATE:
            lab.disturb(ViconFault(FaultKind.DELAY, 0.0, lasts, fault.size))
        case Kind.ALL_LATE:
            for each in labs:
                each.disturb(ViconFault(FaultKind.DELAY, 0.0, lasts, fault.size))
        case Kind.SWAPPED:
            _swap(fault, fleet)
        case Kind.BATTERY:
            lab.disturb(VehicleFault(VehicleFaultKind.BATTERY, 0.0, lasts, fault.size))
        case Kind.TUMBLE:
            lab.disturb(VehicleFault(VehicleFaultKind.TUMBLE, 0.0, lasts))
        case Kind.LOCK | Kind.UNARMED:
            lab.disturb(VehicleFault(VehicleFaultKind.LOCK))
        case Kind.ORDER:
            lab.deaf = True
            fleet.labs[fault.other].orders.give(Order.LAND)


def _swap(fault: FleetFault, fleet: SteppedFleet) -> None:
    a, b = fleet.labs[fault.vehicle], fleet.labs[fault.other]

    def swap_back() -> None:
        a.body, b.body = a, b

    a.body, b.body = b, a
    if math.isfinite(fault.duration):
        a.clock.at(a.now + fault.duration, swap_back)


def nearest_in_air(truths: Sequence[Truth]) -> float:
    """Return the least horizontal distance, m, of two vehicles while both are in the air; infinity if never."""
    least = math.inf
    for one, two in combinations(truths, 2):
        other = np.column_stack([np.interp(one.time, two.time, along) for along in two.position.T])
        flying = (one.position[:, 2] > _AIRBORNE_HEIGHT) & (other[:, 2] > _AIRBORNE_HEIGHT)
        away = np.linalg.norm(other[flying, :2] - one.position[flying, :2], axis=1)
        least = min(least, float(away.min(initial=math.inf)))
    return least


def tables(settings: Settings, rows: list[FaultyFleetFlight]) -> Iterator[Table]:
    """Yield tables by coverage, fault, fleet and phase, and of the nearest and the failed flights."""
    bad, kinds, phases = [row for row in rows if row.bad], list(map(str, Kind)), list(map(str, Phase))
    title = f"{len(rows)} flights with one fault each, {len(bad)} went wrong"

    def grouped(name: str, title: str, by: str, heading: str, order: list[str] | None = None) -> Table:
        columns = (Column(by, heading), *_COUNTS)
        found = sorted(rows, key=attrgetter(by) if order is None else lambda row: order.index(getattr(row, by)))
        return table(name, title, columns, found, by=(by,), last="all")

    yield grouped("all", title, "coverage", "faults")
    yield grouped("kinds", "By fault", "kind", "fault", kinds)
    yield grouped("fleets", "By fleet", "size", "fleet")
    yield grouped("phases", "By the phase of the struck vehicle", "phase", "phase", phases)
    yield table("worst", "Nearest to each other", FLIGHT_COLUMNS, sorted(rows, key=attrgetter("nearest"))[:_NEAREST])
    yield table("bad", f"{len(bad)} flights went wrong", FLIGHT_COLUMNS, bad)


STUDY = Study(Settings, work, tables, "flights/fleets/*.yaml -o results/fleet-faults.json")
