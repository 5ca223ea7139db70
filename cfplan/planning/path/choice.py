"""The path through waypoints that is flown soonest.

A path of least snap is shaped by the times of its segments and by points between the waypoints: with times like the
straight lengths it swings far out where these differ. Both are chosen so that the flight time is least, by descent:
the multipliers of the expert's problem give the gradient of the flight time with respect to the path
(expert/sensitivity.py), one adjoint solve carries it to times and points (geometry/min_snap_gradient.py). What leaves
the room costs as its square, and the more, the more often the descent ended outside. What is found is planned and
certified beside both paths of least snap, and the shortest of these flights is taken.
"""

import math
import pathlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.deadline import NEVER, Deadline
from cfplan.errors import InfeasibleError, InputError
from cfplan.geometry.min_snap import centripetal_times, least_snap
from cfplan.geometry.min_snap_gradient import gradient_by_times_and_points
from cfplan.geometry.path import Path
from cfplan.geometry.path_file import PathFile, PathShape
from cfplan.geometry.waypoints import Gate
from cfplan.planners.expert.sensitivity import sensitivity
from cfplan.planners.task import PlanningTask
from cfplan.planning.path.descent import Cost, descend
from cfplan.planning.path.detour import with_corners
from cfplan.planning.path.room import Room
from cfplan.planning.path.variables import ChoiceVariables, Knots, variables_of, with_points_between
from cfplan.planning.plan import default_budget, plan
from cfplan.safety.limits import Limits
from cfplan.safety.space import distances_beyond, inside

CHOOSING = 0.5  # of the budget of planning
CERTIFYING = 0.2  # of the time for choosing, kept for certifying what was found
NODES_PER_METRE, NODES_PER_PIECE, LEAST_NODES = 4, 4, 60  # of the expert's grid while a path is chosen
TOLERANCE, ITERATIONS = 2e-4, 80  # share of the flight time by which steps improve it at last; steps at most
# Weights of what leaves the room, s/m³: each descent that ends outside is followed by one with the next weight, which
# keeps further inside by what was missed.
WEIGHTS = (100.0, 1e3, 1e4, 1e5, 1e5, 1e5)
RESERVE = 0.002  # m, that is kept inside besides what was missed
ROUGHLY = 0.01  # share by which steps improve a first descent at last
SAMPLES = 33  # of each piece, where a corridor is checked
STILL = 1e-3  # of the nominal speed, below which a path stands still
FORWARDS = 0.2  # of the nominal speed of 1 m/s, at which gates are passed forwards at least


class FastestPath(NamedTuple):
    """A path through waypoints, and what choosing it was worth."""

    path: Path
    duration: float  # s, of the certified flight at full speed; infinite where there is none
    min_snap: float  # s, likewise along the better path of least snap, with times like the lengths or centripetal ones
    least_snap: Path  # that one; the one with centripetal times where neither can be flown
    finished: bool  # whether the search ended before the deadline

    def describe(self, speed_factor: float) -> str:
        """Return what the choice was worth, at a factor of the full speed."""
        flown = self.min_snap < math.inf
        beside = f"{self.min_snap / speed_factor:.2f} s along min-snap" if flown else "min-snap cannot be flown"
        return beside if self.finished else f"{beside}, choosing was cut short by the budget"


def chosen_path(
    path_file: PathFile, limits: Limits, *, budget: float | None = None, models: tuple[pathlib.Path, ...] = ()
) -> tuple[PathFile, FastestPath | None]:
    """Return the path file with the path that its shape asks for, and what the choice was worth if there was one.

    Choosing takes at most half of the budget of planning, s; None is that of the path of least snap.

    Raises:
        InfeasibleError: a gate is too narrow.
    """
    if path_file.shape is not PathShape.FASTEST or not limits.space.holds(path_file.waypoints):
        return path_file, None  # a waypoint outside the space is refused by what plans the path
    seconds = CHOOSING * (default_budget(path_file.path) if budget is None else budget)
    fastest = fastest_path(path_file, limits, deadline=Deadline.after(seconds), models=models)
    return replace(path_file, path=fastest.path), fastest


def fastest_path(
    path_file: PathFile, limits: Limits, *, deadline: Deadline = NEVER, models: tuple[pathlib.Path, ...] = ()
) -> FastestPath:
    """Return the path through a path file's waypoints, at rest at both ends, with the shortest certified flight.

    Waypoints of several laps have the same times in each lap. After the deadline the best path found by then is the
    answer. Where none can be flown, the path that leaves the room least is; planning it says why.

    Raises:
        InfeasibleError: a gate is too narrow.
    """
    _check_gates(path_file, limits)

    def certified(path: Path) -> float:
        with suppress(InfeasibleError, InputError):
            made = plan(
                path, limits.airframe, limits, yaw=path_file.yaw, yaw_angle=path_file.yaw_angle, deadline=deadline,
                models=models,
            )  # fmt: skip
            return made.trajectory.duration
        return math.inf

    points = path_file.waypoints
    paths = [_least_snap(knots) for knots in _timed(points, np.arange(len(points)))]
    searching = deadline.earlier(CERTIFYING * deadline.left) if deadline.left < math.inf else NEVER
    found, finished = _search(path_file, limits, searching)
    durations = [certified(path) for path in (found, *paths)]
    plain = path_file.corridor is None and not limits.space.obstacles
    plain = plain and not any(isinstance(each, Gate) for each in path_file.regions)
    best = int(np.argmin(durations)) if plain else 0  # the first of equal ones
    least_snap = paths[0] if durations[1] < durations[2] else paths[1]
    return FastestPath((found, *paths)[best], durations[best], min(durations[1:]), least_snap, finished)


