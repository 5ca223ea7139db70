"""Plan along random waypoints with only the next few known, and measure the time lost against knowing all of them.

Each time a waypoint is passed, the next one is revealed and the plan is continued through it from a joint near the
passed one, as requests in flight do. A plan always ends at rest at the last known waypoint. The reference is the
fastest plan along a path through all waypoints, made before take-off.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path as FilePath

import numpy as np
from numpy.typing import NDArray

from cfplan.geometry.min_snap import MIN_SPACING
from cfplan.geometry.path_file import path_through
from cfplan.geometry.random_paths import random_waypoints
from cfplan.planning.continuation import NoWayError, continue_plan, plan_from_rest
from cfplan.planning.path.choice import fastest_path
from cfplan.safety.limits import Limits
from cfplan.safety.space import Space
from studies.runner.limits import limits_for
from studies.runner.options import option
from studies.runner.reductions import count, largest, quantile, total
from studies.runner.result import Column, Table, table
from studies.runner.study import Run, Study, Work

JOINT_DELAYS = (0.0, 0.15, 0.35)  # s from a waypoint to the joint; the first that allows a continuation is taken
WALL_DISTANCE = 0.3  # m that random waypoints keep from the margin
ROOM = 5.0  # m by which the walls are moved out, so that only times are compared, not how far curves swing out


@dataclass(frozen=True, slots=True)
class Settings:
    """The paths to plan."""

    paths: int = option(100, "Random paths.", least=1)
    seed: int = option(0, "Seed of the first path.", least=0)
    waypoints: int = option(20, "Waypoints of each path.", least=3)
    known: tuple[int, ...] = option((3,), "Number of known waypoints ahead.", least=1)


@dataclass(frozen=True, slots=True)
class ShortSighted:
    """One path, planned with only some of its waypoints known."""

    seed: int
    known: int
    complete: float  # s, knowing all waypoints
    duration: float  # s, knowing some
    stops: int  # before the last waypoint

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
    """Plan the path of a seed with some of its waypoints known. Raises a CfplanError if it cannot be planned."""
    seed, known = case
    space = limits.space
    away = space.margin + WALL_DISTANCE
    low, high = np.array(space.low), np.array(space.high)
    points = random_waypoints(seed, np.array([low + away, high - away]), (waypoints, waypoints))
    roomy = replace(limits, space=Space(tuple((low - ROOM).tolist()), tuple((high + ROOM).tolist()), space.margin))
    duration, stops = fly_knowing(points, known, roomy)
    return ShortSighted(seed, known, fastest_path(path_through(points), roomy).duration, duration, stops)


def fly_knowing(points: NDArray, known: int, limits: Limits) -> tuple[float, int]:
    """Return the duration, s, and the number of stops of a flight through all of the points, (N, 3) m.

    `known` is the number of waypoints ahead that are known, at least 1. Where no plan can be continued, the vehicle
    comes to rest and starts again with as many. Raises a CfplanError if not even a plan from rest leads through them.
    """
    made = plan_from_rest(points[: known + 1], limits)
    trajectory, reached = made.plan.trajectory, made.reached
    ahead, hidden = points[1 : known + 1], points[known + 1 :]
    elapsed, stops = 0.0, 0
    while len(hidden):
        passed = float(trajectory.time_at(reached[0]))
        for later in JOINT_DELAYS:
            if passed + later >= trajectory.duration:
                continue
            s = float(trajectory.s_at(passed + later))
            here = trajectory.path(s)
            kept = [
                number
                for number, (point, at) in enumerate(zip(ahead, reached, strict=True))
                if at > s and np.linalg.norm(point - here) >= MIN_SPACING
            ]
            new = hidden[: max(known - len(kept), 1)]
            through = np.concatenate([ahead[kept].reshape(-1, 3), new])
            try:
                made = continue_plan(
                    trajectory, passed + later, through, limits, reached=[reached[number] for number in kept]
                )
            except NoWayError:
                continue
            elapsed += passed + later
            trajectory, reached, ahead, hidden = made.plan.trajectory, made.reached, through, hidden[len(new) :]
            break
        else:
            elapsed, stops = elapsed + trajectory.duration, stops + 1
            from_rest = np.concatenate([ahead[-1:], hidden[:known]])
            made = plan_from_rest(from_rest, limits)
            trajectory, reached = made.plan.trajectory, made.reached
            ahead, hidden = from_rest[1:], hidden[known:]
    return elapsed + trajectory.duration, stops


def tables(settings: Settings, rows: list[ShortSighted]) -> Iterator[Table]:
    """Yield a table with one row per number of known waypoints."""
    title = f"Time lost by knowing only the next waypoints of {settings.waypoints}"
    yield table("horizon", title, COLUMNS, rows, by=("known",))


STUDY = Study(Settings, work, tables, "--known 3 --known 5 -o results/horizon.json")
