"""Repeat flights of the paper's tables with the bodies of RotorPy, at two motor lags, and of drone-models.

The paper flies in RotorPy. This study flies Tables 1 to 3 in RotorPy with the motor lag of its version then, and a
sample of each kind of table with RotorPy's present lag too, and in drone-models where it knows the vehicle. The
controller is the same as in the table: the geometric one, or the firmware's with the same packets.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import CfplanError, InputError
from cfplan.flight.setpoints.encoding import EncodedFlight, encode_trajectory
from cfplan.geometry.path import Path
from cfplan.learning.learned import plan_learned
from cfplan.planners.baselines.toppquad import plan_toppquad
from cfplan.planners.expert.expert import plan_expert
from cfplan.planning.repair import refine
from cfplan.safety.limit_sets import PAPER
from cfplan.safety.limits import Limits
from cfplan.safety.limits_file import DEFAULTS, load_limits
from cfplan.simulation.geometric_flight import LOST, positions_by_both
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.trajectory import Trajectory
from studies.paper.architectures import SHIPPED_LIMITS, amid, shipped_task
from studies.paper.hardware import CERTIFIED, RAW, TRACKED, encoded_plan, hardware_paths, paper_limits
from studies.paper.printed import TEST
from studies.paper.trained import NetworkSettings, TrainedNetwork, paper_data
from studies.paper.training import OURS, SequenceOptions
from studies.paper.trials import (
    DEVIATION,
    DEVIATION_P90,
    EXPERT,
    FAILED,
    PAPER_LAG,
    TOPPQUAD,
    Plan,
    flown,
    network_plan,
    profile_by,
    profile_of,
    shipped_profile,
)
from studies.physics import BODIES, OtherBody, compared
from studies.runner.options import option
from studies.runner.reductions import among, count, largest, mean
from studies.runner.result import Column, Table, table
from studies.runner.study import Run, Study, Work

PLANNED, SHIPPED, HARDWARE = "Tables 1 to 3", "Table 1, the planner that ships", "hardware"
SHIPPED_PLANNER = "the shipped planner"
NETWORKS = (SequenceOptions(), OURS)
PLANNERS = {
    PLANNED: (TOPPQUAD, EXPERT, *(each.name for each in NETWORKS), SHIPPED_PLANNER),
    SHIPPED: (SHIPPED_PLANNER,),
    HARDWARE: (TOPPQUAD, SHIPPED_PLANNER),
}


@dataclass(frozen=True, slots=True)
class Settings(NetworkSettings):
    """The paths to fly."""

    paths: int = option(100, "Paths of Tables 1 to 3, flown in RotorPy with the paper's motor lag.", least=1)
    others: int = option(6, "Paths of each other table, and of Tables 1 to 3 with the other bodies.", least=1)


class Asked(NamedTuple):
    """One path of a table, and one of its planners."""

    table: str
    planner: str
    name: str
    path: Path
    all_bodies: bool = True  # or RotorPy with the paper's motor lag alone


@dataclass(frozen=True, slots=True)
class BodyFlight:
    """One flight with one body; NaN where there was none."""

    table: str
    planner: str
    path: str
    body: str
    reason: str = ""  # why there is no flight; empty if there is one
    deviation: float = np.nan  # m
    own_deviation: float = np.nan  # m, by cfplan's body with the same motor lag
    apart: float = np.nan  # m, largest distance of the two at the same time

    @property
    def own_failed(self) -> bool:
        """Return whether the flight with cfplan's body was LOST or missing."""
        return not self.own_deviation < LOST

    @property
    def both_flown(self) -> bool:
        """Return whether neither body's flight was LOST."""
        return flown(self) and not self.own_failed


COLUMNS = (
    Column("table", "table"),
    Column("planner", "planner"),
    Column("body", "body"),
    Column("paths", value=count()),
    DEVIATION,
    DEVIATION_P90,
    Column("own_deviation", "cfplan's body", "m", ".3f", meaning="the same, with the same motor lag",
           value=mean(lambda flight: LOST if flight.own_failed else flight.own_deviation)),
    FAILED,
    Column("own_failed", "cfplan's", of="paths", value=count("own_failed")),
    Column("apart", "apart", "m", ".3f", meaning="the two at the same time, at most; mean where none failed",
           value=among("both_flown", mean("apart"))),
    Column("apart_most", "at most", "m", ".3f", value=among("both_flown", largest("apart"))),
)  # fmt: skip


