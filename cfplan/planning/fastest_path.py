"""The fastest path through waypoints: min-snap with the segment times for which the certified flight is shortest.

The times of its segments shape a min-snap path: with times like the straight lengths it swings far out where those
differ. Nelder-Mead searches the logarithms of the times, from times like the lengths or centripetal ones. Its objective
is the flight time that the learned planner proposes, within 1 % of the certified flight for a tenth of its price. A
path that leaves the space costs more than any that does not, and more the further it leaves; the search only compares
costs, so their size does not matter. What it finds is planned and certified beside both min-snap paths, and the
shortest of these flights is taken.
"""

import math
import pathlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cfplan.deadline import NEVER, Deadline
from cfplan.errors import InfeasibleError, InputError
from cfplan.geometry.min_snap import centripetal_times, check_points, min_snap
from cfplan.geometry.path import Path
from cfplan.geometry.path_file import PathFile, PathShape
from cfplan.geometry.yaw import YawMode
from cfplan.planners.task import PlanningTask
from cfplan.planning.plan import default_budget, plan
from cfplan.planning.planners import NODES_PER_PIECE, default_nodes, find_planner
from cfplan.planning.policy import a_model_knows
from cfplan.safety.limits import Limits
from cfplan.safety.space import distances_beyond, inside
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.timing import duration_of

CHOOSING = 0.5  # of the budget of planning
CERTIFYING = 0.2  # of the time for choosing, kept for certifying what was found
OUTSIDE = 1e6  # s, the cost of a path that leaves the space, and a second for each metre: more than any flight takes
FIRST_STEP = 0.25  # of the logarithm of a time
LOG_TOLERANCE, TIME_TOLERANCE = 0.01, 2e-3  # of the logarithms and, s, of the flight time, at which the search ends
COARSE_NODES = 24  # intervals at least, of the expert's plans where no model knows the vehicle and its limits


class FastestPath(NamedTuple):
    """A path through waypoints, and what choosing it was worth."""

    path: Path
    duration: float  # s, of the certified flight at full speed; infinite where there is none
    min_snap: float  # s, likewise along the better min-snap path, with times like the lengths or centripetal ones
    finished: bool  # whether the search ended before the deadline

    def describe(self, speed_factor: float) -> str:
        """Return what the choice was worth, at a factor of the full speed."""
        flown = self.min_snap < math.inf
        gain = f"instead of {self.min_snap / speed_factor:.2f} s" if flown else "where min-snap cannot be flown"
        cut = "" if self.finished else ", its search cut short by the budget"
        return f"fastest path: {self.duration / speed_factor:.2f} s {gain}{cut}"


def chosen_path(
    path_file: PathFile, limits: Limits, *, budget: float | None = None, models: tuple[pathlib.Path, ...] = ()
) -> tuple[PathFile, FastestPath | None]:
    """Return the path file with the path that its shape asks for, and what the choice was worth if there was one.

    Choosing takes at most half of the budget of planning, s; None is that of the min-snap path.
    """
    if path_file.shape is not PathShape.FASTEST or not limits.space.holds(path_file.waypoints):
        return path_file, None  # a waypoint outside the space is refused by what plans the path
    seconds = CHOOSING * (default_budget(path_file.path) if budget is None else budget)
    fastest = fastest_path(
        path_file.waypoints,
        limits.airframe,
        limits,
        laps=path_file.laps,
        yaw=path_file.yaw,
        yaw_angle=path_file.yaw_angle,
        deadline=Deadline.after(seconds),
        models=models,
    )
    return replace(path_file, path=fastest.path), fastest


def fastest_path(
    waypoints: ArrayLike,
    airframe: Airframe,
    limits: Limits,
    *,
    laps: int = 1,
    yaw: YawMode = YawMode.FIXED,
    yaw_angle: float = 0.0,
    deadline: Deadline = NEVER,
    models: tuple[pathlib.Path, ...] = (),
) -> FastestPath:
    """Return the min-snap path through waypoints, (K, 3) m, at rest at both ends, with the shortest certified flight.

    Waypoints of several laps have the same times in each lap. After the deadline the best path found by then is the
    answer. Where none can be flown, the path that leaves the space least is; planning it says why.

    Raises:
        InputError: waypoints as min_snap() refuses them.
    """
    points = np.asarray(waypoints, dtype=float)
    check_points(points)
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    own = len(lengths) // laps  # segments of a lap

    def path_with(logs: NDArray) -> Path:
        times = np.tile(np.exp(logs - logs.max()), laps)
        return min_snap(points, times=times * (lengths.sum() / times.sum()))

    def certified(path: Path) -> float:
        with suppress(InfeasibleError, InputError):
            path.check()
            made = plan(path, airframe, limits, yaw=yaw, yaw_angle=yaw_angle, deadline=deadline, models=models)
            return made.trajectory.duration
        return math.inf

    def cost(logs: NDArray) -> float:
        try:
            path = path_with(logs)
        except InputError:  # times so different that they make no path
            return math.inf
        beyond = distances_beyond(path, limits.space)[1].max(axis=1)
        return duration(path) if inside(beyond).all() else OUTSIDE + float(np.maximum(beyond, 0.0).sum())

    task = PlanningTask(
        min_snap(points), airframe, limits.plan, yaw=yaw, yaw_angle=yaw_angle, deadline=deadline, models=models
    )
    duration = _proposed_duration(task)
    starts = [np.log(lengths[:own]), np.log(centripetal_times(points)[:own])]
    searching = deadline.earlier(CERTIFYING * deadline.left) if deadline.left < math.inf else NEVER
    found, finished = _searched(cost, starts, searching)
    paths = [path_with(logs) for logs in (found, *starts)]
    durations = [certified(path) for path in paths]
    best = int(np.argmin(durations))  # the first of equal ones
    return FastestPath(paths[best], durations[best], min(durations[1:]), finished)


class _OutOfTime(Exception):
    """The deadline passed within the search."""


def _searched(cost: Callable[[NDArray], float], starts: list[NDArray], deadline: Deadline) -> tuple[NDArray, bool]:
    """Return the best of what a search from the best start sees, and whether it ended before the deadline."""
    best, least = starts[0], math.inf

    def watched(logs: NDArray) -> float:
        nonlocal best, least
        if deadline.passed:
            raise _OutOfTime
        if (value := cost(logs)) < least:
            best, least = logs.copy(), value
        return value

    with suppress(_OutOfTime):
        for start in starts:
            watched(start)
        if len(best) > 1 and least < math.inf:
            from scipy.optimize import minimize  # slow to import

            ends = {"xatol": LOG_TOLERANCE, "fatol": TIME_TOLERANCE, "adaptive": True}
            simplex = np.vstack([best, best + FIRST_STEP * np.eye(len(best))])
            minimize(watched, best, method="Nelder-Mead", options=ends | {"initial_simplex": simplex})
        return best, True
    return best, False


def _proposed_duration(task: PlanningTask) -> Callable[[Path], float]:
    """Return how long the task takes along another path: by the learned planner, or the expert on a coarse grid.

    It is infinite where neither finds a profile.
    """
    planner = "learned" if a_model_knows(task, ()).due else "expert"

    def duration(path: Path) -> float:
        coarse = max(COARSE_NODES, NODES_PER_PIECE * (len(path.breaks) - 1))
        nodes = default_nodes(path, planner) if planner == "learned" else coarse
        profile = find_planner(planner)(replace(task, path=path, nodes=nodes)).profile
        return math.inf if profile is None else float(duration_of(profile))

    return duration
