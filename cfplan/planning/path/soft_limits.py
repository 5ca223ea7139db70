"""The cost of a path with time as its parameter: its duration plus penalties on exceeded limits, with the gradient.

With time as s, the derivatives of the path are those of the motion, and limits bound their norms. The penalty is the
square of the excess, so the cost is finite for any path, and a descent may begin with one that cannot be flown. No
speed profile is planned: evaluating this cost takes a hundredth of the time of PathCost (after Wang et al.,
"Geometrically constrained trajectory optimization for multicopters", 2022).
"""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.geometry.min_snap import solve_derivatives
from cfplan.geometry.min_snap_gradient import BASES, ends_of, gradient_by_ends
from cfplan.machine_code import njit
from cfplan.planning.path.room import Room, RoomFaces, penalty_of
from cfplan.planning.path.variables import TIME_UNIT, ChoiceVariables, Knots
from cfplan.safety.limits import Limits
from cfplan.vehicle.airframe import GRAVITY

_PLACES = 10  # in each piece, at which limits are evaluated
# Fractions of the limits above which the penalty begins, and weights of the squared excess. They are below 1 because
# the speed profile, planned afterwards, keeps its limits more easily on a gentle path.
SPEED, ACCELERATION, THRUST, SNAP = (0.98, 30.0), (0.9, 10.0), (0.95, 30.0), (0.85, 1.0)
_FADING = 0.1  # s, weight of the squared jump of snap at the start, as a fraction of the limit
_ROOM = 1e3  # s/m³, weight of the squared excursion from the room
_RESERVE = 0.02  # m, distance to keep inside the room
_TINY = 1e-9
_FRACTIONS = (np.arange(_PLACES) + 0.5) / _PLACES  # of a piece: its places
_AT_PLACES = _FRACTIONS[:, None] ** np.arange(8) @ BASES[:5]  # (5, Q, 8), γ to γ'''' there from the values at its ends
_SNAP_AT_START = BASES[4, 0]  # (8,) γ'''' of a piece where it begins, likewise


class _Terms(NamedTuple):
    """The arguments of the compiled cost."""

    points: NDArray  # (M+1, 3) m, at x = 0
    times: NDArray  # (M,) s, at x = 0
    start: NDArray  # (5, 3) γ to γ'''' at the start
    known: int  # 1 if the path begins with all of these; 0: at rest
    moving: NDArray  # (Q,) int, points that may move
    units: NDArray  # (Q,) m, a unit of the variables of each
    faces: RoomFaces
    speed: float  # m/s, above which the penalty begins; likewise those below
    acceleration: float  # m/s²
    specific_thrust: float  # m/s²
    snap: float  # m/s⁴
    drag: float  # 1/s


@dataclass(slots=True, eq=False)
class SoftLimits:
    """The cost of variables x, (M + 3Q,): the logarithms of segment times, and how far the free points move.

    All are 0 at the start of `variables`, which has no regions.
    """

    variables: ChoiceVariables
    limits: Limits
    room: Room
    speed: float  # m/s, limit
    weight: float = 1.0  # of all excesses
    _terms: _Terms = field(init=False)

    def __post_init__(self) -> None:
        knots, moving, plan = self.variables.start, self.variables.moving, self.limits.plan
        begin = np.zeros((5, 3)) if knots.start is None else np.array(knots.start, dtype=float)
        airframe = self.limits.airframe
        self._terms = _Terms(
            np.ascontiguousarray(knots.points), np.ascontiguousarray(knots.times), begin, int(knots.start is not None),
            moving, np.ascontiguousarray(self.variables.axes[moving, 0, 0]), self.room.faces,
            SPEED[0] * self.speed, ACCELERATION[0] * plan.acceleration,
            THRUST[0] * 4.0 * plan.motor_thrust_max / airframe.mass, SNAP[0] * GRAVITY * plan.angular_acceleration,
            airframe.drag[0] / airframe.mass,
        )  # fmt: skip

    @property
    def first(self) -> NDArray:
        """Return the variables of the start."""
        return np.zeros(len(self._terms.times) + 3 * len(self._terms.moving))

    def knots(self, x: NDArray) -> Knots:
        """Return the times and points that the variables stand for."""
        points, times = _knots(x, self._terms)
        return self.variables.start._replace(points=points, times=times)

    def __call__(self, x: NDArray) -> tuple[float, NDArray]:
        return _cost(x, self._terms, self.weight)


@njit(error_model="numpy")
def _knots(x: NDArray, terms: _Terms) -> tuple[NDArray, NDArray]:
    """Return points, (M+1, 3) m, and times, (M,) s."""
    count = len(terms.times)
    points, times = terms.points.copy(), terms.times * np.exp(TIME_UNIT * x[:count])
    for number in range(len(terms.moving)):
        for axis in range(3):
            points[terms.moving[number], axis] += terms.units[number] * x[count + 3 * number + axis]
    return points, times


