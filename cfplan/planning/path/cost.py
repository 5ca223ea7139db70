"""The cost by which a path is chosen: its flight time plus a penalty on leaving the room, with the gradient.

The multipliers of the expert's problem give the derivative of flight time by the path (expert/sensitivity.py); one
adjoint solve propagates it to segment times and points (geometry/min_snap_gradient.py).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cfplan.deadline import Deadline
from cfplan.errors import InputError
from cfplan.geometry.min_snap_gradient import gradient_by_times_and_points
from cfplan.geometry.path import Path
from cfplan.geometry.waypoints import Gate, Region
from cfplan.geometry.yaw import YawMode
from cfplan.planners.expert.sensitivity import sensitivity
from cfplan.planners.task import PlanningTask
from cfplan.planning.path.room import Room
from cfplan.planning.path.variables import ChoiceVariables, Knots
from cfplan.safety.limits import Limits
from cfplan.safety.space import distances_beyond, inside

NODES_PER_METRE, NODES_PER_PIECE, LEAST_NODES = 4, 4, 60  # of the expert's grid while a path is chosen
STILL = 1e-3  # of the nominal speed, below which a path stands still
FORWARDS = 0.2  # of the nominal speed of 1 m/s, least forward speed through gates
_SAMPLES = 33  # of each piece, where a corridor is checked

Timing = tuple[float, NDArray, NDArray]  # s; its derivatives, (5, 3, P), by γ to γ'''' at some places; those, (P,)


@dataclass(frozen=True, slots=True)
class Course:
    """The requirements on a path besides its room."""

    regions: tuple[Region, ...]  # one for each waypoint
    yaw: YawMode
    yaw_angle: float  # rad


@dataclass(slots=True, eq=False)
class PathCost:
    """Flight time along the path of some variables, s, plus a penalty on leaving the room; with its gradient."""

    course: Course
    limits: Limits
    room: Room
    variables: ChoiceVariables
    deadline: Deadline
    weight: float = 0.0  # s/m³, of the excursion from the room
    reserve: float = 0.0  # m, distance kept inside
    nodes: int = field(init=False)  # of the grid, the same for all paths
    near: NDArray | None = field(default=None, init=False)  # coefficients of the last profile
    best: NDArray | None = field(default=None, init=False)  # x of the fastest path inside the room so far
    least: float = field(default=math.inf, init=False)  # s, its flight time

    def __post_init__(self) -> None:
        start = self.variables.start
        by_length = round(NODES_PER_METRE * start.path.length)
        self.nodes = max(LEAST_NODES, by_length, NODES_PER_PIECE * len(start.times))

    def __call__(self, x: NDArray) -> tuple[float, NDArray]:
        timed, gradient, duration = self._cost(x, self._flight_time)
        if duration < self.least and inside(self.missed(x)):
            self.best, self.least = x, duration
        return timed, gradient

    def by_length(self, x: NDArray) -> tuple[float, NDArray]:
        """Return the same with the time at constant maximum speed instead: a hundredth of the work."""
        return self._cost(x, self._time_by_length)[:2]

    def _flight_time(self, path: Path) -> Timing | None:
        """Return the flight time, s, and its derivatives, (5, 3, P), by the path at some places, (P,)."""
        task = PlanningTask(
            path, self.limits.airframe, self.limits.plan, nodes=self.nodes, yaw=self.course.yaw,
            yaw_angle=self.course.yaw_angle, deadline=self.deadline,
        )  # fmt: skip
        flown = sensitivity(task, self.near)
        if flown is None:
            return None
        self.near = flown.coefficients
        return flown.duration, np.concatenate([np.zeros((1, 3, len(flown.s))), flown.by_path]), flown.s

    def _time_by_length(self, path: Path) -> Timing:
        s = np.linspace(0.0, path.end, 2 * self.nodes + 1)
        tangent = path(s, 1).T
        speed = np.linalg.norm(tangent, axis=0)
        share = path.end / len(s) / self.limits.plan.speed
        by_path = np.zeros((5, 3, len(s)))
        by_path[1] = share * tangent / np.maximum(speed, STILL)
        return share * float(speed.sum()), by_path, s

    def _cost(self, x: NDArray, time: Callable[[Path], Timing | None]) -> tuple[float, NDArray, float]:
        """Return cost and gradient at x, and the time, s, alone."""
        knots = self.variables.knots(x)
        failed = math.inf, np.zeros_like(x), math.inf
        try:
            path = knots.path
        except InputError:  # the times differ too much to make a path
            return failed
        timed = time(path)
        if timed is None:
            return failed
        duration, of_time, places = timed
        at = np.linspace(0.0, path.end, 2 * self.nodes + 1)
        lacking, by_position = self.room.penalty(path(at), self._leg(knots, at), self.reserve)
        share = self.weight * path.end / len(at)
        by_place = np.zeros((5, 3, len(at)))
        by_place[0] = share * by_position.T
        backwards, by_tangent, gates = self._backwards(knots, path)
        s = np.concatenate([places, at, gates])
        by_times, by_points = gradient_by_times_and_points(
            knots.points, knots.times, s, np.concatenate([of_time, by_place, by_tangent], axis=-1),
            knots.start_derivatives,
        )  # fmt: skip
        if len(gates):  # which move with the times before them
            moved = (by_tangent[1] * path(gates, 2).T).sum(axis=0)
            by_times += ((gates[:, None] > knots.breaks[1:] - 1e-9 * path.end) * moved[:, None]).sum(axis=0)
        cost = duration + share * float(lacking.sum()) + backwards
        return cost, self.variables.gradient(x, by_times, by_points), duration

    def _leg(self, knots: Knots, s: NDArray) -> NDArray:
        """Return the line between waypoints of each place, (P,)."""
        return np.searchsorted(knots.breaks[knots.waypoint[1:-1]], s, side="right")

    def _backwards(self, knots: Knots, path: Path) -> tuple[float, NDArray, NDArray]:
        """Return the cost of passing gates backwards, s, its gradient by γ' there, (5, 3, G), and their s, (G,)."""
        regions = zip(knots.waypoint, self.course.regions, strict=True)
        gates = [(point, region.forwards) for point, region in regions if isinstance(region, Gate)]
        gates = [(point, forwards) for point, forwards in gates if 0 < point < len(knots.times)]
        if not gates:
            return 0.0, np.zeros((5, 3, 0)), np.zeros(0)
        s = path.breaks[[point for point, _ in gates]]
        forwards = np.array([each for _, each in gates])
        short = np.maximum(FORWARDS - (path(s, 1) * forwards).sum(axis=1), 0.0)
        by_tangent = np.zeros((5, 3, len(gates)))
        by_tangent[1] = -2.0 * self.weight * short * forwards.T
        return self.weight * float((short**2).sum()), by_tangent, s

    def missed(self, x: NDArray) -> float:
        """Return how far, m, the path leaves the room, between samples too; negative inside."""
        _, beyond = distances_beyond(self.variables.knots(x).path, self.room.space)
        return max(float(beyond.max()), self.aside(x)[0])

    def aside(self, x: NDArray) -> tuple[float, int]:
        """Return how far, m, the path leaves the corridor, likewise, and the worst straight line."""
        if self.room.corridor is None:
            return -math.inf, 0
        knots = self.variables.knots(x)
        path = knots.path
        s = np.linspace(path.breaks[:-1], path.breaks[1:], _SAMPLES, axis=1)
        bend = np.linalg.norm(path(s, 2), axis=-1).max(axis=1) * (np.diff(path.breaks) / (_SAMPLES - 1)) ** 2 / 8
        leg = self._leg(knots, s.ravel())
        aside = self.room.aside(path(s.ravel()), leg) + np.repeat(bend, _SAMPLES)
        most = int(aside.argmax())
        return float(aside[most]), int(leg[most])
