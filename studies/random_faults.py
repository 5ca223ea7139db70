"""Fly with random faults in the stepped lab, death among them. None may leave the walls, each must end disarmed.

The seed of a flight determines its path, the phase and moment of the first fault, one to three faults at once with
their lengths and sizes, whether logs or acknowledgements fall silent as well, and whether the pilot or the radio dies
for good. The vehicle is then alone and comes down by its own time-outs; its last setpoint must have been harmless.
"""

import contextlib
import itertools
import math
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from cfplan.errors import InfeasibleError, NotCertifiedError
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.telemetry import Phase
from cfplan.geometry.random_paths import random_waypoints
from cfplan.preparation.prepare_flight import prepare_flight
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.lab.lab import Fault
from cfplan.simulation.lab.radio import RadioFault, RadioFaultKind
from cfplan.simulation.virtual_crazyflie.faults import VehicleFault, VehicleFaultKind
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_vicon.faults import FaultKind, ViconFault
from studies.fault_scenarios import FOR_GOOD, Scenario
from studies.faults import fly_scenario
from studies.runner.result import Column, StudyResult, Table, collect, detail_table

_LENGTH, _SPREAD = 0.5, 1.2  # s and its logarithm's deviation: a twentieth of a second to some seconds
_SHARE_FOR_GOOD = 0.1  # of the faults
_SHARE_DEAD = 0.4  # of the flights: the pilot or the radio dies
_MANY = (0.5, 0.3, 0.2)  # share of flights with one, two, three faults
_APART = 1.5  # s within which several faults begin
_BESIDE_START = 0.4  # m from the path's start at which the vehicle stands
_INSIDE = 0.02  # m that it stands inside the margin, as preflight measures its place
_GROUPS = {FaultKind: "pose", RadioFaultKind: "radio", VehicleFaultKind: "vehicle"}
_LONGEST_STALL = 5.0  # s
_GROUP_SIZE = 10  # flights that a process flies before it reports
_WORST = 10

# In which something goes wrong, as likely as they are often here, and up to how many s after each began.
_PHASES: tuple[tuple[Phase, float], ...] = (
    (Phase.CONFIGURE, 1.0),
    (Phase.CONVERGE, 1.0),
    (Phase.PREFLIGHT, 1.0),
    (Phase.ARM, 0.2),
    (Phase.TAKE_OFF, 2.0),
    (Phase.TAKE_OFF, 2.0),
    (Phase.GO_TO_START, 1.7),
    (Phase.GO_TO_START, 1.7),
    *((Phase.STREAM, math.inf),) * 6,
    (Phase.HOLD, 1.0),
    *((Phase.LAND, 2.5),) * 2,
    (Phase.LAND, 6.0),  # until it lies on the floor
)

_SHARE_SILENT = 0.35  # of the flights: logs or acknowledgements fall silent
_SHARE_FLAPPING = 0.4  # of those: they come back for a moment
_BACK_FOR = 0.1  # s
# Sources that fall silent together.
_SILENCES: tuple[tuple[Any, ...], ...] = (
    (VehicleFaultKind.SILENT_ESTIMATE,),
    (VehicleFaultKind.SILENT_STATUS,),
    (VehicleFaultKind.SILENT_ESTIMATE, VehicleFaultKind.SILENT_STATUS),
    (RadioFaultKind.UNACKNOWLEDGED,),
)

_STALL, _MAIN, _PILOT = "stall", "main process killed", "pilot killed"

# Kind, and the least and most size where it has one.
_KINDS: tuple[tuple[Any, float, float], ...] = (
    (FaultKind.OCCLUDE, 0, 0),
    (FaultKind.STALL, 0, 0),
    (FaultKind.FREEZE, 0, 0),
    (FaultKind.REPEAT, 0, 0),
    (FaultKind.JUMP, -2.0, 2.0),
    (FaultKind.FLIP, -math.pi, math.pi),
    (FaultKind.BREAK, 0, 0),
    (FaultKind.DELAY, 0.02, 0.5),
    (FaultKind.CLOSE, 0, 0),
    (RadioFaultKind.LOSS, 0.05, 0.8),
    (RadioFaultKind.DELAY, 0.005, 0.05),
    (RadioFaultKind.DEAD, 0, 0),
    (VehicleFaultKind.MOTOR, 0.7, 1.0),
    (VehicleFaultKind.MASS, 0.8, 1.2),
    (VehicleFaultKind.GUST, -1.5, 1.5),
    (VehicleFaultKind.BATTERY, 3.0, 3.4),
    (VehicleFaultKind.TUMBLE, 0, 0),
    (VehicleFaultKind.LOCK, 0, 0),
    (_STALL, 0, 0),
    (_MAIN, 0, 0),
)


