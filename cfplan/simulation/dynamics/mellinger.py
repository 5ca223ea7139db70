"""The firmware's Mellinger controller and power distribution, as crazyflie-firmware 2026.08 has them.

Mellinger and Kumar, "Minimum snap trajectory generation and control for quadrotors" (2011), with the firmware's
integrators and its term on the change of body rates. Runs at 500 Hz inside numba, so everything is a flat array:

    setpoint (20,)  position 0:3, velocity 3:6, acceleration 6:9, quaternion 9:13 x y z w, body rate 13:16 rad/s
                    (right-handed body axes), roll, pitch, yaw 16:19 rad (the firmware's legacy signs: pitch up is
                    positive), thrust 19 in 16-bit units
    mode (7,)       DISABLE, ABSOLUTE or VELOCITY for x, y, z, roll, pitch, yaw and the quaternion
    state           position 0:3, velocity 3:6, quaternion 6:10, body rate 10:13, as in `body`
    memory (10,)    integrals of the position error 0:3 and of the attitude error 3:6; the last roll and pitch rate
                    6:8 and those of the last setpoint 8:10. Zeros at the start
    control (4,)    thrust, roll, pitch, yaw in 16-bit units
"""

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.machine_code import njit
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.rotations import matrix_of, yaw_of

CONTROL_PERIOD = 0.002  # s

SETPOINT_SIZE = 20
MEMORY_SIZE = 10

DISABLE, ABSOLUTE, VELOCITY_MODE = 0, 1, 2
# Index of each mode in the array.
MODE_X, MODE_Y, MODE_Z, MODE_ROLL, MODE_PITCH, MODE_YAW, MODE_QUATERNION = range(7)

FULL_STATE = np.array([ABSOLUTE, ABSOLUTE, ABSOLUTE, DISABLE, DISABLE, DISABLE, ABSOLUTE])  # of a full-state packet
# Of the high-level commander: yaw as an angle.
ON_BOARD = np.array([ABSOLUTE, ABSOLUTE, ABSOLUTE, DISABLE, DISABLE, ABSOLUTE, DISABLE])
NOTHING = np.zeros(7, dtype=np.int64)  # of the null setpoint: motors off

FULL_COMMAND = 65535  # of one motor
_MOMENT_LIMIT = 32000.0


(
    _MASS, _MASS_THRUST, _KP_XY, _KD_XY, _KI_XY, _I_RANGE_XY, _KP_Z, _KD_Z, _KI_Z, _I_RANGE_Z, _KR_XY, _KW_XY,
    _KI_M_XY, _I_RANGE_M_XY, _KR_Z, _KW_Z, _KI_M_Z, _I_RANGE_M_Z, _KD_OMEGA,
) = range(19)  # as flight/firmware.py packs the gains  # fmt: skip


@njit
def level_out(setpoint: NDArray, mode: NDArray) -> None:
    """Apply the supervisor's override when setpoints stop coming, in place: level, no yaw rate, height kept."""
    mode[MODE_X] = mode[MODE_Y] = DISABLE
    mode[MODE_ROLL] = mode[MODE_PITCH] = ABSOLUTE
    mode[MODE_YAW] = VELOCITY_MODE
    setpoint[16] = setpoint[17] = 0.0
    setpoint[15] = 0.0


