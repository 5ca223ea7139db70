"""The simulated vehicle: a rigid body with motor lag and rotor drag, stepped at 1 kHz.

Semi-implicit Euler, each line using what the lines above it made: motors, body rate, velocity, position, attitude.
Everything runs inside numba, so state and parameters are flat arrays:

    state (17,)   position 0:3 m, velocity 3:6 m/s, quaternion 6:10 body→world x y z w,
                  body rate 10:13 rad/s in body axes, thrust of each motor 13:17 N

The floor is inelastic and holds: a body on it that the rotors do not lift stands still and level.
"""

import numpy as np
from numpy.typing import NDArray

from cfplan.machine_code import njit
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.rotations import about_z, matrix_of, product, yaw_of

TIME_STEP = 0.001  # s

POSITION = slice(0, 3)
VELOCITY = slice(3, 6)
QUATERNION = slice(6, 10)
BODY_RATE = slice(10, 13)
MOTORS = slice(13, 17)
STATE_SIZE = 17

# Where each parameter lies in the array that `pack_body` makes.
MASS, _JX, _JY, _JZ, _ARM, _THRUST_TO_TORQUE, THRUST_MAX, _LAG, _DRAG, _AXIAL_DRAG, FLOOR, _REACTION = range(12)

STILL_AIR = np.zeros(3)
FULL_EFFICIENCY = np.ones(4)


def pack_body(airframe: Airframe, *, floor: float = 0.0) -> NDArray:
    """The airframe's parameters for `step_body`; `floor` is the height of the ground, -inf for none."""
    return np.array(
        [
            airframe.mass,
            *airframe.inertia,
            airframe.arm,
            airframe.thrust_to_torque,
            airframe.motor_thrust_max,
            airframe.motor_time_constant,
            *airframe.drag,
            floor,
            airframe.rotor_reaction,
        ],
        dtype=float,
    )


def hovering(airframe: Airframe, position: NDArray, yaw: float = 0.0) -> NDArray:
    """(17,) the state of a vehicle that hovers."""
    state = at_rest(position, yaw)
    state[MOTORS] = airframe.hover_thrust
    return state


def at_rest(position: NDArray, yaw: float = 0.0) -> NDArray:
    """(17,) the state of a vehicle that stands still, level, its motors off."""
    state = np.zeros(STATE_SIZE)
    state[POSITION] = position
    state[QUATERNION] = about_z(yaw)
    return state


@njit
def step_body(state: NDArray, command: NDArray, body: NDArray, wind: NDArray, efficiency: NDArray) -> None:
    """Advance `state` by one TIME_STEP, in place.

    `command` (4,) N is what each motor is asked for, clipped to what it can give; `wind` (3,) m/s in world axes;
    `efficiency` (4,) is the share of its thrust that each motor gives, 1 without a fault.
    """
    lag = min(1.0, TIME_STEP / max(body[_LAG], 1e-9))
    push, twist = np.empty(4), np.empty(4)
    for motor in range(4):
        asked = min(max(command[motor], 0.0), body[THRUST_MAX])
        change = (asked - state[13 + motor]) * lag
        state[13 + motor] += change
        push[motor] = state[13 + motor] * efficiency[motor]
        # A rotor that speeds up pushes the body the other way round, as its drag does.
        twist[motor] = body[_THRUST_TO_TORQUE] * push[motor] + body[_REACTION] * change / TIME_STEP
    thrust = push[0] + push[1] + push[2] + push[3]

    # On the floor the ground takes all torque and every force that does not lift the body off it.
    turn = matrix_of(state[6:10])
    on_floor = state[2] <= body[FLOOR]
    if on_floor and state[5] <= 0.0 and thrust * turn[2, 2] <= body[MASS] * GRAVITY:
        _rest(state, body[FLOOR])
        return

    torque_x = body[_ARM] * (-push[0] - push[1] + push[2] + push[3])
    torque_y = body[_ARM] * (-push[0] + push[1] + push[2] - push[3])
    torque_z = -twist[0] + twist[1] - twist[2] + twist[3]
    wx, wy, wz = state[10], state[11], state[12]
    jx, jy, jz = body[_JX], body[_JY], body[_JZ]
    state[10] += TIME_STEP * (torque_x + (jy - jz) * wy * wz) / jx
    state[11] += TIME_STEP * (torque_y + (jz - jx) * wz * wx) / jy
    state[12] += TIME_STEP * (torque_z + (jx - jy) * wx * wy) / jz

    ax, ay, az = state[3] - wind[0], state[4] - wind[1], state[5] - wind[2]
    force_x = -body[_DRAG] * (turn[0, 0] * ax + turn[1, 0] * ay + turn[2, 0] * az)
    force_y = -body[_DRAG] * (turn[0, 1] * ax + turn[1, 1] * ay + turn[2, 1] * az)
    force_z = thrust - body[_AXIAL_DRAG] * (turn[0, 2] * ax + turn[1, 2] * ay + turn[2, 2] * az)
    for axis in range(3):
        force = turn[axis, 0] * force_x + turn[axis, 1] * force_y + turn[axis, 2] * force_z
        state[3 + axis] += TIME_STEP * force / body[MASS]
    state[5] -= TIME_STEP * GRAVITY
    for axis in range(3):
        state[axis] += TIME_STEP * state[3 + axis]
    _turn(state)
    if state[2] < body[FLOOR]:
        _rest(state, body[FLOOR])


@njit
def _turn(state: NDArray) -> None:
    """Turn the attitude by the body rate over one TIME_STEP, exactly for a constant rate."""
    wx, wy, wz = state[10], state[11], state[12]
    rate = np.sqrt(wx * wx + wy * wy + wz * wz)
    half = 0.5 * rate * TIME_STEP
    share = 0.5 * TIME_STEP if half < 1e-9 else np.sin(half) / rate
    rx, ry, rz, rw = wx * share, wy * share, wz * share, np.cos(half)
    x, y, z, w = state[6], state[7], state[8], state[9]
    norm = np.sqrt((x * x + y * y + z * z + w * w) * (rx * rx + ry * ry + rz * rz + rw * rw))
    turned = product((x, y, z, w), (rx, ry, rz, rw))
    for axis in range(4):
        state[6 + axis] = turned[axis] / norm


@njit
def _rest(state: NDArray, floor: float) -> None:
    """Stand on the floor: still and level, yaw kept."""
    state[2] = floor
    state[3:6] = 0.0
    state[10:13] = 0.0
    half = 0.5 * yaw_of(state[6:10])
    state[6:8] = 0.0
    state[8], state[9] = np.sin(half), np.cos(half)
