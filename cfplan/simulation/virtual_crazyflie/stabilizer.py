"""The stabilizer, compiled: sensors and body at 1 kHz, controller at 500 Hz on the estimate.

Nothing but the sensors and the recorder sees the true state; the controller flies on what the filter believes.
"""

from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.machine_code import njit
from cfplan.simulation.engine.body import TIME_STEP, step_and_feel
from cfplan.simulation.engine.kalman import Filter, estimate, reset, step_filter
from cfplan.simulation.engine.layout import (
    AIRFRAME,
    ASKED,
    EFFICIENCY,
    FLOOR,
    MEMORY,
    MEMORY_SIZE,
    SETPOINT,
    SETPOINT_SIZE,
    STATE_SIZE,
    VEHICLE_SIZE,
    WIND,
    at_rest,
    pack_airframe,
)
from cfplan.simulation.engine.mellinger import (
    CONTROL_PERIOD,
    DISABLE,
    FULL_COMMAND,
    MODE_Z,
    level_out,
    mixed,
    step_mellinger,
)
from cfplan.simulation.engine.pid import OUTPUT_LIMIT, OVERHEAD, default_gains, default_limits, step_pid
from cfplan.simulation.virtual_crazyflie.setpoints import THRUST, Setpoint
from cfplan.simulation.virtual_crazyflie.settings import Sensors, VehicleSettings
from cfplan.vehicle.airframe import GRAVITY, Airframe

# Indices in the array of integers: counts, the setpoint's modes, and the inputs of the next run.
OFF_TICKS, OFF_IN_AIR_TICKS, RESETS = range(3)
_MODE, _IN_BODY, _ALLOWED, _FLYING, _ASKED, _MELLINGER, _NUMBERS = 3, 10, 11, 12, 13, 14, 15

IN_AIR = 0.05  # m above the floor; a landing ends a little above it
_NOISE_ROWS = 8191  # ms after which the sensors' noise repeats; a prime, so that it has no common period with anything


class Loop(NamedTuple):
    """Everything that the compiled loop reads and changes, in place: views of one array of numbers, but for noise and
    whole numbers.

    To take a call's arguments apart, array by array, would cost more than the arithmetic of a millisecond.
    """

    vehicle: NDArray  # (77,) as in `engine.layout`: body, Mellinger controller, setpoint, airframe
    truth: NDArray  # (17,) of that the body's state
    wind: NDArray  # (3,) m/s, of that
    efficiency: NDArray  # (4,) fraction of its thrust that each motor gives, of that
    kalman: Filter
    belief: NDArray  # (13,) estimated position, velocity, quaternion; body rate as measured
    acceleration: NDArray  # (3,) m/s², specific force as measured, body axes
    pid_memory: NDArray  # (36,) of the PID controller
    control: NDArray  # (4,)
    motors: NDArray  # (4,) 16-bit commands
    override: NDArray  # (5,) motorPowerSet: whether its commands count, 2 and 3 the first for all; 16-bit commands
    idle: NDArray  # (1,) 16-bit command that no motor falls below while it may turn
    prior: NDArray  # (16,) the filter's parameters, see `kalman`
    gains: NDArray  # (19,) of the Mellinger controller, see `mellinger`
    pid_gains: NDArray  # (12, 5) see `pid`
    pid_limits: NDArray  # (5,)
    counts: NDArray  # (15,) int: OFF_TICKS, OFF_IN_AIR_TICKS, RESETS, and the inputs of the next run
    noise: NDArray  # (8191, 6) gyroscope rad/s, accelerometer m/s², biases included


_FLOATS = VEHICLE_SIZE + 271  # of all parts together


@register_jitable
def _parts(floats: NDArray, counts: NDArray, noise: NDArray) -> Loop:
    """Return the parts of the array in their order."""
    more = floats[VEHICLE_SIZE:]
    return Loop(
        vehicle=floats[:VEHICLE_SIZE],
        truth=floats[:STATE_SIZE],
        wind=floats[WIND : WIND + 3],
        efficiency=floats[EFFICIENCY : EFFICIENCY + 4],
        kalman=Filter(more[0:9], more[9:13], more[13:94].reshape(9, 9), more[94:101], more[101:105]),
        belief=more[105:118],
        acceleration=more[118:121],
        pid_memory=more[121:157],
        control=more[157:161],
        motors=more[161:165],
        override=more[165:170],
        idle=more[170:171],
        prior=more[171:187],
        gains=more[187:206],
        pid_gains=more[206:266].reshape(12, 5),
        pid_limits=more[266:271],
        counts=counts,
        noise=noise,
    )