@njit
def step_mellinger(
    control: NDArray, memory: NDArray, gains: NDArray, setpoint: NDArray, mode: NDArray, state: NDArray
) -> None:
    """Step the controller by CONTROL_PERIOD: write `control` and update `memory`."""
    pull = np.empty(3)  # force that the errors of position call for
    for axis in range(3):
        kp, kd = (gains[_KP_XY], gains[_KD_XY]) if axis < 2 else (gains[_KP_Z], gains[_KD_Z])
        ki, i_range = (gains[_KI_XY], gains[_I_RANGE_XY]) if axis < 2 else (gains[_KI_Z], gains[_I_RANGE_Z])
        error = setpoint[axis] - state[axis]
        memory[axis] = _clamp(memory[axis] + error * CONTROL_PERIOD, i_range)
        pull[axis] = kp * error + kd * (setpoint[3 + axis] - state[3 + axis]) + ki * memory[axis]

    yaw = 0.0
    if mode[MODE_YAW] == VELOCITY_MODE:
        yaw = yaw_of(state[6:10]) + setpoint[15] * CONTROL_PERIOD
    elif mode[MODE_YAW] == ABSOLUTE:
        yaw = setpoint[18]
    elif mode[MODE_QUATERNION] == ABSOLUTE:
        yaw = yaw_of(setpoint[9:13])

    turn = matrix_of(state[6:10])
    by_position = mode[MODE_X] == ABSOLUTE
    manual = mode[MODE_ROLL] == ABSOLUTE and mode[MODE_PITCH] == ABSOLUTE and mode[MODE_Z] == DISABLE
    thrust = 0.0
    if manual and not by_position:
        desired = _attitude(setpoint[16], -setpoint[17], yaw)
    else:
        force_x, force_y, force_z = 0.0, 0.0, gains[_MASS] * GRAVITY + pull[2]
        if by_position:
            force_x = gains[_MASS] * setpoint[6] + pull[0]
            force_y = gains[_MASS] * setpoint[7] + pull[1]
            force_z += gains[_MASS] * setpoint[8]
        else:
            # Level out: the firmware keeps height and the direction that it points in.
            yaw = yaw_of(state[6:10])
        thrust = force_x * turn[0, 2] + force_y * turn[1, 2] + force_z * turn[2, 2]
        desired = _thrust_frame(force_x, force_y, force_z, yaw)

    # Roll, pitch and yaw errors; pitch counts nose up, which is negative about the body's y axis.
    tilt_x = _along(desired, 2, turn, 1) - _along(turn, 2, desired, 1)
    tilt_y = _along(turn, 0, desired, 2) - _along(desired, 0, turn, 2)
    tilt_z = _along(desired, 1, turn, 0) - _along(turn, 1, desired, 0)
    rate_x, rate_y, rate_z = state[10], -state[11], state[12]
    wanted_x, wanted_y, wanted_z = setpoint[13], -setpoint[14], setpoint[15]
    surge_x = ((wanted_x - memory[8]) - (rate_x - memory[6])) / CONTROL_PERIOD
    surge_y = ((wanted_y - memory[9]) - (rate_y - memory[7])) / CONTROL_PERIOD
    memory[6], memory[7], memory[8], memory[9] = rate_x, rate_y, wanted_x, wanted_y
    memory[3] = _clamp(memory[3] - tilt_x * CONTROL_PERIOD, gains[_I_RANGE_M_XY])
    memory[4] = _clamp(memory[4] - tilt_y * CONTROL_PERIOD, gains[_I_RANGE_M_XY])
    memory[5] = _clamp(memory[5] - tilt_z * CONTROL_PERIOD, gains[_I_RANGE_M_Z])

    roll = -gains[_KR_XY] * tilt_x + gains[_KW_XY] * (wanted_x - rate_x)
    roll += gains[_KI_M_XY] * memory[3] + gains[_KD_OMEGA] * surge_x
    pitch = -gains[_KR_XY] * tilt_y + gains[_KW_XY] * (wanted_y - rate_y)
    pitch += gains[_KI_M_XY] * memory[4] + gains[_KD_OMEGA] * surge_y
    spin = -gains[_KR_Z] * tilt_z + gains[_KW_Z] * (wanted_z - rate_z) + gains[_KI_M_Z] * memory[5]

    control[0] = setpoint[19] if mode[MODE_Z] == DISABLE else gains[_MASS_THRUST] * thrust
    if control[0] > 0:
        control[1] = _clamp(roll, _MOMENT_LIMIT)
        control[2] = _clamp(pitch, _MOMENT_LIMIT)
        control[3] = _clamp(-spin, _MOMENT_LIMIT)
    else:
        control[1:4] = 0.0
        memory[0:6] = 0.0


@njit
def distribute_power(control: NDArray, motors: NDArray) -> None:
    """Mix a control into motor commands (4,), in [0, FULL_COMMAND]: all are lowered by the excess of the largest."""
    half_roll, half_pitch = np.trunc(control[1] / 2), np.trunc(control[2] / 2)
    motors[0] = np.trunc(control[0] - half_roll + half_pitch + control[3])
    motors[1] = np.trunc(control[0] - half_roll - half_pitch - control[3])
    motors[2] = np.trunc(control[0] + half_roll - half_pitch + control[3])
    motors[3] = np.trunc(control[0] + half_roll + half_pitch - control[3])
    excess = 0.0
    for motor in range(4):
        excess = max(excess, motors[motor] - FULL_COMMAND)
    for motor in range(4):
        motors[motor] = max(motors[motor] - excess, 0.0)


@register_jitable
def _clamp(value: float, limit: float) -> float:
    return min(max(value, -limit), limit)


@register_jitable
def _along(a: NDArray, i: int, b: NDArray, j: int) -> float:
    """Return the dot product of column i of `a` and column j of `b`."""
    return a[0, i] * b[0, j] + a[1, i] * b[1, j] + a[2, i] * b[2, j]


@njit
def _attitude(roll: float, pitch: float, yaw: float) -> NDArray:
    """Return the (3, 3) rotation of Euler angles ZYX, rad."""
    cr, sr, cp, sp, cy, sy = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch), np.cos(yaw), np.sin(yaw)
    frame = np.empty((3, 3))
    frame[0, 0], frame[0, 1], frame[0, 2] = cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr
    frame[1, 0], frame[1, 1], frame[1, 2] = sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr
    frame[2, 0], frame[2, 1], frame[2, 2] = -sp, cp * sr, cp * cr
    return frame


@njit
def _thrust_frame(x: float, y: float, z: float, yaw: float) -> NDArray:
    """Return the (3, 3) rotation whose z axis is along a force and whose x axis lies over the direction of yaw."""
    norm = np.sqrt(x * x + y * y + z * z)
    zx, zy, zz = x / norm, y / norm, z / norm
    yx, yy, yz = -zz * np.sin(yaw), zz * np.cos(yaw), zx * np.sin(yaw) - zy * np.cos(yaw)
    norm = np.sqrt(yx * yx + yy * yy + yz * yz)
    yx, yy, yz = yx / norm, yy / norm, yz / norm
    frame = np.empty((3, 3))
    frame[0, 0], frame[1, 0], frame[2, 0] = yy * zz - yz * zy, yz * zx - yx * zz, yx * zy - yy * zx
    frame[0, 1], frame[1, 1], frame[2, 1] = yx, yy, yz
    frame[0, 2], frame[1, 2], frame[2, 2] = zx, zy, zz
    return frame
