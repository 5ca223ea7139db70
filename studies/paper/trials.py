"""One path planned by one planner under the paper's conditions, and the measures of the paper's tables.

The geometric controller flies the plan with the paper's motor lag. The measures are deviation, thrust beyond the range
of the motors (planned, and requested by the controller), speed above the limit, travel time and processor time to plan.
"""

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np

from cfplan.errors import CfplanError
from cfplan.geometry.path import Path
from cfplan.geometry.yaw import YawMode
from cfplan.learning.learned import plan_learned
from cfplan.planners.baselines.toppquad import plan_toppquad
from cfplan.planners.expert.expert import plan_expert
from cfplan.planners.task import Planner, PlanningTask
from cfplan.planning.repair import refine, repair
from cfplan.safety.limit_sets import PAPER
from cfplan.simulation.geometric_flight import LOST, fly_geometric, thrust_violation
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.trajectory import Trajectory
from studies.paper.printed import PrintedRow, paper_column
from studies.paper.recovery import recover_profile
from studies.paper.sequences import path_inputs
from studies.paper.trained import NODES, PARAMETERS, TRAINING_COLUMNS, PaperPath, TrainedNetwork
from studies.paper.training import answer
from studies.runner.reductions import Reduction, among, count, mean, quantile
from studies.runner.result import Column, Table, table

PAPER_LAG = 0.005  # s, time constant of the motors in the paper's version of RotorPy
FLOWN = replace(PAPER.airframe, motor_time_constant=PAPER_LAG)
TOPPQUAD, EXPERT, SHIPPED = "TOPPQuad", "expert", "the shipped network"
SAMPLE = 0.002  # s between samples of planned thrust and speed
_WARM: set[str] = set()  # planners that this process has run before
Plan = Callable[[Path], SpeedProfile]  # raises CfplanError if there is no profile
Ask = Callable[[Path], Trajectory]  # likewise
Row = TypeVar("Row")


@dataclass(frozen=True, slots=True)
class PaperTrial:
    """One path, planned and flown. NaN where there was nothing to measure."""

    planner: str
    part: str  # TRAIN or TEST: whether the networks have learned from this path
    row: int  # of the dataset
    repaired: bool
    reason: str = ""  # why there is no flight; empty if there is one
    travel_time: float = np.nan  # s
    seconds: float = np.nan  # s of processor time to plan
    deviation: float = np.nan  # m, LOST where it failed
    violation: float = np.nan  # N, planned
    asked_violation: float = np.nan  # N, requested by the controller
    top_speed: float = np.nan  # m/s, planned
    reference_time: float = np.nan  # s, of TOPPQuad's plan
    training: Mapping[str, Any] | None = None  # of the network that planned

    @property
    def slower(self) -> float:
        """Return the plan's travel time over the reference's, as a relative excess."""
        return self.travel_time / self.reference_time - 1.0

    @property
    def above(self) -> float:
        """Return the relative excess of the planned speed over its limit; NaN without a plan."""
        return max(self.top_speed / PAPER.limits.speed - 1.0, 0.0) if not self.reason else np.nan


def planners(networks: Iterable[TrainedNetwork]) -> dict[str, Plan]:
    """Return TOPPQuad, the expert, the networks, and the shipped network, by name."""
    found = {TOPPQUAD: profile_by(plan_toppquad), EXPERT: profile_by(plan_expert)}
    found |= {each.name: network_plan(each) for each in networks}
    return found | {SHIPPED: profile_by(plan_learned)}


def paper_task(path: Path, yaw: YawMode = YawMode.FREE) -> PlanningTask:
    """Return the planning task: the paper's vehicle and limits, 100 points, and by default free yaw as in the paper."""
    return PlanningTask(path, PAPER.airframe, PAPER.limits, NODES, yaw)


def profile_of(planner: Planner, task: PlanningTask) -> SpeedProfile:
    """Return the planner's profile, unrepaired. Raises CfplanError, with the planner's reason, if there is none."""
    solution = planner(task)
    if solution.profile is None:
        raise CfplanError(solution.reason or str(solution.status), hint="plan by another planner")
    return solution.profile