@dataclass(frozen=True, slots=True)
class RandomFlight:
    """One flight with random faults, judged by the truth."""

    seed: int
    path: str
    phase: str
    faults: str  # joined by " + "
    rung: str
    to_wall: float  # m, least distance of the true position from walls and ceiling; negative beyond them
    off_plan: float  # m, largest distance of the true position from the planned path, from landing on horizontally
    landed: bool  # on the floor, motors off
    disarmed: bool
    readable: bool  # its record
    reason: str

    @property
    def kinds(self) -> tuple[str, ...]:
        """Return the kinds of its faults, each once."""
        return tuple(dict.fromkeys(fault.split(" ", 1)[0] for fault in self.faults.split(" + ")))

    @property
    def bad(self) -> bool:
        """Return whether it was outside the walls, not landed, not disarmed, or left no readable record."""
        return not (self.to_wall > 0.0 and self.landed and self.disarmed and self.readable)

    def row(self) -> dict[str, Any]:
        """Return it by the keys of FLIGHT_COLUMNS."""
        ends = (("landed", self.landed), ("disarmed", self.disarmed), ("readable record", self.readable))
        ended = ", ".join(text if holds else f"not {text}" for text, holds in ends)
        shown = ("seed", "path", "phase", "faults", "rung", "to_wall")
        return {key: getattr(self, key) for key in shown} | {"end": ended}


COLUMNS = (
    Column("group", "flights with"),
    Column("flights", "flights"),
    Column("to_wall", "to the wall", "m", ".2f", meaning="the least of all flights; negative: beyond it"),
    Column("off_plan", "off the path", "cm", ".0f", meaning="the largest of all flights"),
    Column("outside", "outside the walls"),
    Column("armed", "not disarmed", meaning="or not on the floor with its motors off"),
    Column("unreadable", "record not readable"),
)
FLIGHT_COLUMNS = (
    Column("seed", "seed"),
    Column("path", "path"),
    Column("phase", "phase"),
    Column("faults", "faults", meaning="size, length, and when it began after the first"),
    Column("rung", "rung", meaning="the lowest of the abort ladder that the pilot took"),
    Column("to_wall", "to the wall", "m", ".3f", meaning="least distance of the true position; negative: beyond"),
    Column("end", "end"),
)


def prepare_missions(
    path_files: Iterable[Path], find_safety_file: Callable[[Path], Path], random_paths: int = 0
) -> dict[str, Mission]:
    """Prepare each path once, as for a flight, link loss and all, and so many random ones under the first's limits.

    A random path that may not fly is left out. Raises what preparing raises for the others.
    """
    files = tuple(path_files)
    missions = {file.stem: prepare_flight(file, load_limits(find_safety_file(file))).mission for file in files}
    limits = load_limits(find_safety_file(files[0]))
    space = limits.space
    box = np.array([np.array(space.low) + space.margin, np.array(space.high) - space.margin])
    with tempfile.TemporaryDirectory() as folder:
        for seed in itertools.count():
            if len(missions) >= len(files) + random_paths:
                break
            file = Path(folder) / f"small-{seed}.yaml"
            points = random_waypoints(seed, box, (2, 3)).round(3).tolist()
            file.write_text(f"name: {file.stem}\nwaypoints: {points}\n", encoding="utf-8")
            with contextlib.suppress(InfeasibleError, NotCertifiedError):
                missions[file.stem] = prepare_flight(file, limits).mission
    return missions


