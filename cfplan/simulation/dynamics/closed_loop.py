"""The closed loop of setpoints, controller and body, compiled: what the vehicle does with the bytes that it is sent.

At each millisecond, in this order: the newest setpoint that has arrived; every second time the controller, on the
estimate as it is now; the body. The firmware's recorded flights were made the same way.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.firmware import MellingerGains, gains_for
from cfplan.flight.setpoints.packets import FullStateSetpoints
from cfplan.machine_code import njit
from cfplan.simulation.dynamics.body import (
    BODY_RATE,
    FULL_EFFICIENCY,
    MOTORS,
    POSITION,
    QUATERNION,
    STATE_SIZE,
    STILL_AIR,
    THRUST_MAX,
    TIME_STEP,
    VELOCITY,
    pack_body,
    step_body,
)
from cfplan.simulation.dynamics.branching import STEPS_A_CONTROL, setpoint_rows
from cfplan.simulation.dynamics.mellinger import (
    FULL_COMMAND,
    FULL_STATE,
    MEMORY_SIZE,
    distribute_power,
    step_mellinger,
)
from cfplan.vehicle.airframe import Airframe


@dataclass(frozen=True, slots=True)
class EstimateErrors:
    """Errors of the controller's estimate of position and velocity; its attitude and body rate are exact."""

    latency: float = 0.0  # s by which position and velocity are late
    position_noise: float = 0.0  # m, standard deviation, anew each 10 ms
    velocity_noise: float = 0.0  # m/s, standard deviation, anew each 10 ms
    seed: int = 0


PERFECT = EstimateErrors()


@dataclass(frozen=True, slots=True)
class ClosedLoop:
    """The vehicle's motion, every millisecond from the start to the end."""

    time: NDArray  # (N,) s
    states: NDArray  # (N, 17) as in `body`
    commands: NDArray  # (N, 4) what the controller asked of each motor, 16-bit units

    @property
    def position(self) -> NDArray:
        """Return the position, (N, 3) m."""
        return self.states[:, POSITION]

    @property
    def velocity(self) -> NDArray:
        """Return the velocity, (N, 3) m/s."""
        return self.states[:, VELOCITY]

    @property
    def quaternion(self) -> NDArray:
        """Return the attitude, (N, 4) body→world, x y z w."""
        return self.states[:, QUATERNION]

    @property
    def body_rate(self) -> NDArray:
        """Return the body rates, (N, 3) rad/s."""
        return self.states[:, BODY_RATE]

    @property
    def motor_thrust(self) -> NDArray:
        """Return the motor thrusts, (N, 4) N."""
        return self.states[:, MOTORS]


def fly_setpoints(
    setpoints: FullStateSetpoints,
    times: NDArray,
    airframe: Airframe,
    start: NDArray,
    *,
    duration: float,
    gains: MellingerGains | None = None,
    floor: float = 0.0,
    delay: float = 0.0,
    estimate: EstimateErrors = PERFECT,
    wind: NDArray = STILL_AIR,
    efficiency: NDArray = FULL_EFFICIENCY,
    memory: NDArray | None = None,
) -> ClosedLoop:
    """Fly full states that arrive at `times` + `delay`, (N,) s, as fly_rows() flies them."""
    return fly_rows(
        setpoint_rows(setpoints), FULL_STATE, times, airframe, start, duration=duration, gains=gains, floor=floor,
        delay=delay, estimate=estimate, wind=wind, efficiency=efficiency, memory=memory,
    )  # fmt: skip


def fly_rows(
    rows: NDArray,
    mode: NDArray,
    times: NDArray,
    airframe: Airframe,
    start: NDArray,
    *,
    duration: float,
    gains: MellingerGains | None = None,
    floor: float = 0.0,
    delay: float = 0.0,
    estimate: EstimateErrors = PERFECT,
    wind: NDArray = STILL_AIR,
    efficiency: NDArray = FULL_EFFICIENCY,
    memory: NDArray | None = None,
) -> ClosedLoop:
    """Fly setpoints as `mellinger` has them, (N, 20) in a mode (7,), from the state `start`, (17,), for `duration` s.

    They arrive at `times` + `delay`, (N,) s; until the first does, the controller holds the first. `gains` are the
    airframe's where not given; `wind` (3,) m/s and motor `efficiency` (4,) are constant. `memory`, (10,), is the
    controller's at the start, zeros where not given.
    """
    steps = round(duration / TIME_STEP)
    arrivals = np.round((np.asarray(times) + delay) / TIME_STEP).astype(np.int64)
    noise = np.zeros((steps + 1, 6)) if estimate is PERFECT else _noise(estimate, steps)
    states = np.empty((steps + 1, STATE_SIZE))
    states[0] = start
    commands = np.empty((steps + 1, 4))
    _run(
        states,
        commands,
        rows,
        arrivals,
        (gains or gains_for(airframe)).pack(),
        pack_body(airframe, floor=floor),
        round(estimate.latency / TIME_STEP),
        noise,
        np.asarray(wind, dtype=float),
        np.asarray(efficiency, dtype=float),
        mode,
        np.zeros(MEMORY_SIZE) if memory is None else memory.copy(),
    )
    return ClosedLoop(np.arange(steps + 1) * TIME_STEP, states, commands)


def _noise(estimate: EstimateErrors, steps: int) -> NDArray:
    """Return (M, 6), M > steps: errors of position, m, and velocity, m/s, for each millisecond."""
    random = np.random.default_rng(estimate.seed)
    noise = np.repeat(random.normal(size=(steps // 10 + 1, 6)), 10, axis=0)
    noise *= np.repeat([estimate.position_noise, estimate.velocity_noise], 3)
    return noise


@njit(nogil=True)
def _run(
    states: NDArray,
    commands: NDArray,
    setpoints: NDArray,
    arrivals: NDArray,
    gains: NDArray,
    body: NDArray,
    latency: int,
    noise: NDArray,
    wind: NDArray,
    efficiency: NDArray,
    mode: NDArray,
    memory: NDArray,
) -> None:
    control = np.zeros(4)
    motors, thrusts = np.zeros(4), np.zeros(4)
    believed, state = np.empty(STATE_SIZE), states[0].copy()
    newest = 0
    scale = body[THRUST_MAX] / FULL_COMMAND
    for step in range(len(states)):
        for k in range(STATE_SIZE):
            states[step, k] = state[k]
        while newest + 1 < len(arrivals) and arrivals[newest + 1] <= step:
            newest += 1
        if step % STEPS_A_CONTROL == 0:
            for k in range(STATE_SIZE):
                believed[k] = state[k]
            for k in range(6):
                believed[k] = states[max(step - latency, 0), k] + noise[step, k]
            step_mellinger(control, memory, gains, setpoints[newest], mode, believed)
            distribute_power(control, motors)
            for k in range(4):
                thrusts[k] = motors[k] * scale
        for k in range(4):
            commands[step, k] = motors[k]
        step_body(state, thrusts, body, wind, efficiency)
