"""The firmware's Mellinger controller and power distribution, as crazyflie-firmware 2026.08 has them.

Mellinger and Kumar, "Minimum snap trajectory generation and control for quadrotors" (2011), with the firmware's
integrators and its term on the change of body rates. Runs at 500 Hz on one lane of a batch (see `layout`), in
which it reads the setpoint and updates the memory:

    setpoint (20)   position 0:3, velocity 3:6, acceleration 6:9, quaternion 9:13 x y z w, body rate 13:16 rad/s
                    (right-handed body axes), roll, pitch, yaw 16:19 rad (the firmware's legacy signs: pitch up is
                    positive), thrust 19 in 16-bit units
    memory (10)     integrals of the position error 0:3 and of the attitude error 3:6; the last roll and pitch rate
                    6:8 and those of the last setpoint 8:10. Zeros at the start
    mode (7)        DISABLE, ABSOLUTE or VELOCITY for x, y, z, roll, pitch, yaw and the quaternion
    belief          estimated position, velocity, quaternion and body rate
    control (4)     thrust, roll, pitch, yaw in 16-bit units
"""

from typing import Any

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.machine_code import njit
from cfplan.simulation.engine.layout import (
    ASKED,
    MEMORY,
    SETPOINT,
    THRUST_MAX,
    quadruple,
    vector,
    write_quadruple,
    write_vector,
)
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.rotations import Vector, axes_of, heading_of

CONTROL_PERIOD = 0.002  # s

Gains = Any  # as flight/firmware.py packs them, an array or a tuple
Modes = Any  # seven numbers, an array or a tuple
Belief = Any  # position, velocity, quaternion, body rate
Axes = tuple[Vector, Vector, Vector]  # x, y and z of a body, in the world
Quadruple = tuple[float, float, float, float]

DISABLE, ABSOLUTE, VELOCITY_MODE = 0, 1, 2
# Index of each mode.
MODE_X, MODE_Y, MODE_Z, MODE_ROLL, MODE_PITCH, MODE_YAW, MODE_QUATERNION = range(7)

FULL_STATE = (ABSOLUTE, ABSOLUTE, ABSOLUTE, DISABLE, DISABLE, DISABLE, ABSOLUTE)  # of a full-state packet
# Of a full-state packet once the supervisor levels out: level, no yaw rate, height kept.
LEVEL_OUT = (DISABLE, DISABLE, ABSOLUTE, ABSOLUTE, ABSOLUTE, VELOCITY_MODE, ABSOLUTE)
# Of the high-level commander: yaw as an angle.
ON_BOARD = (ABSOLUTE, ABSOLUTE, ABSOLUTE, DISABLE, DISABLE, ABSOLUTE, DISABLE)
NOTHING = (DISABLE,) * 7  # of the null setpoint: motors off

YAW_RATE = 15  # rad/s, its place in a setpoint
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


@njit(allocates=False, error_model="numpy")
def step_mellinger(vehicle: NDArray, gains: Gains, mode: Modes, belief: NDArray, period: float) -> Quadruple:
    """Step the controller of one vehicle, (77,), on an estimated state, (13,); return its control."""
    place, speed = (belief[0], belief[1], belief[2]), (belief[3], belief[4], belief[5])
    attitude, rate = (belief[6], belief[7], belief[8], belief[9]), (belief[10], belief[11], belief[12])
    return mellinger(vehicle, 1, 0, gains, mode, (place, speed, attitude, rate), period)


@njit(allocates=False, error_model="numpy")
def fly_mellinger(vehicle: NDArray, gains: Gains, mode: Modes) -> None:
    """Step the controller of one vehicle on its true state by CONTROL_PERIOD, and command its motors."""
    store_commands(vehicle, 1, 0, mixed(step_mellinger(vehicle, gains, mode, vehicle[:13], CONTROL_PERIOD)))


