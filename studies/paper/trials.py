"""One path planned by one planner on the paper's terms, and what the paper's tables say of it.

The plan is flown by the geometric controller with the paper's motor lag. Deviation, thrust beyond the motors' range, as
planned and as asked by the controller, speed above the limit, travel time, and the processor's time to plan.
"""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cfplan.errors import CfplanError
from cfplan.geometry.path import Path
from cfplan.geometry.yaw import YawMode
from cfplan.learning.learned import plan_learned
from cfplan.learning.paper.recovery import recover_profile
from cfplan.learning.paper.sequences import path_inputs
from cfplan.learning.paper.training import answer
from cfplan.planners.baselines.toppquad import plan_toppquad
from cfplan.planners.expert.expert import plan_expert
from cfplan.planners.task import Planner, PlanningTask
from cfplan.planning.repair import refine, repair
from cfplan.safety.limit_sets import PAPER
from cfplan.simulation.geometric_flight import LOST, fly_geometric, thrust_violation
from studies.paper.networks import NODES, TrainedNetwork
from studies.paper.printed import PrintedRow
from studies.runner.result import Column
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.trajectory import Trajectory

PAPER_LAG = 0.005  # s, time constant of the motors in RotorPy of the paper's day
FLOWN = replace(PAPER.airframe, motor_time_constant=PAPER_LAG)
TOPPQUAD, EXPERT, SHIPPED = "TOPPQuad", "expert", "the shipped network"
SAMPLE = 0.002  # s between the moments at which planned thrust and speed are looked at
_WARM: set[str] = set()  # planners that this process has asked before
Plan = Callable[[Path], SpeedProfile]  # raises CfplanError where there is none
Ask = Callable[[Path], Trajectory]  # likewise


@dataclass(frozen=True, slots=True)
class PaperTrial:
    """One path, planned and flown. NaN where there was nothing to measure."""

    planner: str
    part: str  # whether the network has learned from this path
    row: int  # of the dataset
    repaired: bool
    reason: str = ""  # why there is no flight
    travel_time: float = np.nan  # s
    seconds: float = np.nan  # of the processor, to plan
    deviation: float = np.nan  # m, LOST where it failed
    violation: float = np.nan  # N, planned
    asked_violation: float = np.nan  # N, by the controller
    top_speed: float = np.nan  # m/s, planned

    @property
    def failed(self) -> bool:
        """Return whether there was no flight, or one that crashed or was LOST."""
        return not self.deviation < LOST


def planners(networks: Iterable[TrainedNetwork]) -> dict[str, Plan]:
    """Return TOPPQuad and the expert, the networks, and the network that ships, by name."""
    found = {TOPPQUAD: profile_by(plan_toppquad), EXPERT: profile_by(plan_expert)}
    found |= {each.name: network_plan(each) for each in networks}
    return found | {SHIPPED: profile_by(plan_learned)}


def paper_task(path: Path, yaw: YawMode = YawMode.FREE) -> PlanningTask:
    """Return what planners are asked: the paper's vehicle and limits, 100 points, and free yaw as in the paper."""
    return PlanningTask(path, PAPER.airframe, PAPER.limits, NODES, yaw)


def profile_of(planner: Planner, task: PlanningTask) -> SpeedProfile:
    """Return the planner's profile as it answers it. Raises CfplanError, with its reason, where there is none."""
    solution = planner(task)
    if solution.profile is None:
        raise CfplanError(solution.reason or str(solution.status), hint="plan by another planner")
    return solution.profile


def profile_by(planner: Planner) -> Plan:
    """Return the planner, asked as the paper asks: see `paper_task`."""
    return lambda path: profile_of(planner, paper_task(path))


def shipped_profile(path: Path, yaw: YawMode = YawMode.FREE) -> SpeedProfile:
    """Return what the planner that ships flies: the network's profile, refined to the optimum and certified.

    That is how the policy of planning finishes it, whether it passes or not; `repair` would leave alone what passes.
    """
    task = paper_task(path, yaw)
    return refine(task, profile_of(plan_learned, task)).trajectory.profile


def trajectory_by(plan: Plan) -> Ask:
    """Return the planner with the flatness map behind it: from a path to a trajectory of the paper's vehicle."""
    return lambda path: Trajectory(path, plan(path), PAPER.airframe)


def network_plan(trained: TrainedNetwork) -> Plan:
    """Return the network as a planner, without repair."""

    def plan(path: Path) -> SpeedProfile:
        inputs = path_inputs(path, NODES + 1)[None]
        return recover_profile(answer(trained.network, inputs, trained.options.inputs)[0], path.end)

    return plan


