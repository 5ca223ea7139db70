"""Flights of the paper's tables by bodies of other simulators: what they say beside cfplan's own.

The paper flies in RotorPy. Here some flights of each kind of table are flown by RotorPy too, with two motor lags, and
by drone-models where it has numbers of the vehicle. Who flies is the same as in the table: the geometric controller, or
the firmware's with the same bytes.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path as FilePath
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import CfplanError, InputError
from cfplan.flight.setpoints.encoding import EncodedFlight, encode_trajectory
from cfplan.flight.setpoints.rate_trade import gains_under
from cfplan.geometry.path import Path
from cfplan.geometry.yaw import YawMode
from cfplan.learning.learned import plan_learned
from cfplan.learning.paper.training import SequenceOptions
from cfplan.planners.baselines.toppquad import plan_toppquad
from cfplan.planners.expert.expert import plan_expert
from cfplan.planners.task import PlanningTask
from cfplan.planning.plan import plan
from cfplan.planning.repair import refine, repair
from cfplan.preparation.plan_flight import PlannedFlight, give_way
from cfplan.preparation.prepare_flight import encode_flight
from cfplan.safety.limit_sets import PAPER
from cfplan.safety.limits_file import DEFAULTS, load_limits
from cfplan.simulation.geometric_flight import LOST, positions_by_both
from studies.runner.items import HERE, Progress, Running, work_table, work_through
from studies.paper.architectures import SHIPPED_LIMITS, SHIPPED_NODES, amid, lost_alone
from studies.paper.hardware import TRACKED, hardware_paths, paper_limits
from studies.paper.networks import (
    DATA,
    NETWORKS,
    NODES,
    TrainedNetwork,
    identities,
    paper_data,
    trained_networks,
)
from studies.paper.printed import TEST
from studies.paper.trials import (
    EXPERT,
    TOPPQUAD,
    finite_mean,
    network_plan,
    paper_task,
    profile_by,
    profile_of,
    shipped_profile,
)
from studies.physics import bodies_for, compared
from studies.runner.result import Column, StudyResult, Table, detail_table
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.trajectory import Trajectory

PLANNED, SHIPPED, HARDWARE = "Tables 1 to 3", "Table 1, the planner that ships", "hardware"
SHIPPED_PLANNER = "the shipped planner"
NETWORK, CERTIFIED_NETWORK = "LSTM", "LSTM, certified"
ROWS = (
    (PLANNED, TOPPQUAD), (PLANNED, EXPERT), (PLANNED, NETWORK), (PLANNED, CERTIFIED_NETWORK),
    (PLANNED, SHIPPED_PLANNER), (SHIPPED, SHIPPED_PLANNER), (HARDWARE, TOPPQUAD), (HARDWARE, SHIPPED_PLANNER),
)  # fmt: skip


class Sent(NamedTuple):
    """What is flown of a path, as bytes."""

    encoded: EncodedFlight
    trajectory: Trajectory
    airframe: Airframe


@dataclass(frozen=True, slots=True)
class BodyFlight:
    """One flight by one body; NaN where there was none."""

    table: str
    planner: str
    path: str
    body: str
    reason: str = ""  # why there is no flight
    deviation: float = np.nan  # m
    own_deviation: float = np.nan  # m, by cfplan's body with the same motor lag
    apart: float = np.nan  # m, largest distance of the two at the same time

    @property
    def failed(self) -> bool:
        """Return whether there was no flight, or it was LOST."""
        return not self.deviation < LOST

    @property
    def own_failed(self) -> bool:
        """Return whether cfplan says so."""
        return not self.own_deviation < LOST


def simulators(
    *,
    paths: int = 8,
    data: FilePath = DATA,
    networks: FilePath = NETWORKS,
    epochs: int | None = None,
    quick: bool = False,
    running: Running = HERE,
    progress: Progress = lambda done, total: None,
) -> StudyResult:
    """Fly `paths` paths of each kind of table on every body that is installed; the LSTM is trained if need be.

    Raises:
        InputError: no such dataset or fewer paths in it, or neither RotorPy nor drone-models is installed.
    """
    usual, missing = load_limits(DEFAULTS), list[str]()
    if not bodies_for(usual.airframe, missing):
        raise InputError("; ".join(dict.fromkeys(missing)), hint="pip install rotorpy==3.0.0 drone-models==0.1.0")
    with paper_data(data, networks, paths, epochs=epochs, quick=quick) as material:
        (network,) = trained_networks(material, [SequenceOptions()], progress)
        tested = {
            str(row): path for row, path in zip(material.parts[TEST].rows, material.parts[TEST].paths, strict=True)
        }
        room = hardware_paths(usual, len(tested))
        items = {
            f"{table}, {planner}, {name}": (table, planner, name, path)
            for table, planner in ROWS
            for name, path in (room if table == HARDWARE else tested).items()
        }
        settings = {"paths": len(tested), "quick": quick}
        known = settings | {"networks": identities([network])}
        work = work_through("simulators", known, partial(_flights, network), items, running, progress)
    flights = [BodyFlight(**flight) for value in work.values for flight in value]
    details = (detail_table("flights", flights), work_table({"flight": (len(work.values), work.seconds)}))
    return StudyResult("simulators", settings, (bodies_table(flights),), details, work.interrupted)


def _flights(network: TrainedNetwork, item: tuple[str, str, str, Path]) -> list[BodyFlight]:
    table, planner, name, path = item
    begun = BodyFlight(table, planner, name, "")
    try:
        if table == PLANNED:
            return list(_by_geometric_controller(begun, _planned(network, planner, path)))
        return list(_by_bytes(begun, _SENT[table](planner, path)))
    except CfplanError as error:
        return [replace(begun, reason=str(error))]


def _by_geometric_controller(begun: BodyFlight, trajectory: Trajectory) -> Iterator[BodyFlight]:
    for other in bodies_for(PAPER.airframe, []):
        wanted, theirs, own = positions_by_both(other.step, trajectory, other.airframe)
        yield replace(
            begun, body=other.name, deviation=_largest(theirs - wanted), own_deviation=_largest(own - wanted),
            apart=_largest(theirs - own),
        )  # fmt: skip


def _largest(errors: NDArray) -> float:
    return float(np.linalg.norm(errors, axis=1).max())


def _by_bytes(begun: BodyFlight, sent: Sent) -> Iterator[BodyFlight]:
    for other in bodies_for(sent.airframe, []):
        flown = compared(begun.path, sent.encoded, sent.trajectory, other, sent.airframe, lost_alone())
        yield replace(
            begun, body=other.name, deviation=flown.deviation, own_deviation=flown.own_deviation, apart=flown.apart
        )


def _planned(network: TrainedNetwork, planner: str, path: Path) -> Trajectory:
    asked = network_plan(network)
    profiles: dict[str, Callable[[Path], SpeedProfile]] = {
        TOPPQUAD: profile_by(plan_toppquad), EXPERT: profile_by(plan_expert), NETWORK: asked,
        CERTIFIED_NETWORK: lambda path: repair(paper_task(path), asked(path)).trajectory.profile,
        SHIPPED_PLANNER: shipped_profile,
    }  # fmt: skip
    return Trajectory(path, profiles[planner](path), PAPER.airframe)


def _shipped(_: str, path: Path) -> Sent:
    path = amid(path)
    task = PlanningTask(path, SHIPPED_LIMITS.airframe, SHIPPED_LIMITS.limits, SHIPPED_NODES, YawMode.FIXED)
    trajectory = refine(task, profile_of(plan_learned, task)).trajectory
    return Sent(encode_trajectory(trajectory), trajectory, SHIPPED_LIMITS.airframe)


def _hardware(planner: str, path: Path) -> Sent:
    limits = paper_limits(load_limits(DEFAULTS), TRACKED)
    if planner == TOPPQUAD:
        task = PlanningTask(path, limits.airframe, limits.plan, NODES, YawMode.FREE)
        trajectory = Trajectory(path, profile_of(plan_toppquad, task), limits.airframe)
        encoded = encode_trajectory(trajectory, gains=gains_under(limits), space=limits.space)
        return Sent(encoded, trajectory, limits.airframe)
    found = give_way(plan(path, limits.airframe, limits, yaw=YawMode.FREE))[0]
    return Sent(encode_flight(PlannedFlight(planner, found, limits)), found.trajectory, limits.airframe)


_SENT = {SHIPPED: _shipped, HARDWARE: _hardware}


def bodies_table(flights: Sequence[BodyFlight]) -> Table:
    """Return, for each planner and body, what the body says, what cfplan says, and how far apart they are."""
    columns = (
        Column("table", "table"),
        Column("planner", "planner"),
        Column("body", "body"),
        Column("paths"),
        Column("deviation", "largest deviation", "m", ".3f", meaning=f"mean; a failure counts as {LOST:g} m"),
        Column("own_deviation", "cfplan's body", "m", ".3f", meaning="the same, with the same motor lag"),
        Column("failed", "failures", of="paths", meaning=f"no plan, a crash, or {LOST:g} m from its place"),
        Column("own_failed", "cfplan's", of="paths"),
        Column("apart", "apart", "m", ".3f", meaning="the two at the same time, at most; mean where none failed"),
        Column("apart_most", "at most", "m", ".3f"),
    )  # fmt: skip
    return Table("simulators", "Flights of the tables by bodies of other simulators", columns, tuple(_rows(flights)))


def _rows(flights: Sequence[BodyFlight]) -> Iterator[Mapping[str, Any]]:
    for table, planner in ROWS:
        of_row = [flight for flight in flights if (flight.table, flight.planner) == (table, planner)]
        for body in dict.fromkeys(flight.body for flight in of_row if flight.body):
            own = [flight for flight in of_row if flight.body in ("", body)]
            both = [flight.apart for flight in own if not (flight.failed or flight.own_failed)]
            yield {
                "table": table, "planner": planner, "body": body, "paths": len(own),
                "deviation": finite_mean(LOST if flight.failed else flight.deviation for flight in own),
                "own_deviation": finite_mean(LOST if flight.own_failed else flight.own_deviation for flight in own),
                "failed": sum(flight.failed for flight in own), "own_failed": sum(flight.own_failed for flight in own),
                "apart": finite_mean(both), "apart_most": max(both, default=np.nan),
            }  # fmt: skip
