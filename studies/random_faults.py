"""Fly along each PATH in turn with random faults, by seed: none may leave the walls, each must end disarmed.

The seed of a flight determines its path, the phase and moment of the first fault, one to three overlapping faults with
their durations and sizes, whether logs or acknowledgements fall silent as well, and in two flights of five the death of
the pilot or the radio. The vehicle is then left to its own time-outs, and its last setpoint must have been harmless. To
repeat a flight of the tables, give its seed and the same paths.
"""

import contextlib
import itertools
import math
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cfplan.errors import InfeasibleError, NotCertifiedError
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.telemetry import Phase
from cfplan.geometry.random_paths import random_waypoints
from cfplan.preparation.plan_flight import FlightOptions
from cfplan.preparation.prepare_flight import prepare_flight
from cfplan.simulation.lab.lab import Fault
from cfplan.simulation.lab.radio import RadioFault, RadioFaultKind
from cfplan.simulation.virtual_crazyflie.faults import VehicleFault, VehicleFaultKind
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_vicon.faults import FaultKind, ViconFault
from studies.runner.limits import limits_for
from studies.runner.options import argument, option
from studies.runner.reductions import count, largest, smallest
from studies.runner.result import Column, Table, table
from studies.runner.study import Run, Study, Work
from studies.stepped_flight import FOR_GOOD, FaultFlight, Scenario, fly_scenario

_LENGTH, _SPREAD = 0.5, 1.2  # median, s, and standard deviation of the logarithm of a fault's duration
PATIENT = FlightOptions(budget=60.0)  # so that the plans are the same on a computer with other work
_FRACTION_FOR_GOOD = 0.1  # of the faults: they never end
_FRACTION_DEAD = 0.4  # of the flights: the pilot or the radio dies
_MANY = (0.5, 0.3, 0.2)  # fraction of flights with one, two, three faults
_APART = 1.5  # s within which several faults begin
_BESIDE_START = 0.4  # m, largest offset of the vehicle from the path's start, along x and y
_INSIDE = 0.02  # m that the vehicle stands inside the margin, which preflight checks by a measured position
_GROUPS: dict[type, tuple[str, Any]] = {
    FaultKind: ("pose", ViconFault), RadioFaultKind: ("radio", RadioFault), VehicleFaultKind: ("vehicle", VehicleFault),
}  # fmt: skip
_LONGEST_STALL = 5.0  # s
_WORST = 10

# Phases in which a fault begins, repeated by their weight, and the latest moment, s, after the phase began.
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
    (Phase.LAND, 6.0),  # late enough to reach the floor
)

_FRACTION_SILENT = 0.35  # of the flights: logs or acknowledgements fall silent
_FRACTION_FLAPPING = 0.4  # of those: the sources come back for a moment
_BACK_FOR = 0.1  # s
# Sources that fall silent together.
_SILENCES: tuple[tuple[Any, ...], ...] = (
    (VehicleFaultKind.SILENT_ESTIMATE,),
    (VehicleFaultKind.SILENT_STATUS,),
    (VehicleFaultKind.SILENT_ESTIMATE, VehicleFaultKind.SILENT_STATUS),
    (RadioFaultKind.UNACKNOWLEDGED,),
)

_STALL, _MAIN, _PILOT = "stall", "main process killed", "pilot killed"

# Kind, and the least and greatest size if it has one.
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
class Settings:
    """The flights to draw."""

    path_files: tuple[Path, ...] = argument()
    flights: int = option(10_000, "Flights with random faults.", least=1)
    seed: int = option(0, "Seed of the first flight.", least=0)
    random_paths: int = option(0, "Small paths of two or three waypoints, beside those given.", least=0)


class _Grouped(NamedTuple):
    """A flight as a member of one group; it may belong to several."""

    group: str
    flight: FaultFlight


COLUMNS = (
    Column("group", "flights with"),
    Column("flights", "flights", value=count()),
    Column("to_wall", "to the wall", "m", ".2f", meaning="the least of all flights; negative: beyond it",
           value=smallest("flight.to_wall")),
    Column("off_plan", "off the path", "cm", ".0f", meaning="the largest of all flights",
           value=largest("flight.off_plan")),
    Column("outside", "outside the walls", value=count(lambda row: row.flight.to_wall <= 0.0)),
    Column("armed", "not disarmed", meaning="or not on the floor with its motors off",
           value=count(lambda row: not (row.flight.landed and row.flight.disarmed))),
    Column("unreadable", "record not readable", value=count(lambda row: not row.flight.readable)),
)  # fmt: skip
FLIGHT_COLUMNS = (
    Column("seed", "seed"),
    Column("path", "path"),
    Column("phase", "phase"),
    Column("faults", "faults", meaning="size, length, and when it began after the first",
           value=lambda rows: rows[0].name),
    Column("rung", "rung", meaning="the lowest of the abort ladder that the pilot took"),
    Column("to_wall", "to the wall", "m", ".3f", meaning="least distance of the true position; negative: beyond"),
    Column("end", "end", value=lambda rows: _end(rows[0])),
)  # fmt: skip


def _end(flight: FaultFlight) -> str:
    ends = (("landed", flight.landed), ("disarmed", flight.disarmed), ("readable record", flight.readable))
    return ", ".join(text if holds else f"not {text}" for text, holds in ends)


def work(settings: Settings, run: Run) -> Work:
    """Return one case per seed; the missions are the same for all. Raises what preparing raises."""
    missions = prepare_missions(settings.path_files, settings.random_paths)
    seeds = range(settings.seed, settings.seed + settings.flights)
    return Work({str(seed): seed for seed in seeds}, partial(fly_random, missions=missions), FaultFlight)


