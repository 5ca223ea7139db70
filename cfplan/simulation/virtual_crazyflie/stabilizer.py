"""The stabilizer, compiled: sensors and body at 1 kHz, controller at 500 Hz on the estimate.

Nothing but the sensors and the recorder sees the true state; the controller flies on what the filter believes.
"""

from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.machine_code import njit
from cfplan.simulation.dynamics.body import (
    FLOOR,
    FULL_EFFICIENCY,
    STILL_AIR,
    TIME_STEP,
    at_rest,
    pack_body,
    step_body,
)
from cfplan.simulation.dynamics.kalman import Filter, estimate, reset, step_filter
from cfplan.simulation.dynamics.mellinger import (
    DISABLE,
    FULL_COMMAND,
    MODE_Z,
    distribute_power,
    level_out,
    step_mellinger,
)
from cfplan.simulation.virtual_crazyflie.pid import OUTPUT_LIMIT, OVERHEAD, default_gains, default_limits, step_pid
from cfplan.simulation.virtual_crazyflie.setpoints import THRUST, Setpoint
from cfplan.simulation.virtual_crazyflie.settings import Sensors, VehicleSettings
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.rotations import axes_of

# Where each flag lies in the array that `run` fills.
OFF_TICKS, OFF_IN_AIR_TICKS, RESETS = range(3)

IN_AIR = 0.05  # m above the floor; a landing ends a little above it
_NOISE_ROWS = 8191  # ms after which the sensors' noise repeats; a prime, so that it has no common period with anything


class Loop(NamedTuple):
    """Everything that the compiled loop reads and changes, in place: all but counts and noise are views of one array.

    To take a call's arguments apart, array by array, would cost more than the arithmetic of a millisecond.
    """

    truth: NDArray  # (17,) the body's state, see `body`
    kalman: Filter
    belief: NDArray  # (13,) estimated position, velocity, quaternion; body rate as measured
    acceleration: NDArray  # (3,) m/s², specific force as measured, body axes
    memory: NDArray  # (10,) of the Mellinger controller
    pid_memory: NDArray  # (36,) of the PID controller
    control: NDArray  # (4,)
    motors: NDArray  # (4,) 16-bit commands
    counts: NDArray  # OFF_TICKS, OFF_IN_AIR_TICKS, RESETS
    noise: NDArray  # (8191, 6) gyroscope rad/s, accelerometer m/s², biases included
    wind: NDArray  # (3,) m/s
    efficiency: NDArray  # (4,) share of its thrust that each motor gives
    override: NDArray  # (5,) motorPowerSet: whether its commands count, 2 and 3 the first for all; 16-bit commands
    idle: NDArray  # (1,) 16-bit command that no motor falls below while it may turn
    body: NDArray  # (19,) the body's parameters, see `body`
    prior: NDArray  # (16,) the filter's parameters, see `kalman`
    gains: NDArray  # (19,) of the Mellinger controller, see `mellinger`
    pid_gains: NDArray  # (12, 5) see `pid`
    pid_limits: NDArray  # (5,)


_FLOATS = 324  # of all parts together


@register_jitable
def _parts(floats: NDArray, counts: NDArray, noise: NDArray) -> Loop:
    """Return the parts of the array (324,) in their order."""
    return Loop(
        truth=floats[0:17],
        kalman=Filter(floats[17:26], floats[26:30], floats[30:111].reshape(9, 9), floats[111:118], floats[118:122]),
        belief=floats[122:135],
        acceleration=floats[135:138],
        memory=floats[138:148],
        pid_memory=floats[148:184],
        control=floats[184:188],
        motors=floats[188:192],
        counts=counts,
        noise=noise,
        wind=floats[192:195],
        efficiency=floats[195:199],
        override=floats[199:204],
        idle=floats[204:205],
        body=floats[205:224],
        prior=floats[224:240],
        gains=floats[240:259],
        pid_gains=floats[259:319].reshape(12, 5),
        pid_limits=floats[319:324],
    )


