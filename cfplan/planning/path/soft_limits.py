"""The cost of a path with time as its parameter: its duration plus penalties on exceeded limits, with the gradient.

With time as s, the derivatives of the path are those of the motion, and limits bound their norms. The penalty is the
square of the excess, so the cost is finite for any path, and a descent may begin with one that cannot be flown. No
speed profile is planned: evaluating this cost takes a fiftieth of the time of PathCost (after Wang et al.,
"Geometrically constrained trajectory optimization for multicopters", 2022).
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError
from cfplan.geometry.min_snap import derivatives_at
from cfplan.geometry.min_snap_gradient import BASES, ends_of, gradient_by_ends
from cfplan.planning.path.room import Room
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
_GRAVITY = np.array([0.0, 0.0, GRAVITY])
_FRACTIONS = (np.arange(_PLACES) + 0.5) / _PLACES  # of a piece: its places
_AT_PLACES = _FRACTIONS[:, None] ** np.arange(8) @ BASES[:5]  # (5, Q, 8), γ to γ'''' there from the values at its ends


@dataclass(slots=True, eq=False)
class SoftLimits:
    """The cost of variables x, (1+n,): the logarithm of a factor on all times, and the variables of a chosen path."""

    variables: ChoiceVariables
    limits: Limits
    room: Room
    speed: float  # m/s, limit
    weight: float = 1.0  # of all excesses

    def knots(self, x: NDArray) -> Knots:
        """Return the times and points that the variables stand for."""
        knots = self.variables.knots(x[1:])
        return knots._replace(times=knots.times * math.exp(TIME_UNIT * x[0]))

    def __call__(self, x: NDArray) -> tuple[float, NDArray]:
        knots = self.knots(x)
        points, times, start = knots.points, knots.times, knots.start_derivatives
        try:
            at_points = derivatives_at(points, times, start, rest_end=True)
        except InputError:  # the times differ too much to make a path
            return math.inf, np.zeros_like(x)
        # γ to γ'''' at the places of each piece, which lie at fixed fractions of it, (5, M, Q, 3).
        unit = times[:, None, None] ** -np.arange(5.0)[:, None, None, None]
        path = unit * (_AT_PLACES[:, None] @ ends_of(points, times, at_points))
        path[0] += points[:-1, None]
        excess, by_path = self._excess(path)
        step = self.weight * times / _PLACES
        excess *= self.weight / _PLACES
        by_path *= unit * step[:, None, None]
        by_ends = (_AT_PLACES.transpose(0, 2, 1)[:, None] @ by_path).sum(axis=0)
        jump, by_snap = self._jump(knots.start, points, times, at_points)
        by_ends[0] += BASES[4, 0][:, None] * by_snap / times[0] ** 4

        by_times, by_points = gradient_by_ends(points, times, at_points, by_ends, by_path[0].sum(axis=1), start)
        by_times -= (np.arange(5.0)[:, None, None, None] * by_path / unit * path).sum(axis=(0, 2, 3)) / times
        by_times[0] -= 4.0 * float(by_snap @ (BASES[4, 0] @ ends_of(points, times, at_points)[0])) / times[0] ** 5
        by_times += 1.0 + excess.sum(axis=1)

        cost = float(times.sum() + (excess.sum(axis=1) * times).sum()) + jump
        by_unit = TIME_UNIT * (by_times @ times)
        scale = times.sum() / self.variables.start.times.sum()
        return cost, np.append(by_unit, self.variables.gradient(x[1:], scale * by_times, by_points))

    def _excess(self, path: NDArray) -> tuple[NDArray, NDArray]:
        """Return the weighted squared excesses, (M, Q), and their gradient, in the shape of `path`, (5, M, Q, 3)."""
        plan, airframe = self.limits.plan, self.limits.airframe
        drag = airframe.drag[0] / airframe.mass
        force = path[2] + drag * path[1] + _GRAVITY
        strongest = 4.0 * plan.motor_thrust_max / airframe.mass
        places = path[0].reshape(-1, 3)
        lacking, by_position = self.room.penalty(places, np.zeros(len(places), dtype=int), _RESERVE)
        squares, by_path = _ROOM * lacking.reshape(path.shape[1:3]), np.zeros_like(path)
        by_path[0] = _ROOM * by_position.reshape(path[0].shape)

        def add(vector: NDArray, limit: float, soft: tuple[float, float]) -> NDArray:
            bound, weight = soft[0] * limit, soft[1]
            size = np.sqrt((vector**2).sum(axis=-1))
            beyond = np.maximum(size / bound - 1.0, 0.0)
            np.add(squares, weight * beyond**2, out=squares)
            return np.asarray((2.0 * weight / bound * beyond / np.maximum(size, _TINY))[..., None] * vector)

        by_path[1] = add(path[1], self.speed, SPEED)
        by_path[2] = add(path[2], plan.acceleration, ACCELERATION)
        by_path[4] = add(path[4], GRAVITY * plan.angular_acceleration, SNAP)
        by_force = add(force, strongest, THRUST)
        by_path[2] += by_force
        by_path[1] += drag * by_force
        return squares, by_path

    def _jump(
        self, start: NDArray | None, points: NDArray, times: NDArray, at_points: NDArray
    ) -> tuple[float, NDArray]:
        """Return the cost of the jump of snap at the start before it is faded in, s, and its gradient, (3,)."""
        if start is None:
            return 0.0, np.zeros(3)
        limit = SNAP[0] * GRAVITY * self.limits.plan.angular_acceleration
        snap = BASES[4, 0] @ ends_of(points, times, at_points)[0] / times[0] ** 4
        off = (snap - start[4]) / limit
        weight = _FADING * self.weight
        return weight * float(off @ off), 2.0 * weight * off / limit