def path_trials(plans: Mapping[str, Plan], part: str, row: int, path: Path) -> list[PaperTrial]:
    """Return what each planner planned, flown as it is and flown after repair."""
    trials: list[PaperTrial] = []
    for name, plan in plans.items():
        if name not in _WARM:
            with suppress(CfplanError):
                plan(path)  # loads and compiles
            _WARM.add(name)
        trials += _both(plan, path, {"planner": name, "part": part, "row": row})
    return trials


def _both(plan: Plan, path: Path, known: dict[str, Any]) -> tuple[PaperTrial, PaperTrial]:
    begun = time.process_time()
    try:
        profile = plan(path)
    except CfplanError as error:
        return PaperTrial(**known, repaired=False, reason=str(error)), PaperTrial(
            **known, repaired=True, reason=str(error)
        )
    seconds = time.process_time() - begun
    raw = _flown(Trajectory(path, profile, PAPER.airframe), PaperTrial(**known, repaired=False, seconds=seconds))
    try:
        begun = time.process_time()
        found = repair(paper_task(path), profile)
        seconds += time.process_time() - begun
    except CfplanError as error:
        return raw, PaperTrial(**known, repaired=True, reason=str(error))
    return raw, _flown(found.trajectory, PaperTrial(**known, repaired=True, seconds=seconds))


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


def planner_columns(what: str) -> tuple[Column, ...]:
    """Return the columns of the paper's tables of planners, each with the paper's beside it."""
    return (
        Column("planner", what),
        Column("part", "paths"),
        Column("paths", "", meaning="number of them"),
        Column("deviation", "largest deviation", "m", ".3f", meaning=f"mean; a failure counts as {LOST:g} m"),
        Column("deviation_flown", "without failures", "m", ".3f", meaning="the same, of flights that did not fail"),
        Column("paper_deviation", "paper", "m", ".3f", meaning="the paper does not say which of the two"),
        Column(
            "violation", "thrust violation", "N", ".4f", meaning="planned thrust beyond a motor's range, mean over time"
        ),
        Column("asked_violation", "asked", "N", ".4f", meaning="the same, of what the controller asks"),
        Column("paper_violation", "paper", "N", ".3f"),
        Column("above", "speed above 5 m/s", "%", ".2f", meaning="the most on a path, mean"),
        Column("slower", "time over TOPPQuad", "%", "+.2f", meaning="mean over paths"),
        Column("slower_flown", "without failures", "%", "+.2f"),
        Column("paper_slower", "paper", "%", "+.2f"),
        Column("failed", "failures", of="paths", meaning=f"no plan, a crash, or {LOST:g} m from its place"),
        Column("paper_failed", "paper", "%", ".0f"),
        Column("seconds", "compute", "ms", ".1f", meaning="mean of the processor's time, one thread"),
        Column("paper_seconds", "paper", "ms", ".0f"),
    )


def planner_row(
    trials: Sequence[PaperTrial], reference: Sequence[PaperTrial], printed: PrintedRow | None
) -> dict[str, Any]:
    """Return a row of `planner_columns`; `reference` are TOPPQuad's trials of the same paths, in the same order."""
    flown = [trial for trial in trials if not trial.failed]
    against = {trial.row: trial.travel_time for trial in reference}
    return {
        "planner": trials[0].planner,
        "part": trials[0].part,
        "paths": len(trials),
        "deviation": finite_mean(LOST if trial.failed else trial.deviation for trial in trials),
        "deviation_flown": finite_mean(trial.deviation for trial in flown),
        "violation": finite_mean(trial.violation for trial in trials),
        "asked_violation": finite_mean(trial.asked_violation for trial in trials),
        "above": finite_mean(
            max(trial.top_speed / PAPER.limits.speed - 1.0, 0.0) for trial in trials if not trial.reason
        ),
        "slower": finite_mean(trial.travel_time / against[trial.row] - 1.0 for trial in trials),
        "slower_flown": finite_mean(trial.travel_time / against[trial.row] - 1.0 for trial in flown),
        "failed": sum(trial.failed for trial in trials),
        "seconds": finite_mean(trial.seconds for trial in trials),
        "paper_deviation": printed.deviation if printed else None,
        "paper_violation": printed.violation if printed else None,
        "paper_slower": printed.slower if printed else None,
        "paper_failed": printed.failures if printed else None,
        "paper_seconds": printed.seconds if printed else None,
    }


def finite_mean(values: Iterable[float]) -> float:
    """Return the mean of what is finite; NaN where nothing is."""
    finite = [value for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else float("nan")
