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

from typing import Any

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.machine_code import njit
from cfplan.simulation.dynamics.body import Motors
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.rotations import Vector, axes_of, heading_of

CONTROL_PERIOD = 0.002  # s

Gains = Any  # as flight/firmware.py packs them, an array or a tuple
Axes = tuple[Vector, Vector, Vector]  # x, y and z of a body, in the world

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
    pull_x, memory[0] = _pull_along(memory, gains, setpoint, state, 0, period)
    pull_y, memory[1] = _pull_along(memory, gains, setpoint, state, 1, period)
    pull_z, memory[2] = _pull_along(memory, gains, setpoint, state, 2, period)

    turn = axes_of(state[6], state[7], state[8], state[9])
    by_position = mode[MODE_X] == ABSOLUTE
    manual = mode[MODE_ROLL] == ABSOLUTE and mode[MODE_PITCH] == ABSOLUTE and mode[MODE_Z] == DISABLE
    yaw = 1.0, 0.0  # cosine and sine
    if not (by_position or manual):
        # Level out: the firmware keeps height and the direction that it points in.
        yaw = direction(turn[0][0], turn[0][1])
    elif mode[MODE_YAW] == VELOCITY_MODE:
        ahead = np.arctan2(turn[0][1], turn[0][0]) + setpoint[15] * period
        yaw = np.cos(ahead), np.sin(ahead)
    elif mode[MODE_YAW] == ABSOLUTE:
        yaw = np.cos(setpoint[18]), np.sin(setpoint[18])
    elif mode[MODE_QUATERNION] == ABSOLUTE:
        x, y = heading_of((setpoint[9], setpoint[10], setpoint[11], setpoint[12]))
        yaw = direction(x, y)

    thrust = 0.0
    if manual and not by_position:
        desired = _attitude(setpoint[16], -setpoint[17], yaw)
    else:
        if by_position:
            force = force_of(gains, (pull_x, pull_y, pull_z), (setpoint[6], setpoint[7], setpoint[8]))
        else:
            force = level_force_of(gains, pull_z)
        thrust, desired = thrust_along(force, turn, yaw)

    rate, wanted = (state[10], state[11], state[12]), (setpoint[13], setpoint[14], setpoint[15])
    errors, last = (memory[3], memory[4], memory[5]), (memory[6], memory[7], memory[8], memory[9])
    moments, errors, last = moments_of(gains, turn, desired, rate, wanted, errors, last, period)
    memory[3], memory[4], memory[5] = errors
    memory[6], memory[7], memory[8], memory[9] = last
    control[0] = setpoint[19] if mode[MODE_Z] == DISABLE else command_of(gains, thrust)
    if control[0] > 0:
        control[1], control[2], control[3] = moments
    else:
        control[1] = control[2] = control[3] = 0.0
        for k in range(6):
            memory[k] = 0.0


@register_jitable(forceinline=True)
def _pull_along(
    memory: NDArray, gains: Gains, setpoint: NDArray, state: NDArray, axis: int, period: float
) -> tuple[float, float]:
    error, error_rate = setpoint[axis] - state[axis], setpoint[3 + axis] - state[3 + axis]
    return pull_of(gains, axis == 2, error, error_rate, memory[axis], period)


@register_jitable(forceinline=True)
def pull_of(
    gains: Gains, upwards: bool, error: float, error_rate: float, integral: float, period: float
) -> tuple[float, float]:
    """Return the force that the error of position along an axis calls for, N, and the integral of that error."""
    if upwards:
        kp, kd, ki, largest = gains[_KP_Z], gains[_KD_Z], gains[_KI_Z], gains[_I_RANGE_Z]
    else:
        kp, kd, ki, largest = gains[_KP_XY], gains[_KD_XY], gains[_KI_XY], gains[_I_RANGE_XY]
    integral = _clamp(integral + error * period, largest)
    return kp * error + kd * error_rate + ki * integral, integral


@register_jitable(forceinline=True)
def force_of(gains: Gains, pull: Vector, acceleration: Vector) -> Vector:
    """Return the force that a full-state setpoint calls for, N."""
    return (
        gains[_MASS] * acceleration[0] + pull[0],
        gains[_MASS] * acceleration[1] + pull[1],
        gains[_MASS] * GRAVITY + pull[2] + gains[_MASS] * acceleration[2],
    )


@register_jitable(forceinline=True)
def level_force_of(gains: Gains, pull: float) -> Vector:
    """Return the force that levelling out calls for, N."""
    return 0.0, 0.0, gains[_MASS] * GRAVITY + pull


@register_jitable(forceinline=True)
def thrust_along(force: Vector, turn: Axes, yaw: tuple[float, float]) -> tuple[float, Axes]:
    """Return the share of a force along the body's thrust axis, N, and the attitude in which all of it would be."""
    return _dot(force, turn[2]), _thrust_frame(force[0], force[1], force[2], yaw)


@register_jitable(forceinline=True)
def command_of(gains: Gains, thrust: float) -> float:
    """Return a thrust, N, in 16-bit units."""
    return gains[_MASS_THRUST] * thrust


