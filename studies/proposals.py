"""Compare proposals for refining, by speed: the network's, the convex planner's, and what the expert begins with.

Each is refined by the same search to the same end. Counted are Newton steps, processor time and failures. The
network's is refined a second time without the multipliers of the search before, with which rounds of tightening go on.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from cfplan.errors import CfplanError, InputError
from cfplan.geometry.path import Path
from cfplan.geometry.yaw import YawMode
from cfplan.learning.learned import plan_learned
from cfplan.planners.baselines.convex import plan_convex
from cfplan.planners.expert.expert import plan_expert
from cfplan.planners.expert.refine import refinements
from cfplan.planners.expert.search import Start, refining_restarts
from cfplan.planners.solution import Solution
from cfplan.planners.task import Planner, PlanningTask
from cfplan.planning.repair import repair
from cfplan.safety.certificate import certify
from cfplan.safety.limit_sets import LimitSet
from studies.runner.result import Column, StudyResult, Table, collect
from studies.trials import find_box, find_limit_set, random_path
from cfplan.vehicle.trajectory import Trajectory

NODES = 100
SPEEDS = (0.5, 1.0, 2.0, 4.0, 8.0)  # m/s, limits on speed
EXPERT = "expert"
COLUMNS = (
    Column("speed", "speed limit", "m/s", "g"),
    Column("proposal", "proposal"),
    Column("paths"),
    Column("failed", "not refined", of="paths", meaning="no search from there succeeded, or the certificate refused"),
    Column("steps", "Newton steps, mean", "", ".1f"),
    Column("steps_p95", "Newton steps, p95", "", ".0f"),
    Column("propose", "propose, median", "ms", ".2f", meaning="processor time; the expert has its first search there"),
    Column("finish", "refine and certify, median", "ms", ".2f"),
    Column("speed_up", "against the expert, median", "×", ".2f", meaning="the expert's whole time over this one's"),
    Column("slower", "flight against the expert, mean", "%", "+.3f"),
    Column("slower_max", "flight against the expert, max", "%", "+.3f"),
)


class _Refined(NamedTuple):
    """One proposal and what became of it. Times in s; NaN where it failed."""

    propose: float
    finish: float
    steps: float
    flight: float


def proposals(
    *,
    paths: int = 60,
    speeds: Sequence[float] = SPEEDS,
    box: str = "4.5x8x2",
    limits: str = "simulation",
    yaw: YawMode = YawMode.FIXED,
    first_seed: int = 20_000,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> StudyResult:
    """Refine proposals for `paths` random paths at each speed. An interrupt ends it with the paths done by then.

    Raises:
        InputError: an unknown box or limit set, or no path at all.
    """
    if paths < 1:
        raise InputError("paths must be at least 1", where="paths", hint="give --paths 30, as is usual")
    find_box(box)
    chosen = find_limit_set(limits)

    def measure() -> Iterator[tuple[float, dict[str, _Refined]]]:
        for number, speed in enumerate(speeds):
            at_speed = replace(chosen, limits=replace(chosen.limits, speed=speed))
            _of_path(random_path(first_seed - 1, box), at_speed, yaw, first_seed)  # compiles and loads
            for count in range(paths):
                seed = first_seed + count
                found = _of_path(random_path(seed, box), at_speed, yaw, seed)
                progress(number * paths + count + 1, len(speeds) * paths)
                if found:
                    yield speed, found

    measured, interrupted = collect(measure())
    rows = [
        _row(speed, name, [found for at, found in measured if at == speed])
        for speed in dict.fromkeys(speed for speed, _ in measured) for name in WAYS
    ]  # fmt: skip
    title = f"Proposals refined to the same end, box {box} m, {limits} limits but for the speed, yaw {yaw.value}"
    settings = {"first_seed": first_seed, "paths": paths, "nodes": NODES, "box": box, "limits": limits}
    return StudyResult("proposals", settings, (Table("speeds", title, COLUMNS, tuple(rows)),), interrupted=interrupted)


def cold_restarts(interval: float, *, capped: bool = False) -> Sequence[Start]:
    return [start for start in refining_restarts(interval, capped=capped) if not start.goes_on]


def _refine(
    task: PlanningTask, solution: Solution, restarts: Callable[..., Sequence[Start]] = refining_restarts
) -> tuple[float, float]:
    """Return (Newton steps, flight in s) of refining a profile until it passes; NaN where it never does."""
    assert solution.profile
    for refined in refinements(task, solution.profile, restarts=restarts):
        if refined.profile is None:
            return np.nan, np.nan
        trajectory = Trajectory(task.path, refined.profile, task.airframe)
        if certify(trajectory, task.limits).passed:
            return float(refined.stats["iterations"]), trajectory.duration
    return np.nan, np.nan


def _repair(task: PlanningTask, solution: Solution) -> tuple[float, float]:
    """Return the same of the expert's profile, which only has to pass."""
    assert solution.profile
    repaired = repair(task, solution.profile)
    steps = float(solution.stats["iterations"])
    return (steps, repaired.trajectory.duration) if repaired.speed_factor == 1.0 else (np.nan, np.nan)


WAYS: dict[str, tuple[Planner, Callable[[PlanningTask, Solution], tuple[float, float]]]] = {
    "network": (plan_learned, _refine),
    "network, multipliers not kept": (plan_learned, partial(_refine, restarts=cold_restarts)),
    "convex": (plan_convex, _refine),
    EXPERT: (plan_expert, _repair),
}


def _of_path(path: Path, chosen: LimitSet, yaw: YawMode, seed: int) -> dict[str, _Refined]:
    """Return what became of each proposal for a path; nothing where the expert finds no flight."""
    task = PlanningTask(path, chosen.airframe, chosen.limits, NODES, yaw)
    names = list(WAYS)
    turn = seed % len(names)  # whoever comes first finds the processor's cache empty
    try:
        path.check()
        found = {name: _try(task, *WAYS[name]) for name in names[turn:] + names[:turn]}
    except CfplanError:
        return {}
    return found if np.isfinite(found[EXPERT].flight) else {}


def _try(
    task: PlanningTask, plan: Planner, finish: Callable[[PlanningTask, Solution], tuple[float, float]]
) -> _Refined:  # fmt: skip
    begun = time.process_time()
    solution = plan(task)
    proposed = time.process_time()
    steps, flight = finish(task, solution) if solution.profile else (np.nan, np.nan)
    return _Refined(proposed - begun, time.process_time() - proposed, steps, flight)


def _row(speed: float, name: str, found: Sequence[dict[str, _Refined]]) -> dict[str, Any]:
    """Return the figures of one proposal at one speed, by the keys of COLUMNS."""
    mine, expert = (np.array([of_path[key] for of_path in found]) for key in (name, EXPERT))
    good = np.isfinite(mine[:, 3])
    kept, theirs = mine[good], expert[good]
    nothing = {column.key: np.nan for column in COLUMNS[4:]}
    row = {"speed": speed, "proposal": name, "paths": len(mine), "failed": int((~good).sum()), **nothing}
    if not len(kept):
        return row
    slower = kept[:, 3] / theirs[:, 3] - 1.0
    return row | {
        "steps": float(kept[:, 2].mean()),
        "steps_p95": float(np.quantile(kept[:, 2], 0.95)),
        "propose": float(np.median(kept[:, 0])),
        "finish": float(np.median(kept[:, 1])),
        "speed_up": float(np.median(theirs[:, :2].sum(axis=1) / kept[:, :2].sum(axis=1))),
        "slower": float(slower.mean()),
        "slower_max": float(slower.max()),
    }