def _check_gates(path_file: PathFile, limits: Limits) -> None:
    """Raise InfeasibleError where a gate leaves no room for the vehicle."""
    margin = limits.space.margin
    for number, region in enumerate(path_file.regions, start=1):
        if isinstance(region, Gate) and min(region.width, region.height) <= 2.0 * margin:
            side = "wide" if region.width <= region.height else "high"
            raise InfeasibleError(
                f"the gate at waypoint {number} is {min(region.width, region.height):g} m {side}: the margin of "
                f"{margin:g} m at both sides leaves nothing of it",
                where=str(path_file.source),
                hint="give a larger gate, or a smaller `margin` of `space` in safety.yaml",
            )


def _timed(points: NDArray, waypoint: NDArray) -> tuple[Knots, Knots]:
    """Return points with times like their straight lengths, and with centripetal ones; `waypoint` of them are such."""
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    centripetal = centripetal_times(points)
    return Knots(lengths, points, waypoint), Knots(centripetal * (lengths.sum() / centripetal.sum()), points, waypoint)


def _least_snap(knots: Knots) -> Path:
    return least_snap(knots.points, knots.times)


def _search(path_file: PathFile, limits: Limits, deadline: Deadline) -> tuple[Path, bool]:
    """Return the best path that descent finds, and whether it ended in time.

    Where link loss must end clear of obstacles, it is sought where that is likely; and elsewhere if there is none.
    """
    room = Room(limits.space, path_file.waypoints, path_file.corridor)
    rooms = [room]
    if limits.space.obstacles and not limits.link_loss.only_warn:
        rooms = [room.to_come_down(), room]
    for each in rooms:
        found, stays, finished = _search_in(each, path_file, limits, deadline)
        if stays or not finished:
            break
    return found, finished


def _search_in(room: Room, path_file: PathFile, limits: Limits, deadline: Deadline) -> tuple[Path, bool, bool]:
    """Return the best path from the better of two timings, whether it stays inside, and whether the search ended."""
    starts = [_started(path_file, knots) for knots in _timed(*with_corners(path_file.waypoints, room.space))]
    costs = []
    for start in starts:
        variables = variables_of(start, path_file.regions, path_file.laps, limits.space.margin)
        costs.append(_Cost(path_file, limits, room, variables, deadline))
    cost = min(costs, key=lambda each: each(each.variables.first)[0])
    x = cost.variables.first
    if not inside(cost.missed(x)):
        x, _ = _descend_inside(cost, cost.by_length, x, ROUGHLY, deadline)
    x, finished = _descend_inside(cost, cost, x, TOLERANCE, deadline)
    stays = cost.best is not None
    return _least_snap(cost.variables.knots(x if cost.best is None else cost.best)), stays, finished


def _descend_inside(
    room: "_Cost", cost: Cost, x: NDArray, tolerance: float, deadline: Deadline
) -> tuple[NDArray, bool]:
    """Descend from x until the path stays inside the room, and return where that ended, and whether in time."""
    room.reserve = 0.0
    for weight in WEIGHTS:
        room.weight = weight
        descent = descend(cost, x, deadline, tolerance=tolerance, iterations=ITERATIONS)
        x = descent.x
        missed = room.missed(x)
        if inside(missed) or not descent.finished or descent.cost == math.inf:
            break
        room.reserve += missed + RESERVE
    return x, descent.finished


def _started(path_file: PathFile, knots: Knots) -> Knots:
    """Return where a search starts: with a point between each two, which leads into gates forwards."""
    knots = with_points_between(knots)
    for point, region in zip(knots.waypoint, path_file.regions, strict=True):
        if isinstance(region, Gate):
            for beside, side in ((point - 1, -1.0), (point + 1, 1.0)):
                if 0 <= beside < len(knots.points):
                    far = np.linalg.norm(knots.points[beside] - knots.points[point])
                    knots.points[beside] = knots.points[point] + side * far * region.forwards
    return knots


