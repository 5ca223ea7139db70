"""Measures: the limited values of a full state, by one function body for numpy, numba and CasADi.

All of them are smooth wherever path and profile are, unlike norms and angles near zero: squares replace norms, and the
squared tangent of half the tilt replaces the tilt. safety/quantities.py has the name, unit and limit of each.
"""

import math
from typing import Any

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.machine_code import njit
from cfplan.vehicle.flatness import ROUNDING, Flat
from cfplan.vehicle.rotations import Scalar, Vector

ACCELERATION, BODY_RATE = 0, 1  # squared: m²/s⁴, rad²/s²
TILT = 2  # squared tangent of half the angle between thrust axis and vertical
SPECIFIC_THRUST = 3  # m/s²
ANGULAR_ACCELERATION = 4  # squared: rad²/s⁴
MOTOR_THRUST = 5  # N, and the next three
SPEED = 9  # squared: m²/s²; the last, as planners bound it through h
MEASURES = 10


@register_jitable(forceinline=True, fastmath=ROUNDING)
def measures(
    flat: Flat,
) -> tuple[Scalar, Scalar, Scalar, Scalar, Scalar, Scalar, Scalar, Scalar, Scalar, Scalar]:
    """Return the measures of a full state, in the order of the names above."""
    x, y, z = flat.thrust_axis
    lift = 1.0 / (1.0 + z)
    return (
        _squared(flat.acceleration),
        _squared(flat.body_rate),
        (x * x + y * y) * lift * lift,
        flat.specific_thrust,
        _squared(flat.angular_acceleration),
        flat.motor_thrust[0],
        flat.motor_thrust[1],
        flat.motor_thrust[2],
        flat.motor_thrust[3],
        _squared(flat.velocity),
    )


@register_jitable(forceinline=True, fastmath=ROUNDING)
def _squared(vector: Vector) -> Scalar:
    return vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2]


def measures_of(
    velocity: NDArray,
    acceleration: NDArray,
    body_rate: NDArray,
    thrust_axis: NDArray,
    specific_thrust: NDArray,
    *,
    angular_acceleration: NDArray | None = None,
    motor_thrust: NDArray | None = None,
) -> NDArray:
    """Return (MEASURES, ...) of full states: vectors (..., 3), motor thrusts (..., 4); NaN if unknown."""
    unknown: Any = (np.full(np.shape(specific_thrust), np.nan),) * 4

    def parts(vector: NDArray | None) -> Any:
        return unknown if vector is None else tuple(np.moveaxis(np.asarray(vector), -1, 0))

    return np.stack(
        measures(
            Flat(
                velocity=parts(velocity),
                acceleration=parts(acceleration),
                jerk=unknown[:3],
                snap=unknown[:3],
                specific_thrust=specific_thrust,
                thrust_axis=parts(thrust_axis),
                body_rate=parts(body_rate),
                angular_acceleration=parts(angular_acceleration)[:3],
                torque=unknown[:3],
                motor_thrust=parts(motor_thrust),
            )
        )
    )


@njit(error_model="numpy", fastmath=ROUNDING)
def measures_at_instants(velocity: NDArray, acceleration: NDArray, body_rate: NDArray, force: NDArray) -> NDArray:
    """Return (MEASURES, N) of instantaneous motion, (N, 3) each; NaN if unknown.

    `force`, m/s², is the thrust over mass, as a vector.
    """
    out = np.empty((MEASURES, len(force)))
    for n in range(len(force)):
        values = _at_instant(velocity, acceleration, body_rate, force, n)
        for row in range(MEASURES):
            out[row, n] = values[row]
    return out


@njit(error_model="numpy", fastmath=ROUNDING)
def extremes_at_instants(velocity: NDArray, acceleration: NDArray, body_rate: NDArray, force: NDArray) -> NDArray:
    """Return the largest and the least, (2, MEASURES), of measures_at_instants(); NaN propagates."""
    out = np.empty((2, MEASURES))
    for n in range(len(force)):
        values = _at_instant(velocity, acceleration, body_rate, force, n)
        for row in range(MEASURES):
            value, high, low = values[row], out[0, row], out[1, row]
            if n == 0 or math.isnan(value):
                out[0, row] = out[1, row] = value
            elif value > high:
                out[0, row] = value
            elif value < low:
                out[1, row] = value
    return out


@register_jitable(forceinline=True, fastmath=ROUNDING)
def _at_instant(
    velocity: NDArray, acceleration: NDArray, body_rate: NDArray, force: NDArray, n: int
) -> tuple[Scalar, Scalar, Scalar, Scalar, Scalar, Scalar, Scalar, Scalar, Scalar, Scalar]:
    x, y, z, nan = force[n, 0], force[n, 1], force[n, 2], np.nan
    thrust = np.sqrt(x * x + y * y + z * z)
    return measures(
        Flat(
            (velocity[n, 0], velocity[n, 1], velocity[n, 2]),
            (acceleration[n, 0], acceleration[n, 1], acceleration[n, 2]),
            (nan, nan, nan),
            (nan, nan, nan),
            thrust,
            (x / thrust, y / thrust, z / thrust),
            (body_rate[n, 0], body_rate[n, 1], body_rate[n, 2]),
            (nan, nan, nan),
            (nan, nan, nan),
            (nan, nan, nan, nan),
        )
    )
