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
from cfplan.vehicle.rotations import Vector, axes_of, heading_of

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


@njit(allocates=False)
def level_out(setpoint: NDArray, mode: NDArray) -> None:
    """Apply the supervisor's override when setpoints stop coming, in place: level, no yaw rate, height kept."""
    mode[MODE_X] = mode[MODE_Y] = DISABLE
    mode[MODE_ROLL] = mode[MODE_PITCH] = ABSOLUTE
    mode[MODE_YAW] = VELOCITY_MODE
    setpoint[16] = setpoint[17] = 0.0
    setpoint[15] = 0.0


@njit(allocates=False)
def step_mellinger(
    control: NDArray, memory: NDArray, gains: NDArray, setpoint: NDArray, mode: NDArray, state: NDArray
) -> None:
    """Step the controller by CONTROL_PERIOD: write `control` and update `memory`."""
    step_controller(control, memory, gains, setpoint, mode, state, CONTROL_PERIOD)


@njit(allocates=False)
def step_controller(
    control: NDArray,
    memory: NDArray,
    gains: NDArray,
    setpoint: NDArray,
    mode: NDArray,
    state: NDArray,
    period: float,
) -> None:
    """Step the controller by `period`, s, which is CONTROL_PERIOD in the firmware."""
    pull_x = _pull(memory, gains, setpoint, state, 0, period)
    pull_y = _pull(memory, gains, setpoint, state, 1, period)
    pull_z = _pull(memory, gains, setpoint, state, 2, period)

    turn = axes_of(state[6], state[7], state[8], state[9])
    by_position = mode[MODE_X] == ABSOLUTE
    manual = mode[MODE_ROLL] == ABSOLUTE and mode[MODE_PITCH] == ABSOLUTE and mode[MODE_Z] == DISABLE
    yaw = 1.0, 0.0  # cosine and sine
    if not (by_position or manual):
        # Level out: the firmware keeps height and the direction that it points in.
        yaw = _direction(turn[0][0], turn[0][1])
    elif mode[MODE_YAW] == VELOCITY_MODE:
        ahead = np.arctan2(turn[0][1], turn[0][0]) + setpoint[15] * period
        yaw = np.cos(ahead), np.sin(ahead)
    elif mode[MODE_YAW] == ABSOLUTE:
        yaw = np.cos(setpoint[18]), np.sin(setpoint[18])
    elif mode[MODE_QUATERNION] == ABSOLUTE:
        x, y = heading_of((setpoint[9], setpoint[10], setpoint[11], setpoint[12]))
        yaw = _direction(x, y)

    thrust = 0.0
    if manual and not by_position:
        desired = _attitude(setpoint[16], -setpoint[17], yaw)
    else:
        force_x, force_y, force_z = 0.0, 0.0, gains[_MASS] * GRAVITY + pull_z
        if by_position:
            force_x = gains[_MASS] * setpoint[6] + pull_x
            force_y = gains[_MASS] * setpoint[7] + pull_y
            force_z += gains[_MASS] * setpoint[8]
        thrust = _dot((force_x, force_y, force_z), turn[2])
        desired = _thrust_frame(force_x, force_y, force_z, yaw)

    # Roll, pitch and yaw errors; pitch counts nose up, which is negative about the body's y axis.
    tilt_x = _dot(desired[2], turn[1]) - _dot(turn[2], desired[1])
    tilt_y = _dot(turn[0], desired[2]) - _dot(desired[0], turn[2])
    tilt_z = _dot(desired[1], turn[0]) - _dot(turn[1], desired[0])
    rate_x, rate_y, rate_z = state[10], -state[11], state[12]
    wanted_x, wanted_y, wanted_z = setpoint[13], -setpoint[14], setpoint[15]
    surge_x = ((wanted_x - memory[8]) - (rate_x - memory[6])) / period
    surge_y = ((wanted_y - memory[9]) - (rate_y - memory[7])) / period
    memory[6], memory[7], memory[8], memory[9] = rate_x, rate_y, wanted_x, wanted_y
    memory[3] = _clamp(memory[3] - tilt_x * period, gains[_I_RANGE_M_XY])
    memory[4] = _clamp(memory[4] - tilt_y * period, gains[_I_RANGE_M_XY])
    memory[5] = _clamp(memory[5] - tilt_z * period, gains[_I_RANGE_M_Z])

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
        control[1] = control[2] = control[3] = 0.0
        for k in range(6):
            memory[k] = 0.0


@register_jitable(forceinline=True)
def _pull(memory: NDArray, gains: NDArray, setpoint: NDArray, state: NDArray, axis: int, period: float) -> float:
    """Return the force that the error of position along an axis calls for, N; it updates its integral."""
    kp, kd = (gains[_KP_XY], gains[_KD_XY]) if axis < 2 else (gains[_KP_Z], gains[_KD_Z])
    ki, i_range = (gains[_KI_XY], gains[_I_RANGE_XY]) if axis < 2 else (gains[_KI_Z], gains[_I_RANGE_Z])
    error = setpoint[axis] - state[axis]
    memory[axis] = _clamp(memory[axis] + error * period, i_range)
    return kp * error + kd * (setpoint[3 + axis] - state[3 + axis]) + ki * memory[axis]


@njit(allocates=False)
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
def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@register_jitable
def _direction(x: float, y: float) -> tuple[float, float]:
    """Return cosine and sine of the direction of (x, y)."""
    size = np.sqrt(x * x + y * y)
    return (x / size, y / size) if size > 0.0 else (1.0, 0.0)


@register_jitable
def _attitude(roll: float, pitch: float, yaw: tuple[float, float]) -> tuple[Vector, Vector, Vector]:
    """Return the axes of a body with Euler angles ZYX, rad; yaw by its cosine and sine."""
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    cy, sy = yaw
    return (
        (cy * cp, sy * cp, -sp),
        (cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr),
        (cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr),
    )


@register_jitable
def _thrust_frame(x: float, y: float, z: float, yaw: tuple[float, float]) -> tuple[Vector, Vector, Vector]:
    """Return the axes of a body whose z is along a force and whose x lies over the direction of yaw."""
    cy, sy = yaw
    norm = np.sqrt(x * x + y * y + z * z)
    zx, zy, zz = x / norm, y / norm, z / norm
    yx, yy, yz = -zz * sy, zz * cy, zx * sy - zy * cy
    norm = np.sqrt(yx * yx + yy * yy + yz * yz)
    yx, yy, yz = yx / norm, yy / norm, yz / norm
    return (yy * zz - yz * zy, yz * zx - yx * zz, yx * zy - yy * zx), (yx, yy, yz), (zx, zy, zz)