def prepare_missions(path_files: Sequence[Path], random_paths: int = 0) -> dict[str, Mission]:
    """Prepare each path once, as for a flight, and small random ones under the limits of the first.

    Random paths that are refused are left out. Raises what preparing raises for the others.
    """
    missions = {file.stem: prepare_flight(file, limits_for(file), PATIENT).mission for file in path_files}
    limits = limits_for(path_files[0])
    space = limits.space
    box = np.array([np.array(space.low) + space.margin, np.array(space.high) - space.margin])
    with tempfile.TemporaryDirectory() as folder:
        for seed in itertools.count():
            if len(missions) >= len(path_files) + random_paths:
                break
            file = Path(folder) / f"small-{seed}.yaml"
            points = random_waypoints(seed, box, (2, 3)).round(3).tolist()
            file.write_text(f"name: {file.stem}\nwaypoints: {points}\n", encoding="utf-8")
            with contextlib.suppress(InfeasibleError, NotCertifiedError):
                missions[file.stem] = prepare_flight(file, limits, PATIENT).mission
    return missions


def random_scenario(seed: int, mission: Mission) -> Scenario:
    """Draw the faults of flight number `seed` along a mission, and the place of the vehicle before it."""
    chance = np.random.default_rng(seed)
    phase, within = _PHASES[chance.integers(len(_PHASES))]
    moment = float(chance.uniform(0.0, min(within, mission.duration)))
    many = 1 + int(chance.choice(len(_MANY), p=_MANY))
    texts, faults, changes = list[str](), list[Fault](), dict[str, Any]()
    for place, number in enumerate(chance.choice(len(_KINDS), size=many, replace=False)):
        kind, least, most = _KINDS[number]
        start = float(chance.uniform(0.0, _APART)) if place else 0.0
        length = (
            FOR_GOOD if chance.random() < _FRACTION_FOR_GOOD else float(_LENGTH * np.exp(_SPREAD * chance.normal()))
        )
        size = float(chance.uniform(least, most)) if most > least else None
        if kind is _STALL:
            length = min(length, _LONGEST_STALL)
            changes |= {"stall": length, "stall_after": start}
        elif kind is _MAIN:
            changes |= {"main_killed": True, "main_killed_after": start}
        else:
            faults.append(_fault(kind, start, length, size))
        texts.append(_text(kind, start, length, size))
    if chance.random() < _FRACTION_DEAD:
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
    """Return the scenario; for a fraction of the seeds, logs or acknowledgements fall silent as well."""
    chance = np.random.default_rng((seed, 1))
    if chance.random() > _FRACTION_SILENT:
        return scenario
    kinds = _SILENCES[chance.integers(len(_SILENCES))]
    start = float(chance.uniform(0.0, _APART))
    length = FOR_GOOD if chance.random() < 0.5 else float(_LENGTH * np.exp(_SPREAD * chance.normal()))
    spans = [(start, length)]
    if chance.random() < _FRACTION_FLAPPING:
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
    fault: Fault = _GROUPS[type(kind)][1](kind, start, length, size)
    return fault


def _text(kind: Any, start: float, length: float, size: float | None) -> str:
    text = f"{_GROUPS.get(type(kind), ('computer',))[0]}:{str(kind).replace(' ', '-')}"
    if size is not None:
        text += f" {size:.2f}"
    if kind not in (_MAIN, _PILOT):
        text += " for good" if length >= FOR_GOOD else f" for {length:.2f} s"
    return f"{text} after {start:.2f} s" if start else text


def fly_random(seed: int, missions: Mapping[str, Mission]) -> FaultFlight:
    """Fly flight number `seed` along one of the paths, and record it."""
    names = sorted(missions)
    name = names[seed % len(names)]
    scenario = with_silence(random_scenario(seed, missions[name]), seed)
    return replace(fly_scenario(scenario, missions[name], seed), seed=seed, path=name)


def tables(settings: Settings, rows: list[FaultFlight]) -> Iterator[Table]:
    """Yield the flights by number of faults, kind and phase, those nearest to a wall, and the failed ones."""
    outside, bad = sum(row.to_wall <= 0.0 for row in rows), [row for row in rows if row.bad]
    title, phases = f"{len(rows)} flights, {outside} outside the walls", list(map(str, Phase))
    counted = sorted(((len(_kinds(row)), row) for row in rows), key=itemgetter(0))
    by_count = [_Grouped("1 fault" if many == 1 else f"{many} faults", row) for many, row in counted]
    by_kind = [_Grouped(kind, row) for row in rows for kind in dict.fromkeys(_kinds(row))]
    by_phase = [_Grouped(row.phase, row) for row in sorted(rows, key=lambda row: phases.index(row.phase))]
    yield table("all", title, COLUMNS, by_count, by=("group",), last="random faults")
    yield table("kinds", "By kind of fault", COLUMNS, sorted(by_kind, key=attrgetter("group")), by=("group",))
    yield table("phases", "By the phase in which it began", COLUMNS, by_phase, by=("group",))
    yield table("worst", "Nearest to a wall", FLIGHT_COLUMNS, sorted(rows, key=attrgetter("to_wall"))[:_WORST])
    yield table("bad", f"{len(bad)} flights went wrong", FLIGHT_COLUMNS, bad)


def _kinds(flight: FaultFlight) -> list[str]:
    """Return the kinds of its faults."""
    return [fault.split(" ", 1)[0] for fault in flight.name.split(" + ")]


STUDY = Study(Settings, work, tables, "flights/*.yaml --random-paths 12 --workers 2 -o results/random-faults.json")
