"""The firmware's stabilizer, compiled: filter at 1 kHz, controller at 500 Hz on the estimate."""

from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.machine_code import njit
from cfplan.simulation.engine.kalman import Filter, estimate, reset, step_filter
from cfplan.simulation.engine.layout import MEMORY, MEMORY_SIZE, SETPOINT, SETPOINT_SIZE
from cfplan.simulation.engine.mellinger import (
    CONTROL_PERIOD,
    DISABLE,
    MODE_Z,
    level_out,
    mixed,
    step_mellinger,
)
from cfplan.simulation.engine.pid import OUTPUT_LIMIT, OVERHEAD, default_gains, default_limits, step_pid
from cfplan.simulation.virtual_crazyflie.setpoints import THRUST, Setpoint
from cfplan.vehicle.airframe import GRAVITY

# Indices in the array of integers: the setpoint's modes, and the switches.
_MODE, _IN_BODY, _ALLOWED, _FLYING, _ASKED, _MELLINGER, _NUMBERS = 0, 7, 8, 9, 10, 11, 12
_CONTROLLER_SIZE = SETPOINT + SETPOINT_SIZE


class Loop(NamedTuple):
    """The state of the compiled loop, changed in place: views of one array of floats, and the integers.

    Unpacking the arguments of a call array by array would cost more than the arithmetic of a millisecond.
    """

    controller: NDArray  # (51,) as in `engine.layout`, of which it uses the Mellinger controller and the setpoint
    kalman: Filter
    belief: NDArray  # (13,) estimated position, velocity, quaternion; body rate as measured
    acceleration: NDArray  # (3,) m/s², specific force as measured, without vibration, body axes
    pid_memory: NDArray  # (36,) of the PID controller
    control: NDArray  # (4,)
    motors: NDArray  # (4,) 16-bit commands
    override: NDArray  # (5,) motorPowerSet: whether its commands count, 2 and 3 the first for all; 16-bit commands
    idle: NDArray  # (1,) 16-bit command that no motor falls below while it may turn
    prior: NDArray  # (16,) the filter's parameters, see `kalman`
    gains: NDArray  # (19,) of the Mellinger controller, see `mellinger`
    pid_gains: NDArray  # (12, 5) see `pid`
    pid_limits: NDArray  # (5,)
    switches: NDArray  # (12,) int: the setpoint's modes, and the other inputs of the next run


_FLOATS = _CONTROLLER_SIZE + 271  # of all parts together


@register_jitable
def _parts(floats: NDArray, switches: NDArray) -> Loop:
    """Return the parts of the array in their order."""
    more = floats[_CONTROLLER_SIZE:]
    return Loop(
        controller=floats[:_CONTROLLER_SIZE],
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
        switches=switches,
    )


