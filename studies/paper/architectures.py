"""The paper's Table 1: networks of four architectures, TOPPQuad and the expert on the same paths.

Beside it the planner that ships, on a vehicle as it is: certified for motors that take 0.072 s to follow, sent as
bytes, flown in the dry run.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from cfplan.errors import CfplanError, InputError
from cfplan.flight.setpoints.encoding import check_bytes, encode_trajectory
from cfplan.geometry.path import Path
from cfplan.geometry.yaw import YawMode
from cfplan.learning.learned import plan_learned
from cfplan.learning.paper.networks import Kind
from cfplan.learning.paper.training import SequenceOptions
from cfplan.planners.expert.expert import plan_expert
from cfplan.planners.task import PlanningTask
from cfplan.planning.repair import refine, repair
from cfplan.safety.limit_sets import LIMIT_SETS, PAPER
from cfplan.safety.limits import FlightLimits, Ladder
from cfplan.simulation.dry_run import dry_run
from cfplan.simulation.geometric_flight import LOST, thrust_violation
from studies.runner.items import HERE, Progress, Running, work_table, work_through
from studies.paper.networks import (
    DATA,
    NETWORKS,
    PaperData,
    PaperItem,
    TrainedNetwork,
    identities,
    paper_data,
    paper_items,
    trained_networks,
)
from studies.paper.printed import ARCHITECTURES
from studies.paper.trials import (
    PAPER_LAG,
    SAMPLE,
    TOPPQUAD,
    PaperTrial,
    path_trials,
    planner_columns,
    planner_row,
    planners,
    profile_of,
)
from studies.runner.result import Column, StudyResult, Table, detail_table
from cfplan.vehicle.trajectory import Trajectory

SHIPPED_LIMITS = LIMIT_SETS["simulation"]
SHIPPED_NODES = 100


@dataclass(frozen=True, slots=True)
class ShippedFlight:
    """One path flown by the planner that ships, on motors as they are. NaN where there was nothing to measure."""

    part: str
    row: int
    reason: str = ""  # why there was no flight, or why it failed
    expert_time: float = np.nan  # s, certified, within the same limits
    travel_time: float = np.nan  # s
    violation: float = np.nan  # N, planned beyond a motor's range
    deviation: float = np.nan  # m


SHIPPED_COLUMNS = (
    Column("part", "paths"),
    Column("paths"),
    Column("failed", "failures", of="paths", goal="0", meaning=f"no flight, a crash, or {LOST:g} m from its place"),
    Column("violation", "thrust violation, planned", "N", ".3f", goal="0.000 N"),
    Column("slower", "time over the expert: mean", "%", "+.3f", goal="±0.5 %", meaning="both certified, same limits"),
    Column("slower_most", "time over the expert: largest", "%", "+.3f", goal="±0.5 %"),
    Column("deviation", "largest deviation: mean", "m", ".3f", goal="0.143 m", meaning="the paper's, at a lag of 5 ms"),
    Column("deviation_most", "largest deviation: of all", "m", ".3f"),
)  # fmt: skip


def architectures(
    *,
    paths: int = 100,
    kinds: Sequence[str] = tuple(Kind),
    data: FilePath = DATA,
    networks: FilePath = NETWORKS,
    epochs: int | None = None,
    quick: bool = False,
    running: Running = HERE,
    progress: Progress = lambda done, total: None,
) -> StudyResult:
    """Compare the architectures on `paths` paths for training and for testing each; networks are trained if need be.

    Raises:
        InputError: an unknown architecture, no such dataset, or fewer paths in it.
    """
    for name in kinds:
        if name not in tuple(Kind):
            raise InputError(f"unknown architecture {name!r}", where="kinds", hint=f"known: {', '.join(Kind)}")
    wanted = [SequenceOptions(kind=Kind(name)) for name in kinds]
    with paper_data(data, networks, paths, epochs=epochs, quick=quick) as material:
        trained = trained_networks(material, wanted, progress)
        settings = settings_of(material, quick)
        work = work_through(
            "architectures", settings | {"networks": identities(trained)}, partial(_trials_of, trained),
            paper_items(material), running, progress,
        )  # fmt: skip
    trials = [PaperTrial(**trial) for value in work.values for trial in value["trials"]]
    flights = [ShippedFlight(**value["shipped"]) for value in work.values]
    tables = (
        *planner_tables(trials, list(planners(trained)), "architectures", "network", ARCHITECTURES),
        *shipped_tables(flights), training_table(trained, material),
    )  # fmt: skip
    steps = training_steps(trained, settings["learned_from"]) | {"path": (len(work.values), work.seconds)}
    details = (detail_table("trials", trials), detail_table("shipped-flights", flights), work_table(steps))
    return StudyResult("architectures", settings, tables, details, work.interrupted)


def _trials_of(networks: Sequence[TrainedNetwork], item: PaperItem) -> dict[str, Any]:
    return {"trials": path_trials(planners(networks), *item), "shipped": _shipped(item.part, item.row, amid(item.path))}


def settings_of(data: PaperData, quick: bool) -> dict[str, Any]:
    """Return what a run was made with."""
    spec = data.learned_from.spec
    return {
        "paths": {part: len(sequences.rows) for part, sequences in data.parts.items()},
        "learned_from": len(data.learned_from.rows),
        "labels": spec.planner,
        "seed": spec.seed,
        "motor_lag": PAPER_LAG,
        "quick": quick,
    }


def planner_tables(
    trials: Sequence[PaperTrial], names: Sequence[str], name: str, what: str,
    printed: Any,
) -> tuple[Table, Table]:  # fmt: skip
    """Return the table of the paper with raw plans, and that after repair."""
    rows: dict[bool, list[dict[str, Any]]] = {False: [], True: []}
    for repaired, into in rows.items():
        for planner in names:
            for part in dict.fromkeys(trial.part for trial in trials):
                own = [t for t in trials if (t.planner, t.part, t.repaired) == (planner, part, repaired)]
                reference = [t for t in trials if (t.planner, t.part, t.repaired) == (TOPPQUAD, part, False)]
                if own:
                    into.append(planner_row(own, reference, None if repaired else printed.get((planner, part))))
    columns = planner_columns(what)
    bare = tuple(column for column in columns if not column.key.startswith("paper_"))
    title = f"as planned, {PAPER.limits.speed:g} m/s, motor lag {PAPER_LAG:g} s"
    return (
        Table(name, f"The paper's table, {title}", columns, tuple(rows[False])),
        Table(
            f"{name}-repaired", f"After cfplan's repair, {title}".replace("as planned, ", ""), bare, tuple(rows[True])
        ),
    )


def training_steps(
    trained: Sequence[TrainedNetwork], learned_from: int, where: str = ""
) -> dict[str, tuple[int, float]]:
    """Return what each training took: how many paths went through the network, and the seconds of all."""
    return {
        f"path through {where}{each.name}": (each.options.epochs * learned_from, each.training_seconds)
        for each in trained
    }


def training_table(trained: Sequence[TrainedNetwork], data: PaperData) -> Table:
    """Return the size and the training of each network."""
    columns = (
        Column("network", "network"), Column("parameters", "parameters"), Column("learned_from", "paths learned from"),
        Column("epochs", "epochs"), Column("seconds", "training", "s", ".0f", meaning="of the processor, one thread"),
    )  # fmt: skip
    rows = [
        {
            "network": each.name,
            "parameters": sum(tensor.numel() for tensor in each.network.parameters()),
            "learned_from": len(data.learned_from.rows),
            "epochs": each.options.epochs,
            "seconds": each.training_seconds,
        }
        for each in trained
    ]
    return Table("training", "Networks and their training", columns, tuple(rows))


def amid(path: Path) -> Path:
    """Return the path in the middle of its room: a packet holds no place farther than 32.8 m from the room's origin."""
    places = path(np.linspace(0.0, path.end, 1000))
    return path.placed(-0.5 * (places.min(axis=0) + places.max(axis=0)))


