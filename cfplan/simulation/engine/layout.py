"""Memory layout of simulated vehicles: the rows of a batch, and their meaning.

A batch holds one row of numbers per quantity, `width` long, one after the other in one flat array: quantity q of lane
n is at [q * width + n]. All steps of the simulation take (batch, width, n). A vehicle on its own is a batch of width 1,
so its array is simply its quantities in order. With the constant width WIDTH the compiler sees that rows do not
overlap, and vectorises over lanes.

A snapshot, (31,), holds the first rows: the state from which another simulation can branch off.
"""

from typing import Any

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.flight.setpoints.packets import FullStateSetpoints
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.rotations import Vector, about_z, yaw_of

WIDTH = 32  # lanes of a batch
_VECTOR = 8  # lanes per vector instruction

POSITION = slice(0, 3)  # m
VELOCITY = slice(3, 6)  # m/s
QUATERNION = slice(6, 10)  # body→world x y z w
BODY_RATE = slice(10, 13)  # rad/s, in body axes
MOTORS = slice(13, 17)  # N, thrust of each motor
STATE_SIZE = 17
MEMORY = STATE_SIZE  # of the controller, see `mellinger`
MEMORY_SIZE = 10
ASKED = MEMORY + MEMORY_SIZE  # N, commanded thrust of each motor
SNAPSHOT_SIZE = ASKED + 4
SETPOINT = SNAPSHOT_SIZE  # setpoint of the controller, see `mellinger`
SETPOINT_SIZE = 20
MISSED = SETPOINT + SETPOINT_SIZE  # m and m/s: true less estimated position and velocity
AIRFRAME = MISSED + 6
(
    MASS, JX, JY, JZ, ARM, THRUST_TO_TORQUE, THRUST_MAX, LAG, DRAG, AXIAL_DRAG, REACTION, ROLL_MOMENT, PITCH_MOMENT,
    LIFT, THRUST_SCALE, CURVATURE, CURVATURE_PER_HOVER, TOP, FLOOR, WIND, _, _, EFFICIENCY, _, _, _,
) = range(AIRFRAME, AIRFRAME + 26)  # fmt: skip
AIRFRAME_SIZE = 26
VEHICLE_SIZE = AIRFRAME + AIRFRAME_SIZE

STILL_AIR = np.zeros(3)
FULL_EFFICIENCY = np.ones(4)


def pack_airframe(
    airframe: Airframe, *, floor: float = 0.0, wind: NDArray = STILL_AIR, efficiency: NDArray = FULL_EFFICIENCY
) -> NDArray:
    """Return (26,): an airframe as a batch holds it, and its surroundings.

    `floor` is the height of the ground, m, -inf for none; `wind` (3,) m/s in world axes; `efficiency` (4,) the fraction
    of its thrust that each motor gives.
    """
    hover, curvature = airframe.hover_thrust / airframe.thrust_scale, airframe.thrust_curvature
    top = hover * (1.0 + curvature) / (2.0 * curvature) if curvature > 0.0 else np.inf  # beyond, thrust would fall
    return np.array(
        [
            airframe.mass, *airframe.inertia, airframe.arm, airframe.thrust_to_torque, airframe.motor_thrust_max,
            airframe.motor_time_constant, *airframe.drag, airframe.rotor_reaction, *airframe.velocity_moment,
            airframe.lift_with_speed, airframe.thrust_scale, curvature, curvature / hover, top, floor, *wind,
            *efficiency,
        ],
        dtype=float,
    )  # fmt: skip


def new_vehicle(state: NDArray, airframe: NDArray) -> NDArray:
    """Return one vehicle, (77,), in a state, (17,), by a packed airframe, (26,); its controller has not run yet."""
    vehicle = np.zeros(VEHICLE_SIZE)
    vehicle[:STATE_SIZE], vehicle[AIRFRAME:] = state, airframe
    return vehicle


def hovering(airframe: Airframe, position: NDArray, yaw: float = 0.0) -> NDArray:
    """Return the state, (17,), of a vehicle that hovers."""
    state = at_rest(position, yaw)
    state[MOTORS] = airframe.hover_thrust
    return state


def at_rest(position: NDArray, yaw: float = 0.0) -> NDArray:
    """Return the state, (17,), of a vehicle that stands still, level, its motors off."""
    state = np.zeros(STATE_SIZE)
    state[POSITION] = position
    state[QUATERNION] = about_z(yaw)
    return state


def hovering_snapshot(airframe: Airframe, setpoints: FullStateSetpoints) -> NDArray:
    """Return the snapshot, (31,), of a vehicle that hovers where the first setpoint is."""
    snapshot = np.zeros(SNAPSHOT_SIZE)
    snapshot[:STATE_SIZE] = hovering(airframe, setpoints.position[0], float(yaw_of(setpoints.quaternion[0])))
    snapshot[ASKED:] = airframe.hover_thrust / airframe.thrust_scale
    return snapshot


def setpoint_rows(setpoints: FullStateSetpoints) -> NDArray:
    """Return (N, 20): full-state setpoints as the controller takes them."""
    rows = np.zeros((len(setpoints.position), SETPOINT_SIZE))
    rows[:, 0:3], rows[:, 3:6], rows[:, 6:9] = setpoints.position, setpoints.velocity, setpoints.acceleration
    rows[:, 9:13], rows[:, 13:16] = setpoints.quaternion, setpoints.body_rate
    return rows


@register_jitable(forceinline=True)
def vector(batch: NDArray, width: int, n: int, row: int) -> Vector:
    """Return three rows of a lane."""
    return batch[row * width + n], batch[(row + 1) * width + n], batch[(row + 2) * width + n]


@register_jitable(forceinline=True)
def write_vector(batch: NDArray, width: int, n: int, row: int, values: Vector) -> None:
    """Write three rows of a lane."""
    batch[row * width + n], batch[(row + 1) * width + n], batch[(row + 2) * width + n] = values


@register_jitable(forceinline=True)
def quadruple(batch: NDArray, width: int, n: int, row: int) -> Any:
    """Return four rows of a lane."""
    return (
        batch[row * width + n], batch[(row + 1) * width + n], batch[(row + 2) * width + n],
        batch[(row + 3) * width + n],
    )  # fmt: skip


@register_jitable(forceinline=True)
def write_quadruple(batch: NDArray, width: int, n: int, row: int, values: Any) -> None:
    """Write four rows of a lane."""
    batch[row * width + n], batch[(row + 1) * width + n] = values[0], values[1]
    batch[(row + 2) * width + n], batch[(row + 3) * width + n] = values[2], values[3]


@register_jitable
def padded(lanes: int) -> int:
    """Return how many lanes to process: complete vectors, unless one or two lanes alone are faster."""
    return lanes if lanes <= 2 else min((lanes + _VECTOR - 1) // _VECTOR * _VECTOR, WIDTH)
