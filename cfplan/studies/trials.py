"""One planner on one path: how long it took, how fast its flight is, and what the certificate says of it."""

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

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
from cfplan.vehicle.trajectory import Trajectory

WAYPOINTS = (3, 6)
# least and most of a random path
BAD_PATH = "bad path"
REFINED = ", refined"
# behind a planner's name: its profile is refined where it does not pass, not just slowed


@dataclass(frozen=True, slots=True)
class Trial:
    """What came of it. Numbers are NaN where there was nothing to measure."""

    planner: str
    seed: int
    # of the path
    status: str
    reason: str
    # "" where a certified flight came out
    plan_seconds: float
    # the planner's call, whole
    solve_seconds: float
    # its solver alone, as it says itself
    repair_seconds: float
    worst_share: float
    # of any limit on the dense grid, before repair
    worst_limit: str
    planned_time: float
    # s of flight, before repair
    certified_time: float
    # s of flight
    speed_factor: float  # on the whole; 1: not slowed
    bound: float
    # s, no flight within speed, acceleration and collective thrust is faster

    @property
    def certified(self) -> bool:
        """Whether a certified flight came out."""
        return bool(np.isfinite(self.certified_time))

    @property
    def unslowed(self) -> bool:
        """Whether the certificate passed as planned."""
        return self.worst_share <= 1.0

    @property
    def whole_seconds(self) -> float:
        """From the path to the certified trajectory."""
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
    """A planner and what is done to those of its profiles that do not pass."""

    plan: Planner
    repair: Callable[..., Repaired]


def find_candidate(name: str) -> Candidate:
    """The planner of that name, slowed; refined where the name says so. Raises InputError."""
    return Candidate(find_planner(name.removesuffix(REFINED)), repair if name.endswith(REFINED) else slow)


def random_path(seed: int, box: str, waypoints: tuple[int, int] = WAYPOINTS) -> Path:
    """The random path of that seed in one of the named boxes."""
    size = np.array(find_box(box))
    return min_snap(random_waypoints(seed, np.stack([np.zeros(3), size]), waypoints))


def find_box(name: str) -> tuple[float, float, float]:
    """m, its sides. Raises InputError."""
    if name not in BOXES:
        raise InputError(f"unknown box {name!r}", hint=f"known: {', '.join(BOXES)}")
    return BOXES[name]


def find_limit_set(name: str) -> LimitSet:
    """The limit set of that name. Raises InputError."""
    if name not in LIMIT_SETS:
        raise InputError(f"unknown limit set {name!r}", hint=f"known: {', '.join(LIMIT_SETS)}")
    return LIMIT_SETS[name]


def path_trials(
    candidates: Mapping[str, Candidate], seed: int, box: str, chosen: LimitSet, *, nodes: int, yaw: YawMode
) -> list[Trial]:
    """Every planner's trial on the random path of that seed; a path with a cusp is a bad one for all."""
    try:
        path = random_path(seed, box)
        path.check()
        bound = lower_bound(PlanningTask(path, chosen.airframe, chosen.limits))
    except CfplanError as error:
        return [failed_trial(name, seed, BAD_PATH, str(error)) for name in candidates]
    return [
        run_trial(name, candidate, path, seed, chosen, nodes=nodes, yaw=yaw, bound=bound)
        for name, candidate in candidates.items()
    ]


def run_trial(
    name: str, candidate: Candidate, path: Path, seed: int, chosen: LimitSet, *, nodes: int, yaw: YawMode, bound: float
) -> Trial:
    """Plan, certify, repair. Whatever fails is a trial with a reason."""
    begun = time.perf_counter()
    task = PlanningTask(path, chosen.airframe, chosen.limits, nodes, yaw)
    solution = candidate.plan(task)
    plan_seconds = time.perf_counter() - begun
    solve_seconds = float(solution.stats.get("solve_seconds", np.nan))
    values = {"plan_seconds": plan_seconds, "solve_seconds": solve_seconds, "bound": bound}
    if solution.profile is None:
        return failed_trial(name, seed, solution.status.name, solution.reason or str(solution.status), **values)
    try:
        planned = Trajectory(path, solution.profile, chosen.airframe)
        certificate = certify(planned, chosen.limits)
        begun = time.perf_counter()
        repaired = candidate.repair(task, solution.profile)
        repair_seconds = time.perf_counter() - begun
    except CfplanError as error:
        return failed_trial(name, seed, Status.SOLVED.name, f"not certified: {error}", **values)
    return Trial(
        planner=name, seed=seed, status=solution.status.name, reason="", repair_seconds=repair_seconds,
        worst_share=certificate.worst.share, worst_limit=certificate.worst.name, planned_time=planned.duration,
        certified_time=repaired.trajectory.duration,
        speed_factor=repaired.speed_factor, **values,
    )  # fmt: skip


def failed_trial(
    name: str,
    seed: int,
    status: str,
    reason: str,
    *,
    plan_seconds: float = np.nan,
    solve_seconds: float = np.nan,
    bound: float = np.nan,
) -> Trial:
    """A trial without a certified flight."""
    return Trial(
        name, seed, status, reason, plan_seconds, solve_seconds, np.nan, np.nan, "", np.nan, np.nan, np.nan, bound
    )  # fmt: skip


def quantiles(values: Iterator[float] | list[float]) -> tuple[float, float, float]:
    """Median, p90, p99 of those that are finite; NaN where none is."""
    finite = [value for value in values if np.isfinite(value)]
    if not finite:
        return (float("nan"),) * 3
    median, p90, p99 = (float(np.quantile(finite, level)) for level in (0.5, 0.9, 0.99))
    return median, p90, p99
