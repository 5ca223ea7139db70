"""The firmware's default controller: cascaded PID loops of position, velocity, attitude and body rate.

Position and velocity at 100 Hz, attitude and rate at 500 Hz, in degrees, with the firmware's legacy pitch (nose up
positive). It reads nothing of a setpoint's acceleration and body rates, and its speed is limited: it cannot follow a
fast plan. Runs inside numba on flat arrays:

    gains (12, 5)   each loop's kp, ki, kd, limit of the integral, limit of the output (0: none)
    limits (5,)     most roll and pitch, degrees; thrust in hover and least, 16-bit units; most yaw lag, degrees
    memory (36,)    integrals 0:12, last measurements 12:24, wanted roll, pitch and yaw 24:27, thrust 27, the
                    last setpoint's modes 28:35, and whether there was one 35. Zeros at the start
"""

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.machine_code import njit
from cfplan.simulation.engine.mellinger import (
    ABSOLUTE,
    DISABLE,
    FULL_COMMAND,
    MODE_PITCH,
    MODE_QUATERNION,
    MODE_ROLL,
    MODE_X,
    MODE_Y,
    MODE_YAW,
    MODE_Z,
    VELOCITY_MODE,
)
from cfplan.vehicle.rotations import roll_pitch_of, yaw_of

LOOPS, MEMORY_SIZE = 12, 36
_X, _Y, _Z, _VX, _VY, _VZ, _ROLL, _PITCH, _YAW, _ROLL_RATE, _PITCH_RATE, _YAW_RATE = range(LOOPS)
_KP, _KI, _KD, _INTEGRAL_LIMIT, OUTPUT_LIMIT = range(5)
_MOST_ROLL, _MOST_PITCH, _THRUST_BASE, _THRUST_MIN, _MOST_YAW_LAG = range(5)

OVERHEAD = 1.1  # factor on the limits of speed and tilt inside the loops
_THRUST_SCALE = 1000.0
_POSITION_TICKS = 10
_SLOW, _FAST = 0.01, 0.002  # s
_LARGEST = 32767.0


def default_gains() -> NDArray:
    """Return the gains (12, 5) of crazyflie-firmware 2026.08 for the Crazyflie 2.x."""
    gains = np.zeros((LOOPS, 5))
    gains[:, _INTEGRAL_LIMIT] = 5000.0
    gains[_X, :3] = gains[_Y, :3] = 2.0, 0.0, 0.0
    gains[_Z, :3] = 2.0, 0.5, 0.0
    gains[_VX, :3] = gains[_VY, :3] = 25.0, 1.0, 0.0
    gains[_VZ, :3] = 25.0, 15.0, 0.0
    gains[_ROLL, :4] = gains[_PITCH, :4] = 6.0, 3.0, 0.0, 20.0
    gains[_YAW, :4] = 6.0, 1.0, 0.35, 360.0
    gains[_ROLL_RATE, :4] = gains[_PITCH_RATE, :4] = 250.0, 500.0, 2.5, 33.3
    gains[_YAW_RATE, :4] = 120.0, 16.7, 0.0, 166.7
    gains[[_X, _Y, _Z], OUTPUT_LIMIT] = 1.0 * OVERHEAD
    gains[[_VX, _VY], OUTPUT_LIMIT] = 20.0 * OVERHEAD
    gains[_VZ, OUTPUT_LIMIT] = FULL_COMMAND / 2 / _THRUST_SCALE
    return gains


def default_limits() -> NDArray:
    """Return the limits (5,) of the same."""
    return np.array([20.0, 20.0, 36000.0, 20000.0, 0.0])


@njit
def step_pid(
    control: NDArray,
    memory: NDArray,
    gains: NDArray,
    limits: NDArray,
    setpoint: NDArray,
    mode: NDArray,
    velocity_in_body: bool,
    state: NDArray,
    tick: int,
) -> None:
    """Step the controller by 2 ms: write `control` and update `memory`; the other arrays as in `mellinger`."""
    roll, pitch = roll_pitch_of(state[6:10])
    roll, pitch, yaw = np.degrees(roll), -np.degrees(pitch), np.degrees(yaw_of(state[6:10]))

    changed = memory[35] == 0.0
    for place in range(7):
        changed = changed or memory[28 + place] != mode[place]
        memory[28 + place] = mode[place]
    memory[35] = 1.0
    if changed:
        _reset(memory, state, roll, pitch, yaw)

    _update_yaw(memory, limits, setpoint, mode, yaw)
    if tick % _POSITION_TICKS == 0:
        _position(memory, gains, limits, setpoint, mode, velocity_in_body, state, yaw)
    if mode[MODE_Z] == DISABLE:
        memory[27] = setpoint[19]
    if mode[MODE_X] == DISABLE or mode[MODE_Y] == DISABLE:
        memory[24], memory[25] = np.degrees(setpoint[16]), np.degrees(setpoint[17])

    roll_rate = _pid(memory, gains, _ROLL, memory[24], roll, _FAST, False)
    pitch_rate = _pid(memory, gains, _PITCH, memory[25], pitch, _FAST, False)
    yaw_rate = _pid(memory, gains, _YAW, memory[26], yaw, _FAST, True)
    if mode[MODE_ROLL] == VELOCITY_MODE:
        roll_rate = np.degrees(setpoint[13])
    if mode[MODE_PITCH] == VELOCITY_MODE:
        pitch_rate = -np.degrees(setpoint[14])
    control[0] = memory[27]
    control[1] = _rate(memory, gains, _ROLL_RATE, roll_rate, np.degrees(state[10]))
    control[2] = _rate(memory, gains, _PITCH_RATE, pitch_rate, -np.degrees(state[11]))
    control[3] = -_rate(memory, gains, _YAW_RATE, yaw_rate, np.degrees(state[12]))
    if not control[0] > 0.0:
        for place in range(4):
            control[place] = 0.0
        _reset(memory, state, roll, pitch, yaw)
        memory[26] = yaw