def profile_by(planner: Planner) -> Plan:
    """Return a function from a path to the planner's profile for `paper_task`."""
    return lambda path: profile_of(planner, paper_task(path))


def shipped_profile(path: Path, yaw: YawMode = YawMode.FREE) -> SpeedProfile:
    """Return the shipped planner's profile: the network's, refined to the optimum and certified.

    The planning policy refines every network profile; `repair` would leave feasible ones unchanged.
    """
    task = paper_task(path, yaw)
    return refine(task, profile_of(plan_learned, task)).trajectory.profile


def trajectory_by(plan: Plan) -> Ask:
    """Return a function from a path to the planner's trajectory for the paper's vehicle."""
    return lambda path: Trajectory(path, plan(path), PAPER.airframe)


def network_plan(trained: TrainedNetwork) -> Plan:
    """Return the network as a planner, without repair."""

    def plan(path: Path) -> SpeedProfile:
        inputs = path_inputs(path, NODES + 1)[None]
        return recover_profile(answer(trained.network, inputs, trained.options.inputs)[0], path.end)

    return plan


def path_trials(
    plans: Mapping[str, Plan], networks: Mapping[str, TrainedNetwork], asked: PaperPath
) -> list[PaperTrial]:
    """Return two trials per planner: flown as planned, and after repair. The planners must include TOPPQuad."""
    trials: list[PaperTrial] = []
    for name, plan in plans.items():
        warm_up(name, partial(plan, asked.path))
        training = networks[name].training if name in networks else None
        trials += _both(plan, asked.path, PaperTrial(name, asked.part, asked.row, repaired=False, training=training))
    reference = next(trial.travel_time for trial in trials if trial.planner == TOPPQUAD)
    return [replace(trial, reference_time=reference) for trial in trials]


def warm_up(name: str, ask: Callable[[], object]) -> None:
    """Run a planner once per process, so that it is loaded and compiled before it is timed."""
    if name not in _WARM:
        with suppress(CfplanError):
            ask()
        _WARM.add(name)


def _both(plan: Plan, path: Path, begun: PaperTrial) -> tuple[PaperTrial, PaperTrial]:
    started = time.process_time()
    try:
        profile = plan(path)
    except CfplanError as error:
        refused = replace(begun, reason=str(error))
        return refused, replace(refused, repaired=True)
    seconds = time.process_time() - started
    raw = _flown(Trajectory(path, profile, PAPER.airframe), replace(begun, seconds=seconds))
    try:
        started = time.process_time()
        found = repair(paper_task(path), profile)
        seconds += time.process_time() - started
    except CfplanError as error:
        return raw, replace(begun, repaired=True, reason=str(error))
    return raw, _flown(found.trajectory, replace(begun, repaired=True, seconds=seconds))


def _flown(trajectory: Trajectory, trial: PaperTrial) -> PaperTrial:
    flight = fly_geometric(trajectory, FLOWN)
    state = trajectory.at(np.arange(0.0, trajectory.duration, SAMPLE))
    return replace(
        trial,
        travel_time=trajectory.duration,
        deviation=flight.deviation,
        violation=thrust_violation(state.motor_thrust, PAPER.airframe),
        asked_violation=flight.asked_violation,
        top_speed=float(np.linalg.norm(state.velocity, axis=1).max()),
    )


def failed(flight: Any) -> bool:
    """Return whether there was no flight, or one that crashed or was LOST."""
    return not flight.deviation < LOST


def flown(flight: Any) -> bool:
    """Return whether the flight did not fail."""
    return not failed(flight)


FAILED = Column("failed", "failures", of="paths", meaning=f"no plan, a crash, or {LOST:g} m from its place",
                value=count(failed))  # fmt: skip
_MEAN_DEVIATION = mean(lambda flight: LOST if failed(flight) else flight.deviation)
DEVIATION = Column("deviation", "largest deviation", "m", ".3f", meaning=f"mean; a failure counts as {LOST:g} m",
                   value=_MEAN_DEVIATION)  # fmt: skip