class Stabilizer:
    """The vehicle below the commander. `prior` (16,) and `gains` (19,) are those of the filter and the controller."""

    def __init__(self, airframe: Airframe, settings: VehicleSettings, prior: NDArray, gains: NDArray):
        position = np.array(settings.position, dtype=float)
        self._floats, self._counts = np.zeros(_FLOATS), np.zeros(3, dtype=np.int64)
        self._noise = _sensor_noise(settings.sensors, settings.seed)
        self.loop = loop = _parts(self._floats, self._counts, self._noise)
        loop.truth[:] = at_rest(position, settings.yaw)
        loop.acceleration[:] = 0.0, 0.0, GRAVITY
        loop.wind[:], loop.efficiency[:] = STILL_AIR, FULL_EFFICIENCY
        loop.body[:] = pack_body(airframe, floor=float(position[2]))
        loop.prior[:], loop.gains[:] = prior, gains
        loop.pid_gains[:], loop.pid_limits[:] = default_gains(), default_limits()
        self.mellinger = False  # which of the two controllers flies
        reset(loop.kalman, loop.prior)
        estimate(loop.kalman, loop.belief)
        self._per_command = airframe.motor_thrust_max / FULL_COMMAND  # N

    def reset_controller(self) -> None:
        """Clear the integrals, as the choice of another controller does."""
        self.loop.memory[:] = 0.0
        self.loop.pid_memory[:] = 0.0

    def limit_speed(self, axis: int, most: float) -> None:
        """Set the PID controller's largest speed along an axis, m/s."""
        self.loop.pid_gains[axis, OUTPUT_LIMIT] = (max(most, 0.5) if axis == 2 else most) * OVERHEAD

    def reset_estimator(self) -> None:
        """Reset the filter to the place that its parameters name."""
        reset(self.loop.kalman, self.loop.prior)

    def run(
        self, tick: int, ticks: int, setpoint: Setpoint, poses: NDArray, *, allowed: bool, level: bool, flying: bool
    ) -> None:
        """Advance from `tick` by `ticks` of 1 ms; `poses` (n, 9) as in `kalman`."""
        values, mode = setpoint.values, setpoint.mode
        if level:
            values, mode = values.copy(), mode.copy()
            level_out(values, mode)
        _run(
            self._floats, self._counts, self._noise, self.mellinger, values, mode, setpoint.velocity_in_body, poses,
            tick, ticks, allowed, flying, self._per_command,
            allowed and bool(mode[MODE_Z] != DISABLE or values[THRUST] > 0),
        )  # fmt: skip


def _sensor_noise(sensors: Sensors, seed: int) -> NDArray:
    chance = np.random.default_rng(seed)
    noise = np.empty((_NOISE_ROWS, 6))
    noise[:, :3] = chance.normal(chance.normal(0.0, sensors.gyro_bias, 3), sensors.gyro_noise, (_NOISE_ROWS, 3))
    noise[:, 3:] = chance.normal(
        chance.normal(0.0, sensors.acceleration_bias), sensors.acceleration_noise, (_NOISE_ROWS, 3)
    )
    return noise


@njit
def _run(
    floats: NDArray,
    counts: NDArray,
    noise: NDArray,
    mellinger: bool,
    setpoint: NDArray,
    mode: NDArray,
    velocity_in_body: bool,
    poses: NDArray,
    tick: int,
    ticks: int,
    allowed: bool,
    flying: bool,
    per_command: float,
    asked: bool,
) -> None:
    loop = _parts(floats, counts, noise)
    gyro, measured, thrusts = np.empty(3), np.empty(3), np.empty(4)
    none = poses[:0]
    for now in range(tick, tick + ticks):
        row = now % len(loop.noise)
        for axis in range(3):
            gyro[axis] = loop.truth[10 + axis] + loop.noise[row, axis]
            measured[axis] = loop.acceleration[axis] + loop.noise[row, 3 + axis]
            loop.belief[10 + axis] = gyro[axis]
        if not step_filter(loop.kalman, loop.prior, gyro, measured, poses if now == tick else none, now, flying):
            loop.counts[RESETS] += 1
        estimate(loop.kalman, loop.belief)

        if now % 2 == 0:
            if mellinger:
                step_mellinger(loop.control, loop.memory, loop.gains, setpoint, mode, loop.belief)
            else:
                step_pid(
                    loop.control, loop.pid_memory, loop.pid_gains, loop.pid_limits, setpoint, mode, velocity_in_body,
                    loop.belief, now,
                )  # fmt: skip
            distribute_power(loop.control, loop.motors)
        _drive(loop, thrusts, allowed, per_command, asked)


@njit(allocates=False)
def _drive(loop: Loop, thrusts: NDArray, allowed: bool, per_command: float, asked: bool) -> None:
    """Turn the motors, move the body, and note what its accelerometer measures.

    Motors count as off if nothing asks them to turn, not if the controller wants no thrust for a moment.
    """
    off = True
    for motor in range(4):
        if allowed and not loop.motors[motor] > loop.idle[0]:
            loop.motors[motor] = loop.idle[0]
        if loop.override[0] > 0.0:
            loop.motors[motor] = loop.override[1 + motor if loop.override[0] == 1.0 else 1]
        if not (allowed and loop.motors[motor] > 0.0):  # NaN is off too, as its cast to an integer is
            loop.motors[motor] = 0.0
        off = off and loop.motors[motor] == 0.0
        thrusts[motor] = loop.motors[motor] * per_command
    if off and not asked:
        loop.counts[OFF_TICKS] += 1
        if loop.truth[2] > loop.body[FLOOR] + IN_AIR:
            loop.counts[OFF_IN_AIR_TICKS] += 1
    vx, vy, vz = loop.truth[3], loop.truth[4], loop.truth[5]
    step_body(loop.truth, thrusts, loop.body, loop.wind, loop.efficiency)
    fx, fy = (loop.truth[3] - vx) / TIME_STEP, (loop.truth[4] - vy) / TIME_STEP
    fz = (loop.truth[5] - vz) / TIME_STEP + GRAVITY
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = axes_of(loop.truth[6], loop.truth[7], loop.truth[8], loop.truth[9])
    loop.acceleration[0] = xx * fx + xy * fy + xz * fz
    loop.acceleration[1] = yx * fx + yy * fy + yz * fz
    loop.acceleration[2] = zx * fx + zy * fy + zz * fz
