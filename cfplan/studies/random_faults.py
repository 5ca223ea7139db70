"""Fly with random faults in the stepped lab: kind, moment, length and size are drawn by a seed. None may leave.

A dead pilot is not among the faults: the vehicle then acts by its own time-outs.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from cfplan.flight.pilot.mission import Mission
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.telemetry import Phase
from cfplan.simulation.lab.lab import Fault
from cfplan.simulation.lab.radio import RadioFault, RadioFaultKind
from cfplan.simulation.virtual_crazyflie.faults import VehicleFault, VehicleFaultKind
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_vicon.faults import FaultKind, ViconFault
from cfplan.studies.fault_scenarios import Scenario
from cfplan.studies.faults import FaultFlight, fly_stepped, judge
from cfplan.studies.result import Column, StudyResult, Table, detail_table

_LENGTH, _SPREAD = 0.5, 1.2  # s and its logarithm's deviation: a twentieth of a second to some seconds
_WHILE_FLYING = (Phase.TAKE_OFF, Phase.GO_TO_START, Phase.STREAM, Phase.STREAM, Phase.STREAM, Phase.HOLD, Phase.LAND)
_STALL, _MAIN = "stall", "main process killed"

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
_LONGEST_STALL = 1.9  # s; what stands still for longer is as good as dead: the vehicle stops its motors after 2 s


COLUMNS = (
    Column("kind", "fault"),
    Column("flights", "flights"),
    Column("rungs", "rungs", meaning="of the abort ladder"),
    Column("off_plan", "off the path", "cm", ".0f", meaning="the largest of all flights"),
    Column("to_wall", "to the wall", "m", ".2f", meaning="the least of all flights"),
    Column("not_landed", "not landed"),
)


def random_scenario(seed: int, duration: float) -> Scenario:
    """Draw the fault of flight number `seed`, along a path of `duration` s."""
    chance = np.random.default_rng(seed)
    kind, least, most = _KINDS[chance.integers(len(_KINDS))]
    phase = _WHILE_FLYING[chance.integers(len(_WHILE_FLYING))]
    moment = float(chance.uniform(0.0, duration if phase is Phase.STREAM else 1.5))
    length = float(_LENGTH * np.exp(_SPREAD * chance.normal()))
    size = float(chance.uniform(least, most)) if most > least else None
    faults: tuple[Fault, ...] = ()
    if isinstance(kind, FaultKind):
        faults = (ViconFault(kind, 0.0, length, size),)
    elif isinstance(kind, RadioFaultKind):
        faults = (RadioFault(kind, 0.0, length, size),)
    elif isinstance(kind, VehicleFaultKind):
        faults = (VehicleFault(kind, 0.0, length, size),)
    what = str(kind).replace(" ", "-")
    of_size = f" {size:.2f}" if size is not None else ""
    group = {FaultKind: "pose", RadioFaultKind: "radio", VehicleFaultKind: "vehicle"}.get(type(kind), "computer")
    return Scenario(
        name=f"{group}:{what}{of_size} for {length:.2f} s, {moment:.2f} s into {phase}, seed {seed}",
        rung=Rung.NONE,
        faults=faults,
        phase=phase,
        moment=moment,
        stall=min(length, _LONGEST_STALL) if kind is _STALL else 0.0,
        main_killed=kind is _MAIN,
        vehicle=VehicleSettings(auto_arming=False, seed=seed),
    )


def fly_random(seed: int, missions: Mapping[str, Mission]) -> tuple[str, FaultFlight]:
    """Fly flight number `seed` along one of the paths; return that path's name and the flight."""
    names = sorted(missions)
    name = names[seed % len(names)]
    scenario = random_scenario(seed, missions[name].duration)
    return name, judge(scenario, fly_stepped(scenario, missions[name], seed=seed), missions[name], readable=False)


def random_flights(
    missions: Mapping[str, Mission],
    *,
    seeds: Sequence[int],
    jobs: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> StudyResult:
    """Fly a fault for each seed, on `jobs` processes."""
    from joblib import Parallel, delayed

    flown = []
    work = Parallel(n_jobs=jobs, return_as="generator")(delayed(fly_random)(seed, missions) for seed in seeds)
    for done, flight in enumerate(work):
        progress(done + 1, len(seeds))
        flown.append(flight)
    detail = detail_table("flights", [{"path": path} | asdict(flight) for path, flight in flown])
    settings = {"paths": sorted(missions), "first_seed": seeds[0] if seeds else 0, "flights": len(seeds)}
    return StudyResult("random-faults", settings, (kinds_table([flight for _, flight in flown]),), (detail,))


def kinds_table(flights: Sequence[FaultFlight]) -> Table:
    """Return rungs and distances by kind of fault."""
    rows = []
    for kind in dict.fromkeys(_kind(flight) for flight in flights):
        of_kind = [flight for flight in flights if _kind(flight) == kind]
        rungs = Counter(flight.rung for flight in of_kind)
        rows.append(
            {
                "kind": kind,
                "flights": len(of_kind),
                "rungs": ", ".join(f"{count} {rung}" for rung, count in rungs.items()),
                "off_plan": max(flight.off_plan for flight in of_kind),
                "to_wall": min(flight.to_wall for flight in of_kind),
                "not_landed": sum(not (flight.landed and flight.disarmed) for flight in of_kind),
            }
        )
    outside = sum(flight.to_wall < 0 for flight in flights)
    return Table("kinds", f"{len(flights)} random faults, {outside} outside the walls", COLUMNS, tuple(rows))


def _kind(flight: FaultFlight) -> str:
    return flight.name.split(" ", 1)[0]
