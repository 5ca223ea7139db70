"""Run one planner on one path: how long it takes, how fast its flight is, and what the certificate says of it."""

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from cfplan.errors import CfplanError, InputError
from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.path import Path
from cfplan.geometry.random_paths import random_waypoints
from cfplan.geometry.yaw import YawMode
from cfplan.planners.baselines.convex import lower_bound
from cfplan.planners.solution import Status
from cfplan.planners.task import Planner, PlanningTask
from cfplan.planning.planners import find_planner
from cfplan.planning.repair import Repaired, repair, slow
from cfplan.safety.certificate import certify
from cfplan.safety.limit_sets import BOXES, LIMIT_SETS, LimitSet
from studies.runner.result import LEVELS
from cfplan.vehicle.trajectory import Trajectory

WAYPOINTS = (3, 6)  # fewest and most of a random path
BAD_PATH = "bad path"
REFINED = ", refined"  # behind a planner's name: its profile is refined where it does not pass, not only slowed


@dataclass(frozen=True, slots=True)
class PlannerTrial:
    """One planner's plan of one path. Numbers are NaN where there was nothing to measure."""

    box: str
    limits: str
    planner: str
    seed: int  # of the path
    status: str
    reason: str  # why there is no certified flight; "" where there is one
    plan_seconds: float  # of the planner's call
    solve_seconds: float  # of its solver alone, as the solver says
    repair_seconds: float
    worst_share: float  # of any limit on the dense grid, before repair
    worst_limit: str
    planned_time: float  # s of flight, before repair
    certified_time: float  # s of flight
    speed_factor: float  # on the whole; 1: not slowed
    bound: float  # s, no flight within speed, acceleration and collective thrust is faster

    @property
    def certified(self) -> bool:
        """Return whether there is a certified flight."""
        return bool(np.isfinite(self.certified_time))

    @property
    def unslowed(self) -> bool:
        """Return whether the certificate passed as planned."""
        return self.worst_share <= 1.0

    @property
    def whole_seconds(self) -> float:
        """Return the time, s, from the path to the certified trajectory."""
        return self.plan_seconds + self.repair_seconds

    @property
    def gap(self) -> float:
        """Time over the lower bound, relative."""
        return self.certified_time / self.bound - 1.0

    @property
    def lost(self) -> float:
        """Time that repair cost, relative."""
        return self.certified_time / self.planned_time - 1.0


class Candidate(NamedTuple):
    """A planner, and how those of its profiles are repaired that do not pass."""

    plan: Planner
    repair: Callable[..., Repaired]


def find_candidate(name: str) -> Candidate:
    """Return the planner of that name with slowing; with refining where the name says so. Raises InputError."""
    return Candidate(find_planner(name.removesuffix(REFINED)), repair if name.endswith(REFINED) else slow)


def random_path(seed: int, box: str, waypoints: tuple[int, int] = WAYPOINTS) -> Path:
    """Return the random path of that seed in one of the named boxes."""
    size = np.array(find_box(box))
    return min_snap(random_waypoints(seed, np.stack([np.zeros(3), size]), waypoints))


def find_box(name: str) -> tuple[float, float, float]:
    """Return its sides, m. Raises InputError."""
    if name not in BOXES:
        raise InputError(f"unknown box {name!r}", hint=f"known: {', '.join(BOXES)}")
    return BOXES[name]


def find_limit_set(name: str) -> LimitSet:
    """Return the limit set of that name. Raises InputError."""
    if name not in LIMIT_SETS:
        raise InputError(f"unknown limit set {name!r}", hint=f"known: {', '.join(LIMIT_SETS)}")
    return LIMIT_SETS[name]


def path_trials(
    candidates: Mapping[str, Candidate], seed: int, box: str, chosen: LimitSet, *, nodes: int, yaw: YawMode
) -> list[PlannerTrial]:
    """Return every planner's trial on the random path of that seed; a path with a cusp is a bad one for all.

    Planners come in the opposite order on every other path: one that works like the one before finds its code and data
    in the processor's caches, which takes up to a fifth off its time.
    """
    try:
        path = random_path(seed, box)
        path.check()
        bound = lower_bound(PlanningTask(path, chosen.airframe, chosen.limits))
    except CfplanError as error:
        return [
            PlannerTrial(box, chosen.name, name, seed, BAD_PATH, str(error), **_NOT_MEASURED) for name in candidates
        ]
    order = list(candidates.items())[:: -1 if seed % 2 else 1]
    return [
        run_trial(name, candidate, path, seed, box, chosen, nodes=nodes, yaw=yaw, bound=bound)
        for name, candidate in order
    ]


def run_trial(
    name: str,
    candidate: Candidate,
    path: Path,
    seed: int,
    box: str,
    chosen: LimitSet,
    *,
    nodes: int,
    yaw: YawMode,
    bound: float,
) -> PlannerTrial:
    """Plan, certify, repair. What fails is a trial with a reason."""
    begun = time.process_time()
    task = PlanningTask(path, chosen.airframe, chosen.limits, nodes, yaw)
    solution = candidate.plan(task)
    plan_seconds = time.process_time() - begun
    solve_seconds = float(solution.stats.get("solve_seconds", np.nan))
    values = _NOT_MEASURED | {"plan_seconds": plan_seconds, "solve_seconds": solve_seconds, "bound": bound}
    if solution.profile is None:
        reason = solution.reason or str(solution.status)
        return PlannerTrial(box, chosen.name, name, seed, solution.status.name, reason, **values)
    try:
        planned = Trajectory(path, solution.profile, chosen.airframe)
        certificate = certify(planned, chosen.limits)
        begun = time.process_time()
        repaired = candidate.repair(task, solution.profile)
        repair_seconds = time.process_time() - begun
    except CfplanError as error:
        return PlannerTrial(box, chosen.name, name, seed, Status.SOLVED.name, f"not certified: {error}", **values)
    values |= {
        "repair_seconds": repair_seconds,
        "worst_share": certificate.worst.share,
        "worst_limit": certificate.worst.name,
        "planned_time": planned.duration,
        "certified_time": repaired.trajectory.duration,
        "speed_factor": repaired.speed_factor,
    }
    return PlannerTrial(box, chosen.name, name, seed, solution.status.name, "", **values)


def quantiles(values: Iterable[float]) -> tuple[float, float, float]:
    """Return median, p90 and p99 of those that are finite; NaN where there is none."""
    finite = [value for value in values if np.isfinite(value)]
    if not finite:
        return (float("nan"),) * 3
    median, p90, p99 = (float(np.quantile(finite, level)) for level in LEVELS.values())
    return median, p90, p99


def quantile_values(key: str, values: Iterable[float]) -> dict[str, float]:
    """Return the same by the keys of `quantile_columns`."""
    return {f"{key}_{level}": value for level, value in zip(LEVELS, quantiles(values), strict=True)}


_NOT_MEASURED: dict[str, Any] = dict.fromkeys(
    ("plan_seconds", "solve_seconds", "repair_seconds", "worst_share", "planned_time", "certified_time", "speed_factor",
     "bound"),
    np.nan,
) | {"worst_limit": ""}  # fmt: skip