@njit
def _reset(memory: NDArray, state: NDArray, roll: float, pitch: float, yaw: float) -> None:
    for place in range(2 * LOOPS):
        memory[place] = 0.0
    memory[LOOPS + _X], memory[LOOPS + _Y], memory[LOOPS + _Z] = state[0], state[1], state[2]
    memory[LOOPS + _ROLL], memory[LOOPS + _PITCH], memory[LOOPS + _YAW] = roll, pitch, yaw
    memory[24], memory[25] = roll, pitch


@njit
def _update_yaw(memory: NDArray, limits: NDArray, setpoint: NDArray, mode: NDArray, yaw: float) -> None:
    if mode[MODE_YAW] == VELOCITY_MODE:
        memory[26] = _wrapped(memory[26] + np.degrees(setpoint[15]) * _FAST)
        most = limits[_MOST_YAW_LAG]
        if most != 0.0:
            memory[26] = yaw + min(max(_wrapped(memory[26] - yaw), -most), most)
    elif mode[MODE_YAW] == ABSOLUTE:
        memory[26] = np.degrees(setpoint[18])
    elif mode[MODE_QUATERNION] == ABSOLUTE:
        memory[26] = np.degrees(yaw_of(setpoint[9:13]))
    memory[26] = _wrapped(memory[26])


@njit
def _position(
    memory: NDArray,
    gains: NDArray,
    limits: NDArray,
    setpoint: NDArray,
    mode: NDArray,
    velocity_in_body: bool,
    state: NDArray,
    yaw: float,
) -> None:
    """Control position and velocity: write the wanted tilt and thrust, in axes that turn with yaw."""
    c, s = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
    vx, vy, vz = setpoint[3], setpoint[4], setpoint[5]
    if not velocity_in_body:
        vx, vy = vx * c + vy * s, vy * c - vx * s
    here_x, here_y = state[0] * c + state[1] * s, state[1] * c - state[0] * s
    if mode[MODE_X] == ABSOLUTE:
        vx = _pid(memory, gains, _X, setpoint[0] * c + setpoint[1] * s, here_x, _SLOW, False)
    if mode[MODE_Y] == ABSOLUTE:
        vy = _pid(memory, gains, _Y, setpoint[1] * c - setpoint[0] * s, here_y, _SLOW, False)
    if mode[MODE_Z] == ABSOLUTE:
        vz = _pid(memory, gains, _Z, setpoint[2], state[2], _SLOW, False)
    pitch = -_pid(memory, gains, _VX, vx, state[3] * c + state[4] * s, _SLOW, False)
    roll = -_pid(memory, gains, _VY, vy, state[4] * c - state[3] * s, _SLOW, False)
    memory[24] = min(max(roll, -limits[_MOST_ROLL]), limits[_MOST_ROLL])
    memory[25] = min(max(pitch, -limits[_MOST_PITCH]), limits[_MOST_PITCH])
    thrust = _pid(memory, gains, _VZ, vz, state[5], _SLOW, False) * _THRUST_SCALE + limits[_THRUST_BASE]
    memory[27] = min(max(thrust, limits[_THRUST_MIN]), FULL_COMMAND)


@register_jitable
def _rate(memory: NDArray, gains: NDArray, loop: int, wanted: float, measured: float) -> float:
    return min(max(_pid(memory, gains, loop, wanted, measured, _FAST, False), -_LARGEST), _LARGEST)


@register_jitable
def _pid(memory: NDArray, gains: NDArray, loop: int, wanted: float, measured: float, dt: float, angle: bool) -> float:
    error, change = wanted - measured, memory[LOOPS + loop] - measured
    if angle:
        error, change = _wrapped(error), _wrapped(change)
    limit = gains[loop, _INTEGRAL_LIMIT]
    memory[loop] = min(max(memory[loop] + error * dt, -limit), limit)
    memory[LOOPS + loop] = measured
    output = gains[loop, _KP] * error + gains[loop, _KI] * memory[loop] + gains[loop, _KD] * change / dt
    most = gains[loop, OUTPUT_LIMIT]
    return min(max(output, -most), most) if most != 0.0 else output


@register_jitable
def _wrapped(angle: float) -> float:
    """Wrap an angle into ±180 degrees."""
    return angle - 360.0 * np.floor((angle + 180.0) / 360.0)