def _shipped(part: str, row: int, path: Path) -> ShippedFlight:
    airframe, limits = SHIPPED_LIMITS.airframe, SHIPPED_LIMITS.limits
    known: dict[str, Any] = {"part": part, "row": row}
    try:
        task = PlanningTask(path, airframe, limits, SHIPPED_NODES, YawMode.FIXED)
        known["expert_time"] = repair(task, profile_of(plan_expert, task)).trajectory.duration
        trajectory = refine(task, profile_of(plan_learned, task)).trajectory
        known |= {"travel_time": trajectory.duration, "violation": _planned_violation(trajectory)}
        encoded = encode_trajectory(trajectory)
        check_bytes(encoded, trajectory, limits)
        run = dry_run(encoded, trajectory, airframe, lost_alone())
        return ShippedFlight(**known, reason=run.reason, deviation=run.deviation)
    except CfplanError as error:
        return ShippedFlight(**known, reason=str(error))


def _planned_violation(trajectory: Trajectory) -> float:
    state = trajectory.at(np.arange(0.0, trajectory.duration, SAMPLE))
    return thrust_violation(state.motor_thrust, trajectory.airframe)


def lost_alone() -> FlightLimits:
    """Return limits by which a flight is over when it is LOST, and by nothing else."""
    never = Ladder(np.inf, np.inf, np.inf)
    return FlightLimits(
        deviation=Ladder(LOST, LOST, LOST), fence=never, speed=never, acceleration=never, angular_velocity=never,
        patience=1.0,
    )  # fmt: skip


def shipped_tables(flights: Sequence[ShippedFlight]) -> tuple[Table, ...]:
    """Return the figures of the planner that ships; none without flights."""
    rows = []
    for part in dict.fromkeys(flight.part for flight in flights):
        own = [flight for flight in flights if flight.part == part]
        slower = np.array([f.travel_time / f.expert_time - 1.0 for f in own if np.isfinite(f.travel_time)] or [np.nan])
        away = np.array([f.deviation for f in own if np.isfinite(f.deviation)] or [np.nan])
        rows.append({
            "part": part, "paths": len(own), "failed": sum(bool(f.reason) for f in own),
            "violation": float(np.mean([f.violation for f in own if np.isfinite(f.violation)] or [np.nan])),
            "slower": slower.mean(), "slower_most": slower[np.argmax(np.abs(slower))],
            "deviation": away.mean(), "deviation_most": away.max(),
        })  # fmt: skip
    lag = SHIPPED_LIMITS.airframe.motor_time_constant
    title = f"The planner that ships, within the simulation limits, flown as bytes, motor lag {lag:g} s"
    return (Table("shipped", title, SHIPPED_COLUMNS, tuple(rows), across=True),) if rows else ()