@dataclass(slots=True, eq=False)
class _Cost:
    """The flight time along the path of some variables, s, and what leaving the room costs; with its gradient."""

    path_file: PathFile
    limits: Limits
    room: Room
    variables: ChoiceVariables
    deadline: Deadline
    weight: float = WEIGHTS[0]
    reserve: float = 0.0  # m
    nodes: int = field(init=False)  # of the grid, the same for all paths
    near: NDArray | None = field(default=None, init=False)  # coefficients of the last profile
    best: NDArray | None = field(default=None, init=False)  # x of the soonest flown path inside the room so far
    least: float = field(default=math.inf, init=False)  # s, its flight time

    def __post_init__(self) -> None:
        start = self.variables.start
        by_length = round(NODES_PER_METRE * _least_snap(start).length)
        self.nodes = max(LEAST_NODES, by_length, NODES_PER_PIECE * len(start.times))

    def __call__(self, x: NDArray) -> tuple[float, NDArray]:
        timed, gradient, duration = self._cost(x, self._flight_time)
        if duration < self.least and inside(self.missed(x)):
            self.best, self.least = x, duration
        return timed, gradient

    def by_length(self, x: NDArray) -> tuple[float, NDArray]:
        """Return the same with the time that the path would take at the limit of speed: a hundredth of the work."""
        return self._cost(x, self._time_by_length)[:2]

    def _flight_time(self, path: Path) -> tuple[float, NDArray, NDArray] | None:
        """Return the flight time, s, and its derivatives, (5, 3, P), by the path at some places, (P,)."""
        task = PlanningTask(
            path, self.limits.airframe, self.limits.plan, nodes=self.nodes, yaw=self.path_file.yaw,
            yaw_angle=self.path_file.yaw_angle, deadline=self.deadline,
        )  # fmt: skip
        flown = sensitivity(task, self.near)
        if flown is None:
            return None
        self.near = flown.coefficients
        return flown.duration, np.concatenate([np.zeros((1, 3, len(flown.s))), flown.by_path]), flown.s

    def _time_by_length(self, path: Path) -> tuple[float, NDArray, NDArray]:
        s = np.linspace(0.0, path.end, 2 * self.nodes + 1)
        tangent = path(s, 1).T
        speed = np.linalg.norm(tangent, axis=0)
        share = path.end / len(s) / self.limits.plan.speed
        by_path = np.zeros((5, 3, len(s)))
        by_path[1] = share * tangent / np.maximum(speed, STILL)
        return share * float(speed.sum()), by_path, s

    def _cost(
        self, x: NDArray, time: Callable[[Path], tuple[float, NDArray, NDArray] | None]
    ) -> tuple[float, NDArray, float]:
        """Return cost and gradient at x, and the time, s, alone."""
        knots = self.variables.knots(x)
        failed = math.inf, np.zeros_like(x), math.inf
        try:
            path = _least_snap(knots)
        except InputError:  # times so different that they make no path
            return failed
        timed = time(path)
        if timed is None:
            return failed
        duration, of_time, places = timed
        at = np.linspace(0.0, path.end, 2 * self.nodes + 1)
        left, by_position = self.room.penalty(path(at), self._leg(knots, at), self.reserve)
        share = self.weight * path.end / len(at)
        by_place = np.zeros((5, 3, len(at)))
        by_place[0] = share * by_position.T
        backwards, by_tangent, gates = self._backwards(knots, path)
        s = np.concatenate([places, at, gates])
        by_times, by_points = gradient_by_times_and_points(
            knots.points, knots.times, s, np.concatenate([of_time, by_place, by_tangent], axis=-1)
        )
        if len(gates):  # which move with the times before them
            moved = (by_tangent[1] * path(gates, 2).T).sum(axis=0)
            breaks = np.cumsum(knots.times)
            by_times += ((gates[:, None] > breaks - 1e-9 * path.end) * moved[:, None]).sum(axis=0)
        return duration + share * left + backwards, self.variables.gradient(x, by_times, by_points), duration

    def _leg(self, knots: Knots, s: NDArray) -> NDArray:
        """Return which line between waypoints each place belongs to, (P,)."""
        ends = np.concatenate([[0.0], np.cumsum(knots.times)])[knots.waypoint[1:-1]]
        return np.searchsorted(ends, s, side="right")

    def _backwards(self, knots: Knots, path: Path) -> tuple[float, NDArray, NDArray]:
        """Return what passing gates backwards costs, s, its gradient by γ' there, (5, 3, G), and the gates' s, (G,)."""
        regions = zip(knots.waypoint, self.path_file.regions, strict=True)
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
        knots = self.variables.knots(x)
        path = _least_snap(knots)
        _, beyond = distances_beyond(path, self.room.space)
        if self.room.corridor is None:
            return float(beyond.max())
        s = np.linspace(path.breaks[:-1], path.breaks[1:], SAMPLES, axis=1)
        bend = np.linalg.norm(path(s, 2), axis=-1).max(axis=1) * (np.diff(path.breaks) / (SAMPLES - 1)) ** 2 / 8
        aside = self.room.aside(path(s.ravel()), self._leg(knots, s.ravel())).reshape(s.shape)
        return float(max(beyond.max(), (aside + bend[:, None]).max()))