class Stabilizer:
    """The vehicle below the commander. `prior` (16,) and `gains` (19,) are those of the filter and the controller."""

    def __init__(self, airframe: Airframe, settings: VehicleSettings, prior: NDArray, gains: NDArray):
        position = np.array(settings.position, dtype=float)
        self._floats, self._counts = np.zeros(_FLOATS), np.zeros(_NUMBERS, dtype=np.int64)
        self._noise = _sensor_noise(settings.sensors, settings.seed)
        self.loop = loop = _parts(self._floats, self._counts, self._noise)
        loop.truth[:] = at_rest(position, settings.yaw)
        loop.acceleration[:] = 0.0, 0.0, GRAVITY
        loop.vehicle[AIRFRAME:] = pack_airframe(airframe, floor=float(position[2]))
        loop.prior[:], loop.gains[:] = prior, gains
        loop.pid_gains[:], loop.pid_limits[:] = default_gains(), default_limits()
        self.mellinger = False  # which of the two controllers flies
        self._per_command = airframe.motor_thrust_max / FULL_COMMAND  # N
        reset(loop.kalman, loop.prior)
        estimate(loop.kalman, loop.belief)

    def reset_controller(self) -> None:
        """Clear the integrals, as the choice of another controller does."""
        self.loop.vehicle[MEMORY : MEMORY + MEMORY_SIZE] = 0.0
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
        values, mode = self.loop.vehicle[SETPOINT : SETPOINT + SETPOINT_SIZE], self._counts[_MODE:_IN_BODY]
        values[:], mode[:] = setpoint.values, setpoint.mode
        if level:
            level_out(values, mode)
        asked = allowed and bool(mode[MODE_Z] != DISABLE or values[THRUST] > 0)
        self._counts[_IN_BODY:] = setpoint.velocity_in_body, allowed, flying, asked, self.mellinger
        _run(self._floats, self._counts, self._noise, poses, tick, ticks, self._per_command)


def _sensor_noise(sensors: Sensors, seed: int) -> NDArray:
    chance = np.random.default_rng(seed)
    noise = np.empty((_NOISE_ROWS, 6))
    noise[:, :3] = chance.normal(chance.normal(0.0, sensors.gyro_bias, 3), sensors.gyro_noise, (_NOISE_ROWS, 3))
    noise[:, 3:] = chance.normal(
        chance.normal(0.0, sensors.acceleration_bias), sensors.acceleration_noise, (_NOISE_ROWS, 3)
    )
    return noise


@njit(error_model="numpy")
def _run(
    floats: NDArray, counts: NDArray, noise: NDArray, poses: NDArray, tick: int, ticks: int, per_command: float
) -> None:  # seven, as numba knows no objects
    loop = _parts(floats, counts, noise)
    gyro, measured = np.empty(3), np.empty(3)
    none, flying = poses[:0], loop.counts[_FLYING] != 0
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
            _control(loop, now)
        _drive(loop, per_command)


@register_jitable
def _control(loop: Loop, now: int) -> None:
    """Step the active controller on the filter's estimate."""
    mode = loop.counts[_MODE:_IN_BODY]
    if loop.counts[_MELLINGER]:
        control = step_mellinger(loop.vehicle, loop.gains, mode, loop.belief, CONTROL_PERIOD)
        loop.control[0], loop.control[1], loop.control[2], loop.control[3] = control
    else:
        setpoint, in_body = loop.vehicle[SETPOINT : SETPOINT + SETPOINT_SIZE], loop.counts[_IN_BODY] != 0
        step_pid(
            loop.control, loop.pid_memory, loop.pid_gains, loop.pid_limits, setpoint, mode, in_body, loop.belief, now
        )  # fmt: skip
    commands = mixed((loop.control[0], loop.control[1], loop.control[2], loop.control[3]))
    loop.motors[0], loop.motors[1], loop.motors[2], loop.motors[3] = commands


@njit(allocates=False)
def _drive(loop: Loop, per_command: float) -> None:
    """Turn the motors, move the body, and note what its accelerometer measures.

    Motors count as off if nothing asks them to turn, not if the controller wants no thrust for a moment.
    """
    off, allowed, vehicle = True, loop.counts[_ALLOWED] != 0, loop.vehicle
    for motor in range(4):
        if allowed and not loop.motors[motor] > loop.idle[0]:
            loop.motors[motor] = loop.idle[0]
        if not (allowed and loop.motors[motor] > 0.0):  # NaN is off too, as its cast to an integer is
            loop.motors[motor] = 0.0
        if loop.override[0] > 0.0:  # by the motor driver: also where the supervisor lets no motor turn
            loop.motors[motor] = loop.override[1 + motor if loop.override[0] == 1.0 else 1]
        off = off and loop.motors[motor] == 0.0
        vehicle[ASKED + motor] = loop.motors[motor] * per_command
    if off and loop.counts[_ASKED] == 0:
        loop.counts[OFF_TICKS] += 1
        if vehicle[2] > vehicle[FLOOR] + IN_AIR:
            loop.counts[OFF_IN_AIR_TICKS] += 1
    step_and_feel(vehicle, TIME_STEP, loop.acceleration)