def random_scenario(seed: int, mission: Mission) -> Scenario:
    """Draw what goes wrong in flight number `seed` along a mission, and where the vehicle stands before it."""
    chance = np.random.default_rng(seed)
    phase, within = _PHASES[chance.integers(len(_PHASES))]
    moment = float(chance.uniform(0.0, min(within, mission.duration)))
    many = 1 + int(chance.choice(len(_MANY), p=_MANY))
    texts, faults, changes = list[str](), list[Fault](), dict[str, Any]()
    for place, number in enumerate(chance.choice(len(_KINDS), size=many, replace=False)):
        kind, least, most = _KINDS[number]
        start = float(chance.uniform(0.0, _APART)) if place else 0.0
        length = FOR_GOOD if chance.random() < _SHARE_FOR_GOOD else float(_LENGTH * np.exp(_SPREAD * chance.normal()))
        size = float(chance.uniform(least, most)) if most > least else None
        if kind is _STALL:
            length = min(length, _LONGEST_STALL)
            changes |= {"stall": length, "stall_after": start}
        elif kind is _MAIN:
            changes |= {"main_killed": True, "main_killed_after": start}
        else:
            faults.append(_fault(kind, start, length, size))
        texts.append(_text(kind, start, length, size))
    if chance.random() < _SHARE_DEAD:
        start = float(chance.uniform(0.0, _APART)) if chance.random() < 0.5 else 0.0
        if chance.random() < 0.5:
            changes |= {"pilot_killed": True, "pilot_killed_after": start}
            texts.append(_text(_PILOT, start, math.inf, None))
        else:
            faults.append(RadioFault(RadioFaultKind.DEAD, start, FOR_GOOD))
            texts.append(_text(RadioFaultKind.DEAD, start, FOR_GOOD, None))
    stands = _beside_start(mission, chance)
    vehicle = VehicleSettings(auto_arming=False, seed=seed, position=stands, yaw=float(chance.uniform(-1.0, 1.0)))
    return replace(
        Scenario(" + ".join(texts), Rung.NONE, tuple(faults), phase, moment, vehicle=vehicle),
        **changes,
    )


def with_silence(scenario: Scenario, seed: int) -> Scenario:
    """Return the scenario; in a fraction of the flights, logs or acknowledgements fall silent as well."""
    chance = np.random.default_rng((seed, 1))
    if chance.random() > _SHARE_SILENT:
        return scenario
    kinds = _SILENCES[chance.integers(len(_SILENCES))]
    start = float(chance.uniform(0.0, _APART))
    length = FOR_GOOD if chance.random() < 0.5 else float(_LENGTH * np.exp(_SPREAD * chance.normal()))
    spans = [(start, length)]
    if chance.random() < _SHARE_FLAPPING:
        spans = [(start, 2.0 * _LENGTH), (start + 2.0 * _LENGTH + _BACK_FOR, length)]
    silences = [(kind, *span) for span in spans for kind in kinds]
    return replace(
        scenario,
        name=" + ".join([scenario.name, *(_text(kind, begin, lasts, None) for kind, begin, lasts in silences)]),
        faults=(*scenario.faults, *(_fault(kind, begin, lasts, None) for kind, begin, lasts in silences)),
    )


def _beside_start(mission: Mission, chance: np.random.Generator) -> tuple[float, float, float]:
    space = mission.limits.space
    inside = space.margin + _INSIDE
    low, high = np.array(space.low[:2]) + inside, np.array(space.high[:2]) - inside
    x, y = np.clip(mission.start[0][:2] + chance.uniform(-_BESIDE_START, _BESIDE_START, 2), low, high).tolist()
    return x, y, 0.0


def _fault(kind: Any, start: float, length: float, size: float | None) -> Fault:
    if isinstance(kind, FaultKind):
        return ViconFault(kind, start, length, size)
    if isinstance(kind, RadioFaultKind):
        return RadioFault(kind, start, length, size)
    return VehicleFault(kind, start, length, size)


def _text(kind: Any, start: float, length: float, size: float | None) -> str:
    text = f"{_GROUPS.get(type(kind), 'computer')}:{str(kind).replace(' ', '-')}"
    if size is not None:
        text += f" {size:.2f}"
    if kind not in (_MAIN, _PILOT):
        text += " for good" if length >= FOR_GOOD else f" for {length:.2f} s"
    return f"{text} after {start:.2f} s" if start else text


def fly_random(seed: int, missions: Mapping[str, Mission]) -> RandomFlight:
    """Fly flight number `seed` along one of the paths, with a record."""
    names = sorted(missions)
    name = names[seed % len(names)]
    scenario = with_silence(random_scenario(seed, missions[name]), seed)
    flown = fly_scenario(scenario, missions[name], seed)
    return RandomFlight(
        seed=seed,
        path=name,
        phase=str(scenario.phase),
        faults=flown.name,
        rung=flown.rung,
        to_wall=round(flown.to_wall, 4),
        off_plan=round(flown.off_plan, 4),
        landed=flown.landed,
        disarmed=flown.disarmed,
        readable=flown.readable,
        reason=flown.reason,
    )