SPREAD = Column("deviation_spread", "± over seeds", "m", ".3f", meaning="half of the range of the seeds' means",
                value=lambda rows: _half_range(rows, _MEAN_DEVIATION))  # fmt: skip
DEVIATION_P90 = Column("deviation_p90", "90 % of paths", "m", ".3f", meaning="are within this",
                       value=quantile(lambda flight: LOST if failed(flight) else flight.deviation, 0.9))  # fmt: skip
DEVIATION_FLOWN = Column("deviation_flown", "without failures", "m", ".3f",
                         meaning="the same, of flights that did not fail",
                         value=among(flown, mean("deviation")))  # fmt: skip


def _half_range(rows: Sequence[Any], value: Reduction) -> float:
    """Return half the range of a value for the trainings with different seeds; NaN if there is only one."""
    seeds = {row.training["seed"] for row in rows if row.training}
    values = [value([row for row in rows if row.training["seed"] == seed]) for seed in seeds]
    return (max(values) - min(values)) / 2.0 if len(values) > 1 else math.nan


def planner_tables(
    name: str, what: str, printed: Mapping[tuple[str, str], PrintedRow], trials: Sequence[PaperTrial]
) -> Iterator[Table]:
    """Yield the paper's table, of plans without repair, beside the paper's numbers, and the same after repair."""
    columns = planner_columns(what, printed)
    bare = [column for column in columns if not column.key.startswith("paper_")]
    terms = f"{PAPER.limits.speed:g} m/s, motor lag {PAPER_LAG:g} s"
    raw, repaired = ([trial for trial in ordered(trials) if trial.repaired is way] for way in (False, True))
    yield table(name, f"The paper's table, as planned, {terms}", columns, raw, by=("planner", "part"))
    yield table(f"{name}-repaired", f"After cfplan's repair, {terms}", bare, repaired, by=("planner", "part"))


def ordered(rows: Sequence[Row], by: str = "planner") -> list[Row]:
    """Return the rows grouped by planner, in order of first occurrence."""
    places = {name: place for place, name in enumerate(dict.fromkeys(getattr(row, by) for row in rows))}
    return sorted(rows, key=lambda row: places[getattr(row, by)])


def training_table(rows: Sequence[Any], by: str = "planner") -> Table:
    """Return a table of the size and training of each network that the rows name."""
    columns = (Column("network", "network", value=lambda rows: rows[0].training["network"]), PARAMETERS)
    of_networks = [row for row in rows if row.training]
    return table("training", "Networks and their training", (*columns, *TRAINING_COLUMNS), of_networks, by=(by,))


def planner_columns(what: str, printed: Mapping[tuple[str, str], PrintedRow]) -> tuple[Column, ...]:
    """Return the columns of the paper's tables of planners, each beside the paper's numbers."""
    paper = partial(paper_column, printed, by=("planner", "part"))
    return (
        Column("planner", what),
        Column("part", "paths"),
        Column("paths", "", meaning="number of them", value=count()),
        DEVIATION,
        SPREAD,
        DEVIATION_P90,
        DEVIATION_FLOWN,
        paper("deviation", unit="m", spec=".3f", meaning="the paper does not say which of the two"),
        Column("violation", "thrust violation", "N", ".4f",
               meaning="planned thrust beyond a motor's range, mean over time", value=mean("violation")),
        Column("asked_violation", "asked", "N", ".4f", meaning="the same, of what the controller asks",
               value=mean("asked_violation")),
        paper("violation", unit="N", spec=".3f"),
        Column("above", "speed above 5 m/s", "%", ".2f", meaning="the most on a path, mean", value=mean("above")),
        Column("slower", "time over TOPPQuad", "%", "+.2f", meaning="mean over paths", value=mean("slower")),
        Column("slower_flown", "without failures", "%", "+.2f", value=among(flown, mean("slower"))),
        paper("slower", unit="%", spec="+.2f"),
        FAILED,
        paper("failed", unit="%", spec=".0f"),
        Column("seconds", "compute", "ms", ".1f", meaning="mean of the processor's time, one thread",
               value=mean("seconds")),
        paper("seconds", unit="ms", spec=".0f"),
    )  # fmt: skip