@njit(error_model="numpy")
def _cost(x: NDArray, terms: _Terms, weight: float) -> tuple[float, NDArray]:
    """Return the cost of variables, s, and its gradient; infinite if their times differ too much to make a path."""
    points, times = _knots(x, terms)
    count, gradient = len(times), np.zeros_like(x)
    given = np.zeros((count + 1, 3, 3))
    given[0] = terms.start[1:4]
    derivatives, definite = solve_derivatives(points, times, given, 1, count)
    if not definite:
        return np.inf, gradient
    ends = ends_of(points, times, derivatives)
    by_ends, by_left, by_times = np.zeros((count, 8, 3)), np.zeros((count, 3)), np.ones(count)
    cost = times.sum()
    path, by_path = np.empty((5, 3)), np.empty((5, 3))
    share = weight / _PLACES
    for n in range(count):
        for q in range(_PLACES):
            _write_place(path, points[n], ends[n], times[n], q)
            excess = _excess(path, by_path, terms)
            cost += share * times[n] * excess
            by_times[n] += share * excess
            unit = share * times[n]
            for order in range(5):
                for axis in range(3):
                    by = by_path[order, axis] * unit
                    by_times[n] -= order * by_path[order, axis] * path[order, axis] * share
                    for row in range(8):
                        by_ends[n, row, axis] += _AT_PLACES[order, q, row] * by
                    if order == 0:
                        by_left[n, axis] += by
                unit /= times[n]
    if terms.known:
        cost += _add_jump(ends[0], times[0], terms, _FADING * weight, by_ends[0], by_times)
    through_times, by_points = gradient_by_ends(points, times, derivatives, by_ends, by_left, 1)
    for n in range(count):
        gradient[n] = TIME_UNIT * times[n] * (by_times[n] + through_times[n])
    for number in range(len(terms.moving)):
        for axis in range(3):
            by = by_points[terms.moving[number], axis]
            gradient[count + 3 * number + axis] = terms.units[number] * by
    return cost, gradient


@njit(error_model="numpy")
def _write_place(path: NDArray, left: NDArray, ends: NDArray, time: float, place: int) -> None:
    """Write γ to γ'''' at a place of a piece, (5, 3)."""
    unit = 1.0
    for order in range(5):
        for axis in range(3):
            value = 0.0
            for row in range(8):
                value += _AT_PLACES[order, place, row] * ends[row, axis]
            path[order, axis] = value / unit
        unit *= time
    for axis in range(3):
        path[0, axis] += left[axis]


@njit(error_model="numpy")
def _excess(path: NDArray, by_path: NDArray, terms: _Terms) -> float:
    """Return the weighted squared excesses at a place, and write their gradient; both are (5, 3), γ to γ''''."""
    by_path[:] = 0.0
    excess = _ROOM * penalty_of(path[0], by_path[0], terms.faces, _RESERVE)
    for axis in range(3):
        by_path[0, axis] *= _ROOM
    excess += _beyond(path[1], by_path[1], terms.speed, SPEED[1])
    excess += _beyond(path[2], by_path[2], terms.acceleration, ACCELERATION[1])
    excess += _beyond(path[4], by_path[4], terms.snap, SNAP[1])
    force, by_force = path[2] + terms.drag * path[1], np.zeros(3)
    force[2] += GRAVITY
    excess += _beyond(force, by_force, terms.specific_thrust, THRUST[1])
    for axis in range(3):
        by_path[2, axis] += by_force[axis]
        by_path[1, axis] += terms.drag * by_force[axis]
    return excess


@njit(error_model="numpy")
def _beyond(vector: NDArray, by_vector: NDArray, bound: float, weight: float) -> float:
    """Return the weighted squared excess of a vector's length, as a fraction of a bound; add its gradient."""
    size = math.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)
    beyond = size / bound - 1.0
    if not beyond > 0.0:
        return 0.0
    for axis in range(3):
        by_vector[axis] += 2.0 * weight * beyond / bound / max(size, _TINY) * vector[axis]
    return weight * beyond**2


@njit(error_model="numpy")
def _add_jump(ends: NDArray, time: float, terms: _Terms, weight: float, by_ends: NDArray, by_times: NDArray) -> float:
    """Return the cost of the jump of snap at the start before it is faded in, s, and add its gradient."""
    cost = 0.0
    for axis in range(3):
        snap = 0.0
        for row in range(8):
            snap += _SNAP_AT_START[row] * ends[row, axis] / time**4
        off = (snap - terms.start[4, axis]) / terms.snap
        by_snap = 2.0 * weight * off / terms.snap
        cost += weight * off**2
        for row in range(8):
            by_ends[row, axis] += _SNAP_AT_START[row] * by_snap / time**4
        by_times[0] -= 4.0 * by_snap * snap / time
    return cost
