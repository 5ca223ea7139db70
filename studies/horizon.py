"""Plan along random waypoints of which only the next few are known, and compare with knowing them all at once.

Whenever a waypoint is passed another one is told, and the plan goes on through it from a joint there, as requests in
flight do. It always ends at rest at the last waypoint known. The whole path is the one that is planned before take-off.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cfplan.geometry.min_snap import MIN_SPACING, centripetal_times, min_snap
from cfplan.geometry.random_paths import random_waypoints
from cfplan.planning.continuation import NoWayError, continue_plan
from cfplan.planning.plan import plan
from cfplan.safety.limits import Limits
from cfplan.safety.limits_file import load_limits
from cfplan.safety.space import Space
from studies.runner.result import Column, StudyResult, Table, detail_table
from studies.trials import quantile_values
from cfplan.vehicle.trajectory import Trajectory

LATER = (0.0, 0.15, 0.35)  # s after a waypoint, at which the plan is continued: where it cannot be at once, later
WALL_DISTANCE = 0.3  # m beyond the margin, that random waypoints keep
ROOM = 5.0  # m by which the walls are moved outwards: what is compared are times, not whether curves swing too far out
COLUMNS = (
    Column("known", "waypoints known"),
    Column("paths", "paths"),
    Column("lost_all", "time lost, all paths", "%", ".2f", goal="3 %", meaning="of the sum of all times"),
    Column("lost_median", "median path", "%", ".2f", meaning="negative: the curve laid piece by piece is faster"),
    Column("lost_p90", "p90", "%", ".2f"),
    Column("lost_max", "most", "%", ".2f"),
    Column("stops", "stops between", meaning="where no plan could be continued, so the vehicle came to rest"),
)


@dataclass(frozen=True, slots=True)
class _Trial:
    seed: int
    known: int
    whole: float  # s, knowing all waypoints
    duration: float  # s, knowing some
    stops: int  # between

    @property
    def lost(self) -> float:
        return self.duration / self.whole - 1.0


def horizon(
    safety_file: FilePath,
    *,
    paths: int = 100,
    first_seed: int = 0,
    waypoints: int = 20,
    known: tuple[int, ...] = (3,),
    jobs: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> StudyResult:
    """Plan along so many random paths, each time knowing `known` waypoints ahead, on `jobs` processes."""
    from joblib import Parallel, delayed

    limits = load_limits(safety_file)
    work = [(seed, waypoints, ahead) for seed in range(first_seed, first_seed + paths) for ahead in known]
    trials: list[_Trial] = []
    for trial in Parallel(n_jobs=jobs, return_as="generator")(delayed(_trial)(*each, limits) for each in work):
        trials.append(trial)
        progress(len(trials), len(work))
    rows = tuple(_row(ahead, [trial for trial in trials if trial.known == ahead]) for ahead in known)
    title = f"Time lost by knowing only the next waypoints of {waypoints}"
    settings = {"paths": paths, "first_seed": first_seed, "waypoints": waypoints, "known": list(known)}
    return StudyResult("horizon", settings, (Table("horizon", title, COLUMNS, rows),), (detail_table("paths", trials),))


def _trial(seed: int, waypoints: int, known: int, limits: Limits) -> _Trial:
    space = limits.space
    away = space.margin + WALL_DISTANCE
    low, high = np.array(space.low), np.array(space.high)
    points = random_waypoints(seed, np.array([low + away, high - away]), (waypoints, waypoints))
    roomy = replace(limits, space=Space(tuple((low - ROOM).tolist()), tuple((high + ROOM).tolist()), space.margin))
    duration, stops = fly_knowing(points, known, roomy)
    return _Trial(seed, known, _from_rest(points, roomy)[0].duration, duration, stops)


def fly_knowing(points: NDArray, known: int, limits: Limits) -> tuple[float, int]:
    """Return how long, s, a flight from the first of the points, (N, 3) m, through all others takes, and its stops.

    `known` are the waypoints ahead that are known, at least 1; of those at which it stops without need it knows as
    many. Raises a CfplanError where not even a plan from rest leads through them.
    """
    trajectory, reached = _from_rest(points[: known + 1], limits)
    ahead, told = points[1 : known + 1], points[known + 1 :]
    elapsed, stops = 0.0, 0
    while len(told):
        passed = float(trajectory.time_at(reached[0]))
        for later in LATER:
            if passed + later >= trajectory.duration:
                continue
            s = float(trajectory.s_at(passed + later))
            here = trajectory.path(s)
            kept = [
                number
                for number, (point, at) in enumerate(zip(ahead, reached, strict=True))
                if at > s and np.linalg.norm(point - here) >= MIN_SPACING
            ]
            new = told[: max(known - len(kept), 1)]
            through = np.concatenate([ahead[kept].reshape(-1, 3), new])
            begin = through[len(kept) - 1] if kept else here
            onwards = centripetal_times(np.concatenate([begin[None], new]))
            times = np.concatenate([np.diff([s, *(reached[number] for number in kept)]), onwards])
            try:
                made = continue_plan(trajectory, passed + later, through, limits, times=times)
            except NoWayError:
                continue
            elapsed += passed + later
            trajectory, reached, ahead, told = made.plan.trajectory, made.reached, through, told[len(new) :]
            break
        else:
            elapsed, stops = elapsed + trajectory.duration, stops + 1
            from_rest = np.concatenate([ahead[-1:], told[:known]])
            trajectory, reached = _from_rest(from_rest, limits)
            ahead, told = from_rest[1:], told[known:]
    return elapsed + trajectory.duration, stops


def _from_rest(points: NDArray, limits: Limits) -> tuple[Trajectory, tuple[float, ...]]:
    """Return the plan from the first of the points through the others, and the s of each of those."""
    times = centripetal_times(points)
    planned = plan(min_snap(points, times=times), limits.airframe, limits, planner="expert")
    return planned.trajectory, tuple(np.cumsum(times).tolist())


def _row(known: int, trials: list[_Trial]) -> dict[str, Any]:
    return {
        "known": known,
        "paths": len(trials),
        "lost_all": sum(trial.duration for trial in trials) / sum(trial.whole for trial in trials) - 1.0,
        **quantile_values("lost", (trial.lost for trial in trials)),
        "lost_max": max(trial.lost for trial in trials),
        "stops": sum(trial.stops for trial in trials),
    }