def random_flights(
    missions: Mapping[str, Mission],
    *,
    seeds: Sequence[int],
    jobs: int = 1,
    minutes: float = math.inf,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> StudyResult:
    """Fly with random faults for each seed, on `jobs` processes; begin no flight once `minutes` have passed."""
    flown, interrupted = collect(_fly_all(missions, seeds, jobs, minutes, progress))
    settings = {"paths": sorted(missions), "seeds": [seeds[0], seeds[len(flown) - 1]] if flown else []}
    flights = sorted(flown, key=lambda flight: flight.seed)
    detail = detail_table("flights", [_kept(flight) for flight in flights])
    return StudyResult("random-faults", settings, fault_tables(flights), (detail,), interrupted)


def _fly_all(
    missions: Mapping[str, Mission],
    seeds: Sequence[int],
    jobs: int,
    minutes: float,
    progress: Callable[[int, int], None],
) -> Iterator[RandomFlight]:
    from joblib import Parallel, delayed

    end, done = time.monotonic() + 60.0 * minutes, 0
    groups = (seeds[begin : begin + _GROUP_SIZE] for begin in range(0, len(seeds), _GROUP_SIZE))
    in_time = itertools.takewhile(lambda _: time.monotonic() < end, groups)
    for group in Parallel(n_jobs=jobs, return_as="generator")(delayed(_fly_group)(part, missions) for part in in_time):
        done += len(group)
        progress(done, len(seeds))
        yield from group


def _fly_group(seeds: Sequence[int], missions: Mapping[str, Mission]) -> list[RandomFlight]:
    return [fly_random(seed, missions) for seed in seeds]


def fault_tables(flights: Sequence[RandomFlight]) -> tuple[Table, ...]:
    """Return the tables: by kind and phase, the flights nearest to a wall, and every flight that went wrong."""
    kinds = list(dict.fromkeys(kind for flight in flights for kind in flight.kinds))
    by_kind = [_row(kind, [flight for flight in flights if kind in flight.kinds]) for kind in sorted(kinds)]
    phases = [phase for phase in map(str, Phase) if any(flight.phase == phase for flight in flights)]
    by_phase = [_row(phase, [flight for flight in flights if flight.phase == phase]) for phase in phases]
    counts = sorted({flight.faults.count(" + ") + 1 for flight in flights})
    many = {count: [flight for flight in flights if flight.faults.count(" + ") + 1 == count] for count in counts}
    by_count = [_row(f"{count} faults" if count > 1 else "1 fault", of) for count, of in many.items() if of]
    worst = sorted(flights, key=lambda flight: flight.to_wall)[:_WORST]
    bad = [flight for flight in flights if flight.bad]
    total = (_row("random faults", flights),) if flights else ()
    outside = sum(flight.to_wall <= 0.0 for flight in flights)
    return (
        Table("all", f"{len(flights)} flights, {outside} outside the walls", COLUMNS, (*total, *by_count)),
        Table("kinds", "By kind of fault", COLUMNS, tuple(by_kind)),
        Table("phases", "By the phase in which it began", COLUMNS, tuple(by_phase)),
        Table("worst", "Nearest to a wall", FLIGHT_COLUMNS, tuple(flight.row() for flight in worst)),
        Table("bad", f"{len(bad)} flights went wrong", FLIGHT_COLUMNS, tuple(flight.row() for flight in bad)),
    )


def _row(group: str, flights: Sequence[RandomFlight]) -> dict[str, Any]:
    return {
        "group": group,
        "flights": len(flights),
        "to_wall": min(flight.to_wall for flight in flights),
        "off_plan": max(flight.off_plan for flight in flights),
        "outside": sum(flight.to_wall <= 0.0 for flight in flights),
        "armed": sum(not (flight.landed and flight.disarmed) for flight in flights),
        "unreadable": sum(not flight.readable for flight in flights),
    }


def _kept(flight: RandomFlight) -> dict[str, Any]:
    """Return a flight's fields for the JSON, the reason only where it went wrong: there are thousands."""
    row = {field.name: getattr(flight, field.name) for field in fields(flight)}
    return row | {"reason": flight.reason if flight.bad else ""}
