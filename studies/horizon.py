"""Plan along random waypoints of which only the next few are known, and compare with knowing all: time lost.

Whenever a waypoint is passed another one is told, and the plan goes on through it from a joint there, as requests in
flight do. It always ends at rest at the last waypoint known. The whole path is the one that is planned before take-off.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path as FilePath

import numpy as np
from numpy.typing import NDArray

from cfplan.geometry.min_snap import MIN_SPACING, centripetal_times, min_snap
from cfplan.geometry.random_paths import random_waypoints
from cfplan.planning.continuation import NoWayError, continue_plan
from cfplan.planning.plan import plan
from cfplan.safety.limits import Limits
from cfplan.safety.space import Space
from cfplan.vehicle.trajectory import Trajectory
from studies.runner.limits import limits_for
from studies.runner.options import option
from studies.runner.reductions import count, largest, quantile, total
from studies.runner.result import Column, Table, table
from studies.runner.study import Run, Study, Work

LATER = (0.0, 0.15, 0.35)  # s after a waypoint, at which the plan is continued: where it cannot be at once, later
WALL_DISTANCE = 0.3  # m beyond the margin, that random waypoints keep
ROOM = 5.0  # m by which the walls are moved outwards: what is compared are times, not whether curves swing too far out


@dataclass(frozen=True, slots=True)
class Settings:
    """Which paths are planned."""

    paths: int = option(100, "Random paths.", least=1)
    seed: int = option(0, "Of the first path.", least=0)
    waypoints: int = option(20, "Of each path.", least=3)
    known: tuple[int, ...] = option((3,), "Waypoints ahead that are known.", least=1)


@dataclass(frozen=True, slots=True)
class ShortSighted:
    """One path, planned with few of its waypoints known."""

    seed: int
    known: int
    complete: float  # s, knowing all waypoints
    duration: float  # s, knowing some
    stops: int  # between

    @property
    def lost(self) -> float:
        """Return the time lost by knowing only some, relative."""
        return self.duration / self.complete - 1.0


def _lost_of_all(rows: Sequence[ShortSighted]) -> float:
    return total("duration")(rows) / total("complete")(rows) - 1.0


COLUMNS = (
    Column("known", "waypoints known"),
    Column("paths", "paths", value=count()),
    Column("lost_all", "time lost, all paths", "%", ".2f", goal="3 %", meaning="of the sum of all times",
           value=_lost_of_all),
    Column("lost_median", "median path", "%", ".2f", meaning="negative: the curve laid piece by piece is faster",
           value=quantile("lost", 0.5)),
    Column("lost_p90", "p90", "%", ".2f", value=quantile("lost", 0.9)),
    Column("lost_max", "most", "%", ".2f", value=largest("lost")),
    Column("stops", "stops between", meaning="where no plan could be continued, so the vehicle came to rest",
           value=lambda rows: sum(row.stops for row in rows)),
)  # fmt: skip


def work(settings: Settings, run: Run) -> Work:
    """Return a case for each path and number of known waypoints."""
    seeds = range(settings.seed, settings.seed + settings.paths)
    cases = {f"{seed}, {known} known": (seed, known) for seed in seeds for known in settings.known}
    return Work(cases, partial(measure, waypoints=settings.waypoints, limits=limits_for(FilePath())), ShortSighted)


def measure(case: tuple[int, int], waypoints: int, limits: Limits) -> ShortSighted:
    """Plan the path of a seed knowing some of its waypoints. Raises a CfplanError where it cannot be planned."""
    seed, known = case
    space = limits.space
    away = space.margin + WALL_DISTANCE
    low, high = np.array(space.low), np.array(space.high)
    points = random_waypoints(seed, np.array([low + away, high - away]), (waypoints, waypoints))
    roomy = replace(limits, space=Space(tuple((low - ROOM).tolist()), tuple((high + ROOM).tolist()), space.margin))
    duration, stops = fly_knowing(points, known, roomy)
    return ShortSighted(seed, known, _from_rest(points, roomy)[0].duration, duration, stops)


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


def tables(settings: Settings, rows: list[ShortSighted]) -> Iterator[Table]:
    """Yield a line for each number of known waypoints."""
    title = f"Time lost by knowing only the next waypoints of {settings.waypoints}"
    yield table("horizon", title, COLUMNS, rows, by=("known",))


STUDY = Study(Settings, work, tables, "--known 3 --known 5 -o results/horizon.json")
