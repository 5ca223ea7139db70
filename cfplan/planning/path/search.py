"""The search for the fastest path through waypoints: its starting points, and how the path is kept in the room."""

import math
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.deadline import NEVER, Deadline
from cfplan.files.shipped import example_limits
from cfplan.geometry.min_snap import centripetal_times
from cfplan.geometry.path import Path
from cfplan.geometry.path_file import PathFile, path_through
from cfplan.geometry.waypoints import Gate
from cfplan.geometry.yaw import YawMode
from cfplan.planning.path.cost import Course, PathCost
from cfplan.planning.path.descent import Cost, descend
from cfplan.planning.path.detour import with_corners
from cfplan.planning.path.room import Room
from cfplan.planning.path.variables import Knots, variables_of, with_points_between
from cfplan.safety.limit_sets import LimitSet
from cfplan.safety.limits import Limits, PlanLimits
from cfplan.safety.limits_file import load_limits
from cfplan.safety.space import Space, inside

TOLERANCE, ITERATIONS = 2e-4, 80  # relative improvement of the flight time at which it stops; most steps
LOOSE_TOLERANCE = 0.01  # the same for the first descent, by the length of the path
# Weights of the excursion from the room, s/m³: a descent that ends outside is repeated with the next weight, and keeps
# further inside by as much.
WEIGHTS = (100.0, 1e3, 1e4, 1e5, 1e5, 1e5)
_ASSUMED_ACCELERATION = 0.5  # of the limit on acceleration, assumed in initial times
RESERVE = 0.002  # m, kept inside in addition


class ChosenKnots(NamedTuple):
    """Where a search ended."""

    knots: Knots
    missed: float  # m, how far the path leaves the room; negative inside
    aside: float  # m, how far it leaves the corridor; likewise
    aside_leg: int  # the worst straight line between waypoints, from 0
    finished: bool  # before the deadline


def timed(points: NDArray, waypoint: NDArray) -> tuple[Knots, Knots]:
    """Return points with times like their straight lengths, and with centripetal ones; `waypoint` numbers waypoints."""
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    centripetal = centripetal_times(points)
    return Knots(lengths, points, waypoint), Knots(centripetal * (lengths.sum() / centripetal.sum()), points, waypoint)


def times_as_flown(points: NDArray, limits: PlanLimits) -> NDArray:
    """Return about how long the straight lines between points, (K, 3) m, would take, (K-1,) s, from rest to rest.

    At a corner the speed falls to the cosine of half its angle, so close points on a straight line do not slow the
    vehicle down in these times.
    """
    steps = np.diff(points, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    ahead = steps / lengths[:, None]
    gain = _ASSUMED_ACCELERATION * limits.acceleration
    speeds = np.zeros(len(points))
    speeds[1:-1] = limits.speed * np.sqrt(np.maximum((1.0 + (ahead[1:] * ahead[:-1]).sum(axis=1)) / 2.0, 0.0))
    for order in (range(len(lengths)), range(len(lengths) - 1, -1, -1)):
        for k in order:
            slow, fast = (k, k + 1) if order.step == 1 else (k + 1, k)
            speeds[fast] = min(speeds[fast], math.sqrt(speeds[slow] ** 2 + 2.0 * gain * lengths[k]))
    ends = speeds[:-1] ** 2 + speeds[1:] ** 2
    top = np.minimum(limits.speed, np.sqrt(gain * lengths + ends / 2.0))
    changing = (2.0 * top**2 - ends) / (2.0 * gain)  # m
    return np.asarray((2.0 * top - speeds[:-1] - speeds[1:]) / gain + np.maximum(lengths - changing, 0.0) / top)


def search(path_file: PathFile, limits: Limits, deadline: Deadline) -> ChosenKnots:
    """Return the best result of descents over segment times, waypoints within their regions, and points between.

    If link loss must end clear of obstacles, paths for which that is likely are searched first.
    """
    room = Room(limits.space, path_file.waypoints, path_file.corridor)
    rooms = [room]
    if limits.space.obstacles and not limits.link_loss.only_warn:
        rooms = [room.to_come_down(), room]
    for each in rooms:
        found = _search_in(each, path_file, limits, deadline)
        if inside(found.missed) or not found.finished:
            break
    return found


def fastest_by_search(points: NDArray, space: Space, chosen: LimitSet, yaw: YawMode, yaw_angle: float) -> Path:
    """Return the path found through waypoints, (K, 3) m, by a search without a deadline, for datasets.

    It is reproducible, as it depends neither on a clock nor on a network.
    """
    path_file = replace(path_through(points), yaw=yaw, yaw_angle=yaw_angle)
    limits = replace(_example_limits(), airframe=chosen.airframe, plan=chosen.limits, space=space)
    return search(path_file, limits, NEVER).knots.path


@cache
def _example_limits() -> Limits:
    return load_limits(example_limits())


def _search_in(room: Room, path_file: PathFile, limits: Limits, deadline: Deadline) -> ChosenKnots:
    """Return the result of a descent from the best of three timings."""
    points, waypoint = with_corners(path_file.waypoints, room.space)
    flown = times_as_flown(points, limits.plan)
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    timings = *timed(points, waypoint), Knots(flown * (lengths.sum() / flown.sum()), points, waypoint)
    starts = [_started(path_file, knots) for knots in timings]
    course = Course(path_file.regions, path_file.yaw, path_file.yaw_angle)
    costs = []
    for start in starts:
        variables = variables_of(start, path_file.regions, path_file.laps, limits.space.margin)
        costs.append(PathCost(course, limits, room, variables, deadline))
    cost = min(costs, key=lambda each: each(each.variables.first)[0])
    x = cost.variables.first
    if not inside(cost.missed(x)):
        x, _ = _descend_inside(cost, cost.by_length, x, LOOSE_TOLERANCE, deadline)
    x, finished = _descend_inside(cost, cost, x, TOLERANCE, deadline)
    x = x if cost.best is None else cost.best
    return ChosenKnots(cost.variables.knots(x), cost.missed(x), *cost.aside(x), finished)


def _descend_inside(
    kept: PathCost, cost: Cost, x: NDArray, tolerance: float, deadline: Deadline
) -> tuple[NDArray, bool]:
    """Descend from x until the path stays inside the room, and return its end, and whether it finished in time."""
    kept.reserve = 0.0
    for weight in WEIGHTS:
        kept.weight = weight
        descent = descend(cost, x, deadline, tolerance=tolerance, iterations=ITERATIONS)
        x = descent.x
        missed = kept.missed(x)
        if inside(missed) or not descent.finished or descent.cost == math.inf:
            break
        kept.reserve += missed + RESERVE
    return x, descent.finished


def _started(path_file: PathFile, knots: Knots) -> Knots:
    """Return initial knots, with a point between each two waypoints that leads forwards into gates."""
    knots = with_points_between(knots)
    for point, region in zip(knots.waypoint, path_file.regions, strict=True):
        if isinstance(region, Gate):
            for beside, side in ((point - 1, -1.0), (point + 1, 1.0)):
                if 0 <= beside < len(knots.points):
                    far = np.linalg.norm(knots.points[beside] - knots.points[point])
                    knots.points[beside] = knots.points[point] + side * far * region.forwards
    return knots
