"""Choose paths that continue a motion, like those from rest but within the few milliseconds available in flight.

A path begins in the state at a joint, with time as s, or at rest. It is chosen by a descent with soft limits, which may
begin with any path (soft_limits.py). The number of steps is bounded, not their time, so the same request has the same
path on every computer. If the result cannot be flown, the descent goes on with harder limits, and then from a path that
brakes first.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.deadline import NEVER
from cfplan.geometry.waypoints import Region
from cfplan.geometry.yaw import YawMode
from cfplan.planning.path.descent import descend
from cfplan.planning.path.detour import with_corners
from cfplan.planning.path.room import Room
from cfplan.planning.path.soft_limits import SoftLimits
from cfplan.planning.path.variables import Knots, variables_of, with_points_between
from cfplan.safety.limits import Limits
from cfplan.vehicle.profile import BoundaryState
from cfplan.vehicle.trajectory import Trajectory

# Weights of the excess over soft limits, in successive descents. If 1 is the first, flights are 1 % longer; without the
# last, more paths cannot be flown.
WEIGHTS = (0.3, 3.0, 30.0, 300.0)
STEPS, TOLERANCE = 100, 5e-4  # of descents; the tolerance is a fraction of the cost
_ASSUMED_ACCELERATION = 0.7  # fraction of the limit on acceleration that is assumed in initial paths
_SOON = 0.1  # s, the shortest segment of an initial path
_SAME = 1e-9  # fraction of a path's end, within which two of its places count as one
_INSIDE = 0.05  # m inside the margin, for points of an initial path


@dataclass(frozen=True, slots=True, eq=False)
class Departure:
    """The state in which a path begins."""

    position: NDArray  # (3,) m
    motion: NDArray | None = None  # (5, 3) γ to γ'''' with time as s; None at rest
    state: BoundaryState | None = None  # None at rest
    yaw: YawMode = YawMode.FIXED
    yaw_angle: float = 0.0  # rad, final yaw

    @property
    def velocity(self) -> NDArray:
        """Return the velocity, (3,) m/s."""
        return np.zeros(3) if self.motion is None else self.motion[1]


def onward_paths(starts: list[Knots], departure: Departure, limits: Limits, speed: float) -> Iterator[Knots]:
    """Yield paths from a departure; the initial path in `starts` with the least cost is descended first.

    `speed`, m/s, is an additional limit. Paths may still leave the room, or exceed a limit from the start on.
    """
    room = Room(limits.space, starts[0].points[starts[0].waypoint], None)
    if limits.space.obstacles and not limits.link_loss.only_warn:
        room = room.to_come_down()
    regions = (None,) * len(starts[0].waypoint)
    begun = max(speed, float(np.linalg.norm(departure.velocity)))  # a path made for braking at once would turn too fast
    soft = [_soft(knots, regions, limits, room, begun) for knots in starts]
    firsts = [each.first for each in soft]
    costs = [each(first)[0] for each, first in zip(soft, firsts, strict=True)]
    for number in np.argsort(costs, kind="stable"):
        each, x = soft[number], firsts[number]
        for weight in WEIGHTS:
            each.weight = weight
            x = descend(each, x, NEVER, tolerance=TOLERANCE, iterations=STEPS).x
            yield each.knots(x)


def _soft(knots: Knots, regions: tuple[Region, ...], limits: Limits, room: Room, speed: float) -> SoftLimits:
    return SoftLimits(variables_of(knots, regions, 1, limits.space.margin), limits, room, min(speed, limits.plan.speed))


def toward(departure: Departure, waypoints: NDArray, limits: Limits) -> list[Knots]:
    """Return initial paths through waypoints, (K, 3) m: straight to them, and, in motion, one that brakes first."""
    points, waypoint = with_corners(np.concatenate([departure.position[None], waypoints]), limits.space)
    straight = Knots(_times(points, departure.velocity, limits), points, waypoint, departure.motion)
    straight = _clipped(with_points_between(straight), limits)
    if departure.motion is None:
        return [straight]
    times, points = straight.times.copy(), straight.points.copy()
    braking = float(np.linalg.norm(departure.velocity)) / _gain(limits) + _SOON
    points[1] = departure.position + departure.velocity * braking / 2
    away = float(np.linalg.norm(points[2] - points[1]))
    times[0], times[1] = braking, 1.5 * math.sqrt(away / _gain(limits)) + _SOON
    return [straight, _clipped(straight._replace(times=times, points=points), limits)]


def along(
    trajectory: Trajectory, leave: float, reached: NDArray, departure: Departure, more: NDArray, limits: Limits
) -> Knots:
    """Return the knots of the previous path from `leave`, s, on, at the times at which they are flown.

    `reached`, (K,), is s at the waypoints that stay; `more`, (J, 3) m, are waypoints behind them. K + J is at least 1.
    """
    path, s = trajectory.path, float(trajectory.s_at(leave))
    free = path.breaks[(path.breaks > s) & (path.breaks < reached.max(initial=s))]
    free = free[(np.abs(free[:, None] - np.append(reached, s)) > _SAME * path.end).all(axis=1)]
    places = np.sort(np.concatenate([[s], reached, free]))
    is_waypoint = np.isin(places, np.append(reached, s))
    times = trajectory.time_at(places)
    # Points that are too close to each other hardly shape the path between them.
    apart = np.minimum(np.diff(times, prepend=-np.inf), np.diff(times, append=np.inf)) > _SOON / 2
    kept = is_waypoint | apart
    places, times, waypoint = places[kept], times[kept], np.flatnonzero(is_waypoint[kept])
    knots = Knots(np.diff(times), path(places), waypoint, departure.motion)
    knots.points[0] = departure.position
    if not len(more):
        return knots
    points = np.concatenate([knots.points[-1:], more])
    halves = (points[1:] + points[:-1]) / 2
    points = np.stack([halves, points[1:]], axis=1).reshape(-1, 3)
    new = np.repeat(_times(np.concatenate([knots.points[-1:], more]), np.zeros(3), limits), 2) / 2
    rows = len(knots.points) + 1 + 2 * np.arange(len(more))
    return Knots(
        np.concatenate([knots.times, new]), np.concatenate([knots.points, points]), np.append(waypoint, rows),
        departure.motion,
    )  # fmt: skip


def _gain(limits: Limits) -> float:
    return _ASSUMED_ACCELERATION * limits.plan.acceleration


def _times(points: NDArray, velocity: NDArray, limits: Limits) -> NDArray:
    """Return approximate segment times, (M,) s; the first includes the time to turn round."""
    steps = np.diff(points, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    times = 2.0 * np.sqrt(lengths / limits.plan.acceleration) + 0.4 * lengths / limits.plan.speed
    speed = float(np.linalg.norm(velocity))
    if speed > 0.0:
        times[0] += speed / limits.plan.acceleration * (1.0 - float(velocity @ steps[0]) / (speed * lengths[0]))
    return times


def _clipped(knots: Knots, limits: Limits) -> Knots:
    """Return knots whose points between waypoints lie inside the walls."""
    space = limits.space
    low, high = np.array(space.low) + space.margin + _INSIDE, np.array(space.high) - space.margin - _INSIDE
    points = np.clip(knots.points, low, high)
    points[knots.waypoint] = knots.points[knots.waypoint]
    return knots._replace(points=points)