def work(settings: Settings, run: Run) -> Work:
    """Return one case per path and planner of each table; the networks are trained if necessary.

    Raises:
        InputError: neither RotorPy nor drone-models is installed; also as `paper_data`.
    """
    usual = _room_limits()
    bodies_for(usual.airframe)
    data = paper_data(settings, run, NETWORKS)
    tested = {str(each.row): each.path for each in data.part(TEST).values()}
    few = dict(islice(tested.items(), settings.others))
    room = hardware_paths(usual, settings.others)
    cases = {
        f"{kind}, {planner}, {name}": Asked(kind, planner, name, path, kind != PLANNED or name in few)
        for kind, names in PLANNERS.items()
        for planner in names
        for name, path in {PLANNED: tested, SHIPPED: few, HARDWARE: room}[kind].items()
    }
    return Work(cases, partial(measure, {each.name: each for each in data.networks}), BodyFlight, data.identity)


def measure(networks: Mapping[str, TrainedNetwork], asked: Asked) -> list[BodyFlight]:
    """Plan a path, and fly it with each body."""
    bodies = [body for body in bodies_for(_airframe(asked.table)) if asked.all_bodies or body.motor_lag == PAPER_LAG]
    begun = [BodyFlight(asked.table, asked.planner, asked.name, body.name) for body in bodies]
    try:
        if asked.table == PLANNED:
            fly = partial(_by_geometric_controller, _planned(networks, asked.planner, asked.path))
        else:
            fly = partial(_by_bytes, *_sent(asked))
        return [fly(flight, body) for flight, body in zip(begun, bodies, strict=True)]
    except CfplanError as error:
        return [replace(flight, reason=str(error)) for flight in begun]


def bodies_for(airframe: Airframe) -> list[OtherBody]:
    """Return the bodies that are available for a vehicle. Raises InputError if there is none."""
    found, reasons = [], []
    for body in BODIES:
        try:
            body.make(airframe)
            found.append(body)
        except InputError as error:
            reasons.append(error.what)
    if not found:
        raise InputError("; ".join(dict.fromkeys(reasons)), hint="pip install rotorpy==3.0.0 drone-models==0.1.0")
    return found


def _airframe(kind: str) -> Airframe:
    return {PLANNED: PAPER.airframe, SHIPPED: SHIPPED_LIMITS.airframe, HARDWARE: _room_limits().airframe}[kind]


def _room_limits() -> Limits:
    """Return those that `cfplan init` writes, with an airframe that has only the effects that other bodies have."""
    limits = load_limits(DEFAULTS)
    return replace(limits, airframe=limits.airframe.simplified())


def _by_geometric_controller(trajectory: Trajectory, begun: BodyFlight, body: OtherBody) -> BodyFlight:
    airframe = trajectory.airframe
    wanted, theirs, own = positions_by_both(body.make(airframe), trajectory, body.beside(airframe))
    return replace(
        begun, deviation=_largest(theirs - wanted), own_deviation=_largest(own - wanted), apart=_largest(theirs - own)
    )


def _largest(errors: NDArray) -> float:
    return float(np.linalg.norm(errors, axis=1).max())


def _by_bytes(encoded: EncodedFlight, trajectory: Trajectory, begun: BodyFlight, body: OtherBody) -> BodyFlight:
    found = compared(begun.path, body, encoded, trajectory, trajectory.airframe)
    return replace(begun, deviation=found.deviation, own_deviation=found.own_deviation, apart=found.apart)


def _planned(networks: Mapping[str, TrainedNetwork], planner: str, path: Path) -> Trajectory:
    plans: dict[str, Plan] = {name: network_plan(each) for name, each in networks.items()}
    plans |= {
        TOPPQUAD: profile_by(plan_toppquad), EXPERT: profile_by(plan_expert), SHIPPED_PLANNER: shipped_profile,
    }  # fmt: skip
    return Trajectory(path, plans[planner](path), PAPER.airframe)


def _sent(asked: Asked) -> tuple[EncodedFlight, Trajectory]:
    """Return the encoded flight along a path, and its trajectory."""
    if asked.table == HARDWARE:
        way, limits = RAW if asked.planner == TOPPQUAD else CERTIFIED, paper_limits(_room_limits(), TRACKED)
        return encoded_plan(way, asked.planner, None, asked.path, limits)
    task = shipped_task(amid(asked.path))
    trajectory = refine(task, profile_of(plan_learned, task)).trajectory
    return encode_trajectory(trajectory), trajectory


def tables(settings: Settings, rows: list[BodyFlight]) -> Iterator[Table]:
    """Yield the deviations of the body and of cfplan's, and their distance, by planner and body."""
    title = "Flights of the tables by bodies of other simulators"
    yield table("simulators", title, COLUMNS, rows, by=("table", "planner", "body"))


STUDY = Study(Settings, work, tables, "--paths 3 --others 1 -o results/simulators.json")
