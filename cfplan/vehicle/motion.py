"""Motion at many points of a path: limited measures, or the full state, by the flatness map.

Up to WIDTH points are processed together, in some 10 to 20 ns each. A panel is one array with a row per quantity, whose
size the compiler knows, so that it vectorises over points.
"""

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.machine_code import njit
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.flatness import ROUNDING, Body, Flat, compiled_body, flat_state
from cfplan.vehicle.measures import MEASURES, measures
from cfplan.vehicle.profile import h_within, yaw_within
from cfplan.vehicle.rotations import Vector, hopf_quaternion
from cfplan.vehicle.trigonometry import cosine, sine

# Rows of full states.
STATES: dict[str, slice | int] = {
    "velocity": slice(0, 3), "acceleration": slice(3, 6), "jerk": slice(6, 9), "snap": slice(9, 12),
    "thrust_axis": slice(12, 15), "body_rate": slice(15, 18), "angular_acceleration": slice(18, 21),
    "torque": slice(21, 24), "motor_thrust": slice(24, 28), "quaternion": slice(28, 32), "yaw": 32,
    "specific_thrust": 33,
}  # fmt: skip
STATE_ROWS = 34

WIDTH = 64
# Rows of a panel: γ' to γ'''', the place in the interval of the profile, h and yaw where that begins, and the results.
_X, _NODE, _RESULT = 12, 13, 20


def measures_at(airframe: Airframe, curve: NDArray, nodes: NDArray, s: NDArray, interval: NDArray) -> NDArray:
    """Return the measures, (MEASURES, N), at s, (N,), where a path has derivatives `curve`, (5, 3, N), from γ on.

    `nodes` is a profile's table(), and the polynomials of `interval`, (N,), hold.
    """
    out = np.empty((MEASURES, len(s)))
    fill(out, compiled_body(airframe), curve, nodes, s, interval)
    return out


def states_at(airframe: Airframe, curve: NDArray, nodes: NDArray, s: NDArray, interval: NDArray) -> NDArray:
    """Return full states, (STATE_ROWS, N), likewise."""
    out = np.empty((STATE_ROWS, len(s)))
    fill(out, compiled_body(airframe), curve, nodes, s, interval)
    return out


@njit(error_model="numpy", fastmath=ROUNDING, nogil=True)
def fill(out: NDArray, body: Body, curve: NDArray, nodes: NDArray, s: NDArray, interval: NDArray) -> None:
    """Fill in measures or full states, as many rows as `out` has."""
    panel = np.empty((_RESULT + STATE_ROWS, WIDTH))
    for begin in range(0, len(s), WIDTH):
        count = min(WIDTH, len(s) - begin)
        for row in range(_X):
            derivative = curve[1 + row // 3, row % 3, begin : begin + count]
            for n in range(len(derivative)):
                panel[row, n] = derivative[n]
        for n in range(count):
            node = nodes[interval[begin + n]]
            panel[_X, n] = s[begin + n] - node[0]
            for row in range(_RESULT - _NODE):
                panel[_NODE + row, n] = node[1 + row]
        if len(out) == MEASURES:
            _measure(panel, body, count)
        else:
            _flatten(panel, body, count)
        for row in range(len(out)):
            result = out[row, begin : begin + count]
            for n in range(len(result)):
                result[n] = panel[_RESULT + row, n]


@register_jitable(forceinline=True, fastmath=ROUNDING)
def _measure(panel: NDArray, body: Body, count: int) -> None:
    """Write the measures of points."""
    for n in range(count):
        flat, _ = _flat(panel, body, n)
        values = measures(flat)
        for row in range(MEASURES):
            panel[_RESULT + row, n] = values[row]


@register_jitable(forceinline=True, fastmath=ROUNDING)
def _flatten(panel: NDArray, body: Body, count: int) -> None:
    """Write the full states of points, by the rows of STATES."""
    for n in range(count):
        flat, yaw = _flat(panel, body, n)
        vectors = (
            flat.velocity, flat.acceleration, flat.jerk, flat.snap, flat.thrust_axis, flat.body_rate,
            flat.angular_acceleration, flat.torque,
        )  # fmt: skip
        for k in range(8):
            for axis in range(3):
                panel[_RESULT + 3 * k + axis, n] = vectors[k][axis]
        motors, attitude = flat.motor_thrust, hopf_quaternion(flat.thrust_axis, cosine(yaw / 2), sine(yaw / 2))
        for k in range(4):
            panel[_RESULT + 24 + k, n], panel[_RESULT + 28 + k, n] = motors[k], attitude[k]
        panel[_RESULT + 32, n], panel[_RESULT + 33, n] = yaw, flat.specific_thrust


@register_jitable(forceinline=True, fastmath=ROUNDING)
def _flat(panel: NDArray, body: Body, n: int) -> tuple[Flat, float]:
    """Return the full state and yaw of a point."""
    x, (h, dh, ddh), (dddh, yaw, dyaw) = panel[_X, n], _vector(panel, _NODE, n), _vector(panel, _NODE + 3, n)
    turned = yaw_within(x, yaw, dyaw, panel[_NODE + 6, n])
    derivatives = _vector(panel, 0, n), _vector(panel, 3, n), _vector(panel, 6, n), _vector(panel, 9, n)
    return flat_state(body, derivatives, h_within(x, h, dh, ddh, dddh), turned, cosine, sine), turned[0]


@register_jitable(forceinline=True, fastmath=ROUNDING)
def _vector(panel: NDArray, row: int, n: int) -> Vector:
    return panel[row, n], panel[row + 1, n], panel[row + 2, n]