class Stabilizer:
    """The firmware below the commander. `prior` (16,) and `gains` (19,) are those of the filter and the controller."""

    def __init__(self, prior: NDArray, gains: NDArray):
        self._floats, self._switches = np.zeros(_FLOATS), np.zeros(_NUMBERS, dtype=np.int64)
        self.loop = loop = _parts(self._floats, self._switches)
        loop.acceleration[:] = 0.0, 0.0, GRAVITY
        loop.prior[:], loop.gains[:] = prior, gains
        loop.pid_gains[:], loop.pid_limits[:] = default_gains(), default_limits()
        self.mellinger = False  # which of the two controllers flies
        self._setpoint: Setpoint | None = None
        self._inputs: tuple[bool, ...] = ()  # with the setpoint, of the last run
        reset(loop.kalman, loop.prior)
        estimate(loop.kalman, loop.belief)

    def reset_controller(self) -> None:
        """Clear the integrals, as the choice of another controller does."""
        self.loop.controller[MEMORY : MEMORY + MEMORY_SIZE] = 0.0
        self.loop.pid_memory[:] = 0.0

    def limit_speed(self, axis: int, most: float) -> None:
        """Set the PID controller's largest speed along an axis, m/s."""
        self.loop.pid_gains[axis, OUTPUT_LIMIT] = (max(most, 0.5) if axis == 2 else most) * OVERHEAD

    def reset_estimator(self) -> None:
        """Reset the filter to the place that its parameters name."""
        reset(self.loop.kalman, self.loop.prior)

    def set(self, setpoint: Setpoint, *, allowed: bool, level: bool, flying: bool) -> None:
        """Set the inputs of the runs that follow."""
        inputs = allowed, level, flying, self.mellinger
        if setpoint is self._setpoint and inputs == self._inputs:
            return
        self._setpoint, self._inputs = setpoint, inputs
        values, mode = self.loop.controller[SETPOINT:], self._switches[_MODE:_IN_BODY]
        values[:], mode[:] = setpoint.values, setpoint.mode
        if level:
            level_out(values, mode)
        asked = allowed and bool(mode[MODE_Z] != DISABLE or values[THRUST] > 0)
        self._switches[_IN_BODY:] = setpoint.velocity_in_body, allowed, flying, asked, self.mellinger

    def run(self, tick: int, gyroscope: NDArray, accelerometer: NDArray, poses: NDArray) -> NDArray | None:
        """Run for the millisecond `tick`; return the motors' commands, (4,) 16 bits, None if there is no command.

        `gyroscope` (3,) rad/s and `accelerometer` (3,) m/s² as measured; `poses` (n, 9) as in `kalman`.
        """
        turn = _run(self._floats, self._switches, gyroscope, accelerometer, poses, tick)
        return self.loop.motors if turn else None


@njit(error_model="numpy")
def _run(
    floats: NDArray, switches: NDArray, gyroscope: NDArray, accelerometer: NDArray, poses: NDArray, tick: int
) -> bool:
    """Step filter and controller; return whether any motor turns, or is asked to."""
    loop = _parts(floats, switches)
    loop.belief[10:13] = gyroscope
    step_filter(loop.kalman, loop.prior, gyroscope, accelerometer, poses, tick, loop.switches[_FLYING] != 0)
    estimate(loop.kalman, loop.belief)
    if tick % 2 == 0:
        _control(loop, tick)
    return _drive(loop)


@register_jitable
def _control(loop: Loop, now: int) -> None:
    """Step the active controller on the filter's estimate."""
    mode = loop.switches[_MODE:_IN_BODY]
    if loop.switches[_MELLINGER]:
        control = step_mellinger(loop.controller, loop.gains, mode, loop.belief, CONTROL_PERIOD)
        loop.control[0], loop.control[1], loop.control[2], loop.control[3] = control
    else:
        setpoint, in_body = loop.controller[SETPOINT : SETPOINT + SETPOINT_SIZE], loop.switches[_IN_BODY] != 0
        step_pid(
            loop.control, loop.pid_memory, loop.pid_gains, loop.pid_limits, setpoint, mode, in_body, loop.belief, now
        )  # fmt: skip
    commands = mixed((loop.control[0], loop.control[1], loop.control[2], loop.control[3]))
    loop.motors[0], loop.motors[1], loop.motors[2], loop.motors[3] = commands


@register_jitable
def _drive(loop: Loop) -> bool:
    """Command the motors; return whether any turns, or is asked to.

    Motors count as off if nothing asks them to turn, not if the controller wants no thrust for a moment.
    """
    turn, allowed = loop.switches[_ASKED] != 0, loop.switches[_ALLOWED] != 0
    for motor in range(4):
        if allowed and not loop.motors[motor] > loop.idle[0]:
            loop.motors[motor] = loop.idle[0]
        if not (allowed and loop.motors[motor] > 0.0):  # NaN is off too, as its cast to an integer is
            loop.motors[motor] = 0.0
        if loop.override[0] > 0.0:  # by the motor driver: also where the supervisor lets no motor turn
            loop.motors[motor] = loop.override[1 + motor if loop.override[0] == 1.0 else 1]
        turn = turn or loop.motors[motor] != 0.0
    return turn