@register_jitable(forceinline=True)
def moments_of(
    gains: Gains, turn: Axes, desired: Axes, rate: Vector, wanted: Vector, errors: Vector, last: Motors, period: float
) -> tuple[Vector, Vector, Motors]:
    """Return roll, pitch and yaw in 16-bit units, and the memory: integrals of the attitude error, and last rates.

    `rate` and `wanted` are body rates, rad/s, in right-handed axes.
    """
    # Roll, pitch and yaw errors; pitch counts nose up, which is negative about the body's y axis.
    tilt_x = _dot(desired[2], turn[1]) - _dot(turn[2], desired[1])
    tilt_y = _dot(turn[0], desired[2]) - _dot(desired[0], turn[2])
    tilt_z = _dot(desired[1], turn[0]) - _dot(turn[1], desired[0])
    rate_x, rate_y, rate_z = rate[0], -rate[1], rate[2]
    wanted_x, wanted_y, wanted_z = wanted[0], -wanted[1], wanted[2]
    surge_x = ((wanted_x - last[2]) - (rate_x - last[0])) / period
    surge_y = ((wanted_y - last[3]) - (rate_y - last[1])) / period
    error_x = _clamp(errors[0] - tilt_x * period, gains[_I_RANGE_M_XY])
    error_y = _clamp(errors[1] - tilt_y * period, gains[_I_RANGE_M_XY])
    error_z = _clamp(errors[2] - tilt_z * period, gains[_I_RANGE_M_Z])

    roll = -gains[_KR_XY] * tilt_x + gains[_KW_XY] * (wanted_x - rate_x)
    roll += gains[_KI_M_XY] * error_x + gains[_KD_OMEGA] * surge_x
    pitch = -gains[_KR_XY] * tilt_y + gains[_KW_XY] * (wanted_y - rate_y)
    pitch += gains[_KI_M_XY] * error_y + gains[_KD_OMEGA] * surge_y
    spin = -gains[_KR_Z] * tilt_z + gains[_KW_Z] * (wanted_z - rate_z) + gains[_KI_M_Z] * error_z
    moments = _clamp(roll, _MOMENT_LIMIT), _clamp(pitch, _MOMENT_LIMIT), _clamp(-spin, _MOMENT_LIMIT)
    return moments, (error_x, error_y, error_z), (rate_x, rate_y, wanted_x, wanted_y)


@njit(allocates=False)
def distribute_power(control: NDArray, motors: NDArray) -> None:
    """Mix a control into motor commands (4,), in [0, FULL_COMMAND]: all are lowered by the excess of the largest."""
    motors[0], motors[1], motors[2], motors[3] = mixed(control[0], (control[1], control[2], control[3]))


@register_jitable(forceinline=True)
def mixed(thrust: float, moments: Vector) -> Motors:
    """Return the command of each motor, in [0, FULL_COMMAND], of a thrust, roll, pitch and yaw in 16-bit units."""
    half_roll, half_pitch, spin = np.trunc(moments[0] / 2), np.trunc(moments[1] / 2), moments[2]
    first = np.trunc(thrust - half_roll + half_pitch + spin)
    second = np.trunc(thrust - half_roll - half_pitch - spin)
    third = np.trunc(thrust + half_roll - half_pitch + spin)
    fourth = np.trunc(thrust + half_roll + half_pitch - spin)
    excess = max(0.0, first - FULL_COMMAND, second - FULL_COMMAND, third - FULL_COMMAND, fourth - FULL_COMMAND)
    return max(first - excess, 0.0), max(second - excess, 0.0), max(third - excess, 0.0), max(fourth - excess, 0.0)


@register_jitable
def _clamp(value: float, limit: float) -> float:
    return min(max(value, -limit), limit)


@register_jitable
def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@register_jitable
def direction(x: float, y: float) -> tuple[float, float]:
    """Return cosine and sine of the direction of (x, y)."""
    size = np.sqrt(x * x + y * y)
    return (x / size, y / size) if size > 0.0 else (1.0, 0.0)


@register_jitable
def _attitude(roll: float, pitch: float, yaw: tuple[float, float]) -> Axes:
    """Return the axes of a body with Euler angles ZYX, rad; yaw by its cosine and sine."""
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    cy, sy = yaw
    return (
        (cy * cp, sy * cp, -sp),
        (cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr),
        (cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr),
    )


@register_jitable
def _thrust_frame(x: float, y: float, z: float, yaw: tuple[float, float]) -> Axes:
    """Return the axes of a body whose z is along a force and whose x lies over the direction of yaw."""
    cy, sy = yaw
    norm = np.sqrt(x * x + y * y + z * z)
    zx, zy, zz = x / norm, y / norm, z / norm
    yx, yy, yz = -zz * sy, zz * cy, zx * sy - zy * cy
    norm = np.sqrt(yx * yx + yy * yy + yz * yz)
    yx, yy, yz = yx / norm, yy / norm, yz / norm
    return (yy * zz - yz * zy, yz * zx - yx * zz, yx * zy - yy * zx), (yx, yy, yz), (zx, zy, zz)
