"""Make the paper's Table 1: networks of four architectures, TOPPQuad, the expert and the shipped network.

A second table shows the shipped planner on a realistic vehicle: certified for a motor time constant of 0.072 s, encoded
in packets, and flown in the dry run. Interrupted training resumes from its last epoch.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType

import numpy as np

from cfplan.errors import CfplanError
from cfplan.flight.setpoints.byte_check import check_bytes
from cfplan.flight.setpoints.encoding import encode_trajectory
from cfplan.geometry.path import Path
from cfplan.geometry.yaw import YawMode
from cfplan.learning.learned import plan_learned
from cfplan.planners.expert.expert import plan_expert
from cfplan.planners.task import PlanningTask
from cfplan.planning.repair import refine, repair
from cfplan.safety.limit_sets import LIMIT_SETS
from cfplan.simulation.dry_run import rehearse_motion
from cfplan.simulation.geometric_flight import LOST, thrust_violation
from cfplan.vehicle.trajectory import Trajectory
from studies.paper.networks import Kind
from studies.paper.printed import ARCHITECTURES
from studies.paper.trained import SEEDS, NetworkSettings, PaperPath, TrainedNetwork, paper_data
from studies.paper.training import OURS, SequenceOptions
from studies.paper.trials import (
    SAMPLE,
    PaperTrial,
    path_trials,
    planner_tables,
    planners,
    profile_of,
    training_table,
)
from studies.runner.limits import lost_alone
from studies.runner.options import option
from studies.runner.reductions import count, farthest, largest, mean
from studies.runner.result import Column, Table, table
from studies.runner.study import Run, Study, Work

SHIPPED_LIMITS = LIMIT_SETS["simulation"]
SHIPPED_NODES = 100
AS_BYTES = "the shipped planner, as bytes"
LOSS_OF_PAPER = replace(OURS, slopes=0.0)  # shows what the loss of OURS changes
OF_KIND = MappingProxyType({kind: SequenceOptions(kind=kind) for kind in Kind} | {OURS.kind: OURS})
SEVERAL = (Kind.LSTM, Kind.BIDIRECTIONAL)  # architectures that are trained with several seeds


@dataclass(frozen=True, slots=True)
class Settings(NetworkSettings):
    """The networks to compare, and the paths."""

    kinds: tuple[Kind, ...] = option(tuple(Kind), "Architecture.")
    seeds: int = option(3, f"{SEEDS} Other architectures are trained once.", least=1)


SHIPPED_COLUMNS = (
    Column("part", "paths"),
    Column("paths", value=count()),
    Column("failed", "failures", of="paths", goal="0", meaning=f"no flight, a crash, or {LOST:g} m from its place",
           value=count("reason")),
    Column("violation", "thrust violation, planned", "N", ".3f", goal="0.000 N", value=mean("violation")),
    Column("slower", "time over the expert: mean", "%", "+.3f", goal="±0.5 %", meaning="both certified, same limits",
           value=mean("slower")),
    Column("slower_most", "time over the expert: largest", "%", "+.3f", goal="±0.5 %", value=farthest("slower")),
    Column("deviation", "largest deviation: mean", "m", ".3f", goal="0.143 m", meaning="the paper's, at a lag of 5 ms",
           value=mean("deviation")),
    Column("deviation_most", "largest deviation: of all", "m", ".3f", value=largest("deviation")),
)  # fmt: skip


def work(settings: Settings, run: Run) -> Work:
    """Return one case per path; networks are trained if necessary. Raises what `paper_data` raises."""
    data = paper_data(settings, run, wanted(settings))
    return Work(data.paths, partial(measure, data.networks), PaperTrial, data.identity)


def wanted(settings: Settings) -> list[SequenceOptions]:
    """Return the options of the networks to compare."""
    compared = [
        replace(OF_KIND[Kind(kind)], seed=seed)
        for kind in settings.kinds
        for seed in range(settings.seeds if kind in SEVERAL else 1)
    ]
    return [*compared, *([LOSS_OF_PAPER] if OURS.kind in settings.kinds else [])]


def measure(networks: list[TrainedNetwork], asked: PaperPath) -> list[PaperTrial]:
    """Plan a path with all planners, and fly the shipped planner's plan in packets too."""
    trials = path_trials(planners(networks), {each.name: each for each in networks}, asked)
    models = {each.name: each.options.model for each in networks}  # a row of the table is of all seeds
    trials = [replace(trial, planner=models.get(trial.planner, trial.planner)) for trial in trials]
    return [*trials, _shipped(PaperTrial(AS_BYTES, asked.part, asked.row, repaired=True), amid(asked.path))]


def tables(settings: Settings, rows: list[PaperTrial]) -> Iterator[Table]:
    """Yield the paper's table, the same after repair, the shipped planner's flights, and the trainings."""
    compared = [row for row in rows if row.planner != AS_BYTES]
    yield from planner_tables("architectures", "network", ARCHITECTURES, compared)
    lag = SHIPPED_LIMITS.airframe.motor_time_constant
    title = f"The planner that ships, within the simulation limits, flown as bytes, motor lag {lag:g} s"
    shipped = [row for row in rows if row.planner == AS_BYTES]
    yield table("shipped", title, SHIPPED_COLUMNS, shipped, by=("part",), across=True)
    yield training_table(compared)


def amid(path: Path) -> Path:
    """Return the path moved to the origin: packets cannot hold positions beyond 32.8 m from it."""
    places = path(np.linspace(0.0, path.end, 1000))
    return path.placed(-0.5 * (places.min(axis=0) + places.max(axis=0)))


def shipped_task(path: Path) -> PlanningTask:
    """Return the task of the shipped planner for a path."""
    return PlanningTask(path, SHIPPED_LIMITS.airframe, SHIPPED_LIMITS.limits, SHIPPED_NODES, YawMode.FIXED)


def _shipped(trial: PaperTrial, path: Path) -> PaperTrial:
    task, airframe, limits = shipped_task(path), SHIPPED_LIMITS.airframe, SHIPPED_LIMITS.limits
    try:
        trial = replace(trial, reference_time=repair(task, profile_of(plan_expert, task)).trajectory.duration)
        trajectory = refine(task, profile_of(plan_learned, task)).trajectory
        trial = replace(trial, travel_time=trajectory.duration, violation=_planned_violation(trajectory))
        encoded = encode_trajectory(trajectory)
        check_bytes(encoded, trajectory, limits)
        run = rehearse_motion(encoded, trajectory, airframe, lost_alone())
        return replace(trial, reason=run.reason, deviation=run.deviation)
    except CfplanError as error:
        return replace(trial, reason=str(error))


def _planned_violation(trajectory: Trajectory) -> float:
    state = trajectory.at(np.arange(0.0, trajectory.duration, SAMPLE))
    return thrust_violation(state.motor_thrust, trajectory.airframe)


STUDY = Study(Settings, work, tables, "-o results/architectures.json")