@register_jitable(forceinline=True)
def store_commands(batch: NDArray, width: int, n: int, commands: Quadruple) -> None:
    """Set the commanded thrusts of a lane's motors from 16-bit commands."""
    scale = batch[THRUST_MAX * width + n] / FULL_COMMAND
    thrusts = commands[0] * scale, commands[1] * scale, commands[2] * scale, commands[3] * scale
    write_quadruple(batch, width, n, ASKED, thrusts)


@register_jitable(forceinline=True)
def mellinger(
    batch: NDArray, width: int, n: int, gains: Gains, mode: Modes, belief: Belief, period: float
) -> Quadruple:  # seven, as it is inlined
    """Step the controller of a lane by `period`, s, which is CONTROL_PERIOD in the firmware; return its control."""
    (x, y, z), (vx, vy, vz), (qx, qy, qz, qw), rate = belief
    place, speed = vector(batch, width, n, SETPOINT), vector(batch, width, n, SETPOINT + 3)
    sum_x, sum_y, sum_z = vector(batch, width, n, MEMORY)
    pull_x, sum_x = _pull(gains, False, place[0] - x, speed[0] - vx, sum_x, period)
    pull_y, sum_y = _pull(gains, False, place[1] - y, speed[1] - vy, sum_y, period)
    pull_z, sum_z = _pull(gains, True, place[2] - z, speed[2] - vz, sum_z, period)

    turn = axes_of(qx, qy, qz, qw)
    by_position = mode[MODE_X] == ABSOLUTE
    manual = mode[MODE_ROLL] == ABSOLUTE and mode[MODE_PITCH] == ABSOLUTE and mode[MODE_Z] == DISABLE
    yaw = _wanted_yaw(batch, width, n, mode, turn, by_position or manual, period)
    thrust = 0.0
    if manual and not by_position:
        desired = _attitude(batch[(SETPOINT + 16) * width + n], -batch[(SETPOINT + 17) * width + n], yaw)
    else:
        fx, fy, fz = 0.0, 0.0, gains[_MASS] * GRAVITY + pull_z
        if by_position:
            ahead = vector(batch, width, n, SETPOINT + 6)
            fx, fy = gains[_MASS] * ahead[0] + pull_x, gains[_MASS] * ahead[1] + pull_y
            fz += gains[_MASS] * ahead[2]
        thrust, desired = _dot((fx, fy, fz), turn[2]), _thrust_frame(fx, fy, fz, yaw)

    moments, errors, last = _moments(
        gains, turn, desired, (rate, vector(batch, width, n, SETPOINT + 13)),
        (vector(batch, width, n, MEMORY + 3), quadruple(batch, width, n, MEMORY + 6)), period,
    )  # fmt: skip
    command = gains[_MASS_THRUST] * thrust
    if mode[MODE_Z] == DISABLE:
        command = batch[(SETPOINT + 19) * width + n]
    flies = command > 0.0
    write_vector(batch, width, n, MEMORY, _if(flies, (sum_x, sum_y, sum_z)))
    write_vector(batch, width, n, MEMORY + 3, _if(flies, errors))
    write_quadruple(batch, width, n, MEMORY + 6, last)
    roll, pitch, spin = _if(flies, moments)
    return command, roll, pitch, spin


@register_jitable(forceinline=True)
def _if(holds: bool, values: Vector) -> tuple[float, float, float]:
    """Return the values if `holds`, else zeros."""
    return (values[0] if holds else 0.0), (values[1] if holds else 0.0), (values[2] if holds else 0.0)


