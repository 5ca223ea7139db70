"""Measure what the learned planner needs for paths of any length: time, memory, flight time against the expert's.

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
from cfplan.learning.learned import plan_learned
from cfplan.planners.expert.expert import plan_expert
from cfplan.planners.expert.windows import WindowSize
from cfplan.planners.task import PlanningTask
from cfplan.planning.planners import default_nodes
from cfplan.planning.repair import Repaired, repair
from cfplan.safety.limit_sets import LimitSet
from cfplan.studies.machine import process_memory
from cfplan.studies.result import Column, StudyResult, Table, detail_table
from cfplan.studies.scaling import path_of_length
from cfplan.studies.trials import find_box, find_limit_set
from cfplan.vehicle.trajectory import Trajectory

LENGTHS = (20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)  # m
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
    total, made, interrupted = len(lengths) * paths * repeats, 0, False
    done: list[list[LongPlan]] = []
    try:
        _planned(path_of_length(lengths[0], box, first_seed), chosen)  # loads and compiles
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
    settings = {"box": box, "limits": limits, "first_seed": first_seed, "paths": paths, "repeats": repeats}
    detail = detail_table("plans", [plan for plans in done for plan in plans])
    return StudyResult("long", settings, (lengths_table(done, box, limits),), (detail,), interrupted)


def lengths_table(done: Sequence[Sequence[LongPlan]], box: str, limits: str) -> Table:
    """Return the figures of each length."""
    goal = f"{GOAL_RATIO:g}× the first at 1 km, {GOAL_EXCESS:+.0%}, {GOAL_MEGABYTES:g} MB"
    title = f"The learned planner on long paths, box {box} m, {limits} limits; at most: {goal}"
    return Table("lengths", title, COLUMNS, tuple(_row(plans, done[0]) for plans in done))


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
        expert = plan_expert(PlanningTask(path, chosen.airframe, chosen.limits, nodes), window=WindowSize(nodes, 0))
        if expert.profile is not None:
            values["expert_flight"] = Trajectory(path, expert.profile, chosen.airframe).duration
    except InputError:
        raise
    except CfplanError as error:
        values["reason"] = str(error)
    return LongPlan(**values)


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
