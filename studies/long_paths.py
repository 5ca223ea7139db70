"""Measure what the learned planner needs for paths of any length: time, memory, flight time against the expert's.

Beside it how well the bytes are followed in the dry run, how far the network is off the expert where its windows
overlap and elsewhere, and what the expert and TOPPQuad need, as far as TOPPQuad goes.

Times are the processor's: planning is one thread, and a ratio of its times holds while others use the machine too.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path as File
from typing import Any

import numpy as np

from cfplan.errors import CfplanError, InputError
from cfplan.flight.setpoints.encoding import check_bytes, encode_trajectory
from cfplan.geometry.path import Path
from cfplan.learning.learned import plan_learned, window_overlaps
from cfplan.learning.model_files import find_model
from cfplan.planners.baselines.toppquad import plan_toppquad
from cfplan.planners.expert.expert import plan_expert
from cfplan.planners.expert.windows import WindowSize
from cfplan.planners.task import PlanningTask
from cfplan.planning.planners import default_nodes
from cfplan.planning.repair import Repaired, repair
from cfplan.safety.limit_sets import LimitSet
from cfplan.safety.limits import FlightLimits, Ladder
from cfplan.simulation.dry_run import dry_run
from studies.runner.items import work_table
from studies.runner.machine import process_memory
from studies.runner.result import Column, StudyResult, Table, detail_table
from studies.scaling import path_of_length
from studies.trials import find_box, find_limit_set
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.trajectory import Trajectory

LENGTHS = (20.0, 40.0, 100.0, 200.0, 400.0, 1000.0, 2000.0)  # m, 1 to 100 times the mean of the paper's paths
TOPPQUAD_NODES = 1100  # intervals up to which TOPPQuad is asked: beyond, it takes a minute and more
SAMPLES_A_NODE = 2  # where speeds are compared
GOAL_RATIO, GOAL_MEGABYTES, GOAL_EXCESS = 60.0, 50.0, 0.01
"""At 1 km: over the time of the first length, memory, and flight time over the expert's."""
COLUMNS = (
    Column("length", "length", "m", ".0f", meaning="mean of the paths"),
    Column("nodes", "nodes", "", ".0f"),
    Column("paths"),
    Column("certified", "certified", of="paths", meaning="as planned or refined, not slowed as a whole"),
    Column("plan_seconds", "network", "ms", ".1f", meaning="median over the paths, processor time"),
    Column("repair_seconds", "certificate", "ms", ".1f", meaning="repair and certificate"),
    Column("encode_seconds", "bytes", "ms", ".1f", meaning="encoded and certified"),
    Column("seconds", "in all", "ms", ".1f"),
    Column("against_first", "against the first", "×", ".1f"),
    Column("worst_share", "worst share", "", ".3f", meaning="of a limit, by the certificate, anywhere along the path"),
    Column("flight", "flight", "s", ".2f", meaning="mean"),
    Column("excess", "against expert", "%", "+.2f", meaning="the largest; the expert solves on the whole path"),
    Column("kept", "memory kept", "MB", ".1f", meaning="how much it had grown with the result still held, at most"),
    Column("peak", "memory at the peak", "MB", ".1f"),
)
BESIDE = (
    Column("length", "length", "m", ".0f"),
    Column("paths"),
    Column("deviation", "largest deviation", "cm", ".1f", meaning="of the paths' dry runs, the largest"),
    Column("joints", "joints", "", ".0f", meaning="between windows of the network, mean"),
    Column("error_at_joints", "speed off the expert's at joints", "%", ".2f",
           meaning="what the network proposes, before repair; mean over the way where windows overlap"),
    Column("error_elsewhere", "elsewhere", "%", ".2f"),
    Column("expert_seconds", "expert", "ms", ".1f", meaning="median, processor time"),
    Column("toppquad_solved", "TOPPQuad: solved", of="toppquad_asked"),
    Column("toppquad_asked"),
    Column("toppquad_seconds", "TOPPQuad", "ms", ".0f", meaning="median, without what is built once for a size"),
    Column("toppquad_excess", "flight against it", "%", "+.2f",
           meaning="mean; TOPPQuad's flight is as planned, and keeps its limits at the nodes alone"),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class LongPlan:
    """One path, planned. NaN where there was nothing to measure."""

    seed: int
    length: float  # m
    nodes: int
    reason: str = ""  # why there are no bytes to send, empty where there are
    speed_factor: float = np.nan  # on the whole; 1: not slowed
    worst_share: float = np.nan  # of a limit, by the certificate, anywhere along the path
    seconds: tuple[float, float, float] = (np.nan,) * 3
    """Processor time to plan, to repair and certify, to encode and certify the bytes; the shortest of the repeats."""
    flight: float = np.nan  # s
    expert_flight: float = np.nan  # s, solved on the whole path
    expert_seconds: float = np.nan  # of the processor, by windows, as it is used
    deviation: float = np.nan  # m, in the dry run of the bytes
    joints: int = 0  # between windows of the network
    error_at_joints: float = np.nan  # relative, of the proposed speed from the expert's, mean
    error_elsewhere: float = np.nan
    toppquad_asked: bool = False
    toppquad_flight: float = np.nan  # s, as planned; NaN where it found none
    toppquad_seconds: float = np.nan  # of the processor
    kept: float = np.nan  # MB by which memory had grown after the first of the repeats, its result still held
    peak: float = np.nan  # MB by which it had grown at most

    @property
    def certified(self) -> bool:
        """Return whether it is certified as planned or refined: not slowed as a whole."""
        return not self.reason and self.speed_factor == 1.0


def _row(plans: Sequence[LongPlan], first: Sequence[LongPlan]) -> dict[str, Any]:
    """Return the figures of one length, by the keys of COLUMNS."""
    seconds = np.median([plan.seconds for plan in plans], axis=0)
    return {
        "length": np.mean([plan.length for plan in plans]),
        "nodes": np.mean([plan.nodes for plan in plans]),
        "paths": len(plans),
        "certified": sum(plan.certified for plan in plans),
        **dict(zip(("plan_seconds", "repair_seconds", "encode_seconds"), seconds, strict=True)),
        "seconds": seconds.sum(),
        "against_first": seconds.sum() / np.median([plan.seconds for plan in first], axis=0).sum(),
        "worst_share": max(plan.worst_share for plan in plans),
        "flight": np.mean([plan.flight for plan in plans]),
        "excess": max(plan.flight / plan.expert_flight - 1.0 for plan in plans),
        "kept": max(plan.kept for plan in plans),
        "peak": max(plan.peak for plan in plans),
    }


def _row_beside(plans: Sequence[LongPlan]) -> dict[str, Any]:
    """Return the figures of one length, by the keys of BESIDE."""
    asked = [plan for plan in plans if plan.toppquad_asked]
    solved = [plan for plan in asked if np.isfinite(plan.toppquad_flight)]
    return {
        "length": np.mean([plan.length for plan in plans]),
        "paths": len(plans),
        "deviation": max(plan.deviation for plan in plans),
        "joints": np.mean([plan.joints for plan in plans]),
        "error_at_joints": np.mean([plan.error_at_joints for plan in plans]),
        "error_elsewhere": np.mean([plan.error_elsewhere for plan in plans]),
        "expert_seconds": np.median([plan.expert_seconds for plan in plans]),
        "toppquad_asked": len(asked) or None,
        "toppquad_solved": len(solved) if asked else None,
        "toppquad_seconds": np.median([plan.toppquad_seconds for plan in solved]) if solved else np.nan,
        "toppquad_excess": np.mean([plan.flight / plan.toppquad_flight - 1.0 for plan in solved]) if solved else np.nan,
    }


def long_paths(
    *,
    lengths: Sequence[float] = LENGTHS,
    paths: int = 3,
    repeats: int = 3,
    box: str = "10x10x10",
    limits: str = "hardware",
    first_seed: int = 20_000,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> StudyResult:
    """Plan `paths` random paths of each length, each `repeats` times. An interrupt keeps the lengths done by then.

    Raises:
        InputError: an unknown box or limit set, no path or length at all, or no model for the limit set.
    """
    if paths < 1 or repeats < 1 or not lengths or not min(lengths) > 0 or not np.isfinite(max(lengths)):
        raise InputError(
            "lengths must be above 0 m, paths and repeats at least 1",
            where="lengths",
            hint="leave them out for the usual ones",
        )
    find_box(box)
    chosen, seeds = find_limit_set(limits), range(first_seed, first_seed + paths)
    total, made, interrupted, begun = len(lengths) * paths * repeats, 0, False, time.process_time()
    done: list[list[LongPlan]] = []
    try:
        warm = path_of_length(lengths[0], box, first_seed)
        _planned(warm, chosen)  # loads and compiles
        plan_expert(PlanningTask(warm, chosen.airframe, chosen.limits, default_nodes(warm, "learned")))
        for length in lengths:
            plans = []
            for seed in seeds:
                plans.append(_measure(path_of_length(length, box, seed), seed, chosen))
                progress(made := made + 1, total)
            done.append(plans)
        for _ in range(repeats - 1):  # by turns, so that a computer that changes its pace does so for all lengths
            for length, plans in zip(lengths, done, strict=True):
                for k, seed in enumerate(seeds):
                    plans[k] = _repeated(plans[k], path_of_length(length, box, seed), chosen)
                    progress(made := made + 1, total)
    except KeyboardInterrupt:
        interrupted = True
    settings = {
        "box": box, "limits": limits, "first_seed": first_seed, "paths": paths, "repeats": repeats,
        "quick": max(lengths) < LENGTHS[-1],
    }  # fmt: skip
    detail = detail_table("plans", [plan for plans in done for plan in plans])
    details = (detail, work_table({"plan": (made, time.process_time() - begun)}))
    return StudyResult("long", settings, (lengths_table(done, box, limits), beside_table(done)), details, interrupted)


def lengths_table(done: Sequence[Sequence[LongPlan]], box: str, limits: str) -> Table:
    """Return the figures of each length."""
    goal = f"{GOAL_RATIO:g}× the first at 1 km, {GOAL_EXCESS:+.0%}, {GOAL_MEGABYTES:g} MB"
    title = f"The learned planner on long paths, box {box} m, {limits} limits; at most: {goal}"
    return Table("lengths", title, COLUMNS, tuple(_row(plans, done[0]) for plans in done))


def beside_table(done: Sequence[Sequence[LongPlan]]) -> Table:
    """Return what is measured beside the learned planner's own figures."""
    title = "The same paths: how they are followed, joints, and other planners"
    return Table("beside", title, BESIDE, tuple(_row_beside(plans) for plans in done))


def _measure(path: Path, seed: int, chosen: LimitSet) -> LongPlan:
    nodes = default_nodes(path, "learned")
    values: dict[str, Any] = {"seed": seed, "length": path.length, "nodes": nodes}
    try:
        path.check()
        _forget_peak()
        before = process_memory("VmRSS")
        found, values["seconds"] = _planned(path, chosen)
        values |= {"kept": process_memory("VmRSS") - before, "peak": process_memory("VmHWM") - before}
        values |= {"speed_factor": found.speed_factor, "flight": found.trajectory.duration}
        values["worst_share"] = found.certificate.worst.share
        values |= _followed(found, chosen) | _beside(path, nodes, chosen)
    except InputError:
        raise
    except CfplanError as error:
        values["reason"] = str(error)
    return LongPlan(**values)


def _followed(found: Repaired, chosen: LimitSet) -> dict[str, float]:
    """Return the largest deviation of the bytes' dry run."""
    encoded = encode_trajectory(found.trajectory)
    never = Ladder(np.inf, np.inf, np.inf)
    anyhow = FlightLimits(never, never, never, never, never, patience=1.0)
    return {"deviation": dry_run(encoded, found.trajectory, chosen.airframe, anyhow).deviation}


def _beside(path: Path, nodes: int, chosen: LimitSet) -> dict[str, Any]:
    """Return how far the network is off the expert, at joints and elsewhere, and what the other planners need."""
    task = PlanningTask(path, chosen.airframe, chosen.limits, nodes)
    values: dict[str, Any] = {"toppquad_asked": nodes <= TOPPQUAD_NODES}
    begun = time.process_time()
    plan_expert(task)
    values["expert_seconds"] = time.process_time() - begun
    whole, learned = plan_expert(task, window=WindowSize(nodes, 0)).profile, plan_learned(task)
    if whole is not None and learned.profile is not None:
        values["expert_flight"] = Trajectory(path, whole, chosen.airframe).duration
        values |= _errors(path, whole, learned.profile, chosen)
    if values["toppquad_asked"]:
        found = plan_toppquad(task)
        values["toppquad_seconds"] = float(found.stats.get("solve_seconds", np.nan))
        if found.profile is not None:
            values["toppquad_flight"] = Trajectory(path, found.profile, chosen.airframe).duration
    return values


def _errors(path: Path, expert: SpeedProfile, proposed: SpeedProfile, chosen: LimitSet) -> dict[str, Any]:
    """Return the relative error of the proposed speed, where windows of the network overlap and elsewhere."""
    model = find_model(chosen.airframe, chosen.limits)
    assert model is not None
    places = np.linspace(0.0, path.end, SAMPLES_A_NODE * (len(proposed.s) - 1))
    errors = np.abs(np.sqrt(proposed.at(places).h / expert.at(places).h) - 1.0)
    overlaps = window_overlaps(path, len(proposed.s) - 1, model.window)
    within = np.zeros(len(places), dtype=bool)
    for begin, end in overlaps:
        within |= (places >= begin) & (places <= end)
    return {
        "joints": len(overlaps),
        "error_at_joints": float(errors[within].mean()) if within.any() else np.nan,
        "error_elsewhere": float(errors[~within].mean()) if not within.all() else np.nan,
    }


def _repeated(plan: LongPlan, path: Path, chosen: LimitSet) -> LongPlan:
    """Return it with the shorter of its time and that of planning again."""
    return plan if plan.reason else replace(plan, seconds=min(plan.seconds, _planned(path, chosen)[1], key=sum))


def _planned(path: Path, chosen: LimitSet) -> tuple[Repaired, tuple[float, float, float]]:
    """Plan from the path to certified bytes; return the plan and the seconds of each part."""
    begun = time.process_time()
    task = PlanningTask(path, chosen.airframe, chosen.limits, default_nodes(path, "learned"))
    solution = plan_learned(task)
    planned = time.process_time()
    if solution.profile is None:
        raise CfplanError(
            solution.reason or str(solution.status),
            where="learned planner",
            hint="train a model for these limits, or choose another limit set",
        )
    found = repair(task, solution.profile)
    repaired = time.process_time()
    check_bytes(encode_trajectory(found.trajectory), found.trajectory, chosen.limits)
    return found, (planned - begun, repaired - planned, time.process_time() - repaired)


def _forget_peak() -> None:
    """Begin VmHWM anew."""
    try:
        File("/proc/self/clear_refs").write_text("5")
    except OSError:
        return
