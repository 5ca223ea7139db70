"""What must hold at one point of an interval, as CasADi functions with first and second derivatives.

Inside an interval h is a cubic and yaw a parabola, so everything physical at a point is a function of the interval's
own variables. They are kept in node units (s counted in grid steps, h over a scale), which makes the dynamics the
same for every path and every N:

    given yaw   (x, x', x'', x''')                      h = scale · x
    free yaw    (x, x', x'', ψ, ψ', x''', ψ'')

Path, airframe and limits are arguments, so the same compiled functions serve every problem.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.flatness import Flat, Vector, flat_state
from cfplan.vehicle.profile import h_within, yaw_within

# Rows of the constraint vector; each is scaled so that the limit is 1 (thrusts: -1 to 1).
ACCELERATION, ANGULAR_VELOCITY, TILT, SPECIFIC_THRUST, ANGULAR_ACCELERATION = range(5)
THRUSTS = slice(5, 9)
ROWS = 9
JUMPING = (ANGULAR_ACCELERATION, 5, 6, 7, 8)  # rows that jump with the controls, from interval to interval
LOWER = np.array([-np.inf, -np.inf, -np.inf, 1.0, -np.inf, -1.0, -1.0, -1.0, -1.0])
UPPER = np.array([1.0, 1.0, 1.0, np.inf, 1.0, 1.0, 1.0, 1.0, 1.0])

POINT_DATA = 17  # γ' to γ'''' (12), place in the interval 0 to 1, weight of the penalties, ψ, ψ', ψ''
COMMON_DATA = 16
LEAST = 1e-6  # x below this counts as this: a solver that tries h < 0 must not meet what is not a number
UNBOUNDED = 1e4  # rad/s², stands for no limit of angular acceleration

# Gauss-Legendre places and weights on [0, 1], for the time spent in an interval.
GAUSS_PLACES = 0.5 + np.array([-0.5, 0.0, 0.5]) * np.sqrt(0.6)
GAUSS_WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18.0


@dataclass(frozen=True, slots=True)
class Penalties:
    """What a second of flight costs beyond its time; keeps solutions smooth and yaw from drifting."""

    angular_acceleration: float = 1e-6
    # s⁴/rad², per squared angular acceleration
    yaw_rate: float = 1e-2
    # s²/rad², per squared yaw rate; free yaw only
    roughness: float = 1e-3
    # s, per squared third derivative of h over h, in grid steps, an interval

    def weights(self) -> tuple[float, float, float]:
        """As point_expressions takes them."""
        return self.angular_acceleration, self.yaw_rate, self.roughness


def common_data(airframe: Airframe, limits: PlanLimits, scale: float) -> NDArray:
    """(COMMON_DATA,) what is the same at every point; `scale` turns x into h in node units."""
    return np.array([
        airframe.mass, *airframe.inertia, airframe.arm, airframe.thrust_to_torque, *airframe.drag,
        limits.acceleration, limits.angular_velocity, limits.tilt, limits.specific_thrust_min,
        limits.motor_thrust_min, limits.motor_thrust_max, scale, min(limits.angular_acceleration, UNBOUNDED),
    ])  # fmt: skip


def rows(flat: Flat, limits: PlanLimits, cos: Any) -> list[Any]:
    """What UPPER and LOWER bound, in the order of the names above; of numpy arrays or CasADi symbols."""
    middle = 0.5 * (limits.motor_thrust_max + limits.motor_thrust_min)
    half = 0.5 * (limits.motor_thrust_max - limits.motor_thrust_min)
    return [
        _squared(flat.acceleration) / limits.acceleration**2,
        _squared(flat.body_rate) / limits.angular_velocity**2,
        (1 - flat.thrust_axis[2]) / (1 - cos(limits.tilt)),
        flat.specific_thrust / limits.specific_thrust_min,
        _squared(flat.angular_acceleration) / limits.angular_acceleration**2,
        *((thrust - middle) / half for thrust in flat.motor_thrust),
    ]


def _squared(vector: Vector) -> Any:
    return vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2


def local_variables(z: casadi.SX, free_yaw: bool, place: casadi.SX) -> tuple[list[casadi.SX], list[casadi.SX]]:
    """(x, x', x'', x''') and, where yaw is free, (ψ, ψ', ψ''), at a place within the interval."""
    x = list(h_within(place, z[0], z[1], z[2], z[5] if free_yaw else z[3]))
    return x, list(yaw_within(place, z[3], z[4], z[6])) if free_yaw else []


def point_expressions(free_yaw: bool) -> tuple[list[casadi.SX], casadi.SX, casadi.SX]:
    """([variables, point data, common data, penalty weights], constraint rows, penalty)."""
    z = casadi.SX.sym("z", variables(free_yaw))
    point = casadi.SX.sym("point", POINT_DATA)
    common = casadi.SX.sym("common", COMMON_DATA)
    weights = casadi.SX.sym("weights", 3)

    (mass, jx, jy, jz, arm, thrust_to_torque, drag, axial_drag, acceleration, angular_velocity, tilt,
     specific_thrust_min, thrust_min, thrust_max, scale, angular_acceleration) = _entries(common)  # fmt: skip
    zero: Any = casadi.SX(0)
    airframe = Airframe("symbolic", mass, (jx, jy, jz), arm, thrust_to_torque, zero, zero, zero, (drag, axial_drag), "")
    limits = PlanLimits(
        speed=zero, acceleration=acceleration, angular_velocity=angular_velocity, tilt=tilt,
        motor_thrust_min=thrust_min, motor_thrust_max=thrust_max, specific_thrust_min=specific_thrust_min,
        angular_acceleration=angular_acceleration,
    )  # fmt: skip
    entries = _entries(point)
    derivatives: Any = tuple(tuple(entries[3 * k : 3 * k + 3]) for k in range(4))
    place, weight = entries[12:14]
    x, yaw = local_variables(z, free_yaw, place)
    x[0] = _positive(x[0])
    h: Any = tuple(scale * value for value in x)
    turn: Any = tuple(yaw if free_yaw else entries[14:17])
    flat = flat_state(airframe, derivatives, h, turn, casadi.cos, casadi.sin)

    penalty = weights[0] * _squared(flat.angular_acceleration)
    if free_yaw:
        penalty += weights[1] * h[0] * yaw[1] ** 2
    penalty = penalty / casadi.sqrt(h[0]) + weights[2] * (x[3] / x[0]) ** 2
    return [z, point, common, weights], casadi.vertcat(*rows(flat, limits, casadi.cos)), weight * penalty


def _positive(x: casadi.SX) -> casadi.SX:
    return casadi.fmax(x, LEAST)


def _entries(vector: casadi.SX) -> list[Any]:
    return casadi.vertsplit(vector)


def variables(free_yaw: bool) -> int:
    """Number of variables of an interval."""
    return 7 if free_yaw else 4


def family(free_yaw: bool) -> str:
    """Name of the functions' family."""
    return "free" if free_yaw else "given"


@lru_cache(maxsize=2)
def point_functions(free_yaw: bool) -> Mapping[str, casadi.Function]:
    """By name: values, first and second derivatives at a point; and those of the time spent in an interval."""
    inputs, bounded, penalty = point_expressions(free_yaw)
    z = inputs[0]
    name = family(free_yaw)
    multipliers = casadi.SX.sym("multipliers", ROWS)
    factor = casadi.SX.sym("factor")
    lagrangian = factor * penalty + casadi.dot(multipliers, bounded)
    hessian, gradient = casadi.hessian(lagrangian, z)

    def function(title: str, arguments: list[casadi.SX], results: list[casadi.SX]) -> casadi.Function:
        return casadi.Function(f"{name}_{title}", arguments, casadi.cse([casadi.densify(r) for r in results]))

    h = [_positive(local_variables(z, free_yaw, place)[0][0]) for place in GAUSS_PLACES]
    time = sum(w / casadi.sqrt(value) for w, value in zip(GAUSS_WEIGHTS, h, strict=True))
    time_hessian, time_gradient = casadi.hessian(time, z)
    made = [
        function("rows", inputs, [bounded]),
        function("penalty", inputs, [penalty]),
        function("penalty_gradient", inputs, [casadi.gradient(penalty, z)]),
        function("jacobian", inputs, [bounded, casadi.jacobian(bounded, z)]),
        function("hessian", [*inputs, multipliers, factor], [gradient, hessian]),
        function("time", [z], [time]),
        function("time_gradient", [z], [time_gradient]),
        function("time_hessian", [z], [time_gradient, time_hessian]),
    ]
    return {f.name(): f for f in made}