@register_jitable(forceinline=True)
def _wanted_yaw(
    batch: NDArray, width: int, n: int, mode: Modes, turn: Axes, commanded: bool, period: float
) -> tuple[float, float]:  # seven, as it is inlined
    """Return cosine and sine of the wanted yaw; 1, 0 where the mode names none."""
    if not commanded:
        # Level out: the firmware keeps height and the direction that it points in.
        return _direction(turn[0][0], turn[0][1])
    if mode[MODE_YAW] == VELOCITY_MODE:
        ahead = np.arctan2(turn[0][1], turn[0][0]) + batch[(SETPOINT + YAW_RATE) * width + n] * period
        return np.cos(ahead), np.sin(ahead)
    if mode[MODE_YAW] == ABSOLUTE:
        return np.cos(batch[(SETPOINT + 18) * width + n]), np.sin(batch[(SETPOINT + 18) * width + n])
    if mode[MODE_QUATERNION] == ABSOLUTE:
        x, y = heading_of(quadruple(batch, width, n, SETPOINT + 9))
        return _direction(x, y)
    return 1.0, 0.0


@register_jitable(forceinline=True)
def _pull(
    gains: Gains, upwards: bool, error: float, error_rate: float, integral: float, period: float
) -> tuple[float, float]:
    """Return the force along an axis in response to the position error, N, and the integral of that error."""
    if upwards:
        kp, kd, ki, largest = gains[_KP_Z], gains[_KD_Z], gains[_KI_Z], gains[_I_RANGE_Z]
    else:
        kp, kd, ki, largest = gains[_KP_XY], gains[_KD_XY], gains[_KI_XY], gains[_I_RANGE_XY]
    integral = _clamp(integral + error * period, largest)
    return kp * error + kd * error_rate + ki * integral, integral


@register_jitable(forceinline=True)
def _moments(
    gains: Gains,
    turn: Axes,
    desired: Axes,
    rates: tuple[Vector, Vector],
    memory: tuple[Vector, Quadruple],
    period: float,
) -> tuple[Vector, Vector, Quadruple]:
    """Return roll, pitch and yaw in 16-bit units, and the memory: integrals of the attitude error, and last rates.

    `rates` are those of the body and the wanted ones, rad/s, in right-handed axes; `memory` is as it was.
    """
    (rate, wanted), (errors, last) = rates, memory
    # Roll, pitch and yaw errors; pitch counts nose up, which is negative about the body's y axis.
    tilt_x = _dot(desired[2], turn[1]) - _dot(turn[2], desired[1])
    tilt_y = _dot(turn[0], desired[2]) - _dot(desired[0], turn[2])
    tilt_z = _dot(desired[1], turn[0]) - _dot(turn[1], desired[0])
    rate_x, rate_y, rate_z = rate[0], -rate[1], rate[2]
    wanted_x, wanted_y, wanted_z = wanted[0], -wanted[1], wanted[2]
    per_period = 1.0 / period
    surge_x = ((wanted_x - last[2]) - (rate_x - last[0])) * per_period
    surge_y = ((wanted_y - last[3]) - (rate_y - last[1])) * per_period
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


@register_jitable(forceinline=True)
def mixed(control: Quadruple) -> Quadruple:
    """Return the command of each motor, in [0, FULL_COMMAND]: all are lowered by the excess of the largest."""
    thrust, half_roll, half_pitch, spin = control[0], np.trunc(control[1] / 2), np.trunc(control[2] / 2), control[3]
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
def _direction(x: float, y: float) -> tuple[float, float]:
    """Return cosine and sine of the direction of (x, y)."""
    size = np.sqrt(x * x + y * y)
    per_size = 1.0 / size
    return (x * per_size, y * per_size) if size > 0.0 else (1.0, 0.0)


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
    per_size = 1.0 / np.sqrt(x * x + y * y + z * z)
    zx, zy, zz = x * per_size, y * per_size, z * per_size
    yx, yy, yz = -zz * sy, zz * cy, zx * sy - zy * cy
    per_size = 1.0 / np.sqrt(yx * yx + yy * yy + yz * yz)
    yx, yy, yz = yx * per_size, yy * per_size, yz * per_size
    return (yy * zz - yz * zy, yz * zx - yx * zz, yx * zy - yy * zx), (yx, yy, yz), (zx, zy, zz)
