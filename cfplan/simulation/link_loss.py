"""Link loss: where the vehicle goes by itself when its pilot or its radio dies, by the firmware's own time-outs.

It holds the last setpoint, then its supervisor levels it out at that height, then it stops the motors. While it levels
out, the controller keeps the body rates of that last setpoint, so a vehicle that was about to turn never gets quite
level and may speed up. Where it comes down depends on the moment, and is found by simulating it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.firmware import Timeouts, gains_for
from cfplan.flight.setpoints.encoding import RATE
from cfplan.flight.setpoints.packets import decode
from cfplan.machine_code import njit
from cfplan.safety.limits import Limits
from cfplan.simulation.dynamics.body import (
    FULL_EFFICIENCY,
    STILL_AIR,
    THRUST_MAX,
    TIME_STEP,
    hovering,
    pack_body,
    step_body,
)
from cfplan.simulation.dynamics.mellinger import (
    CONTROL_PERIOD,
    FULL_COMMAND,
    FULL_STATE,
    MEMORY_SIZE,
    SETPOINT_SIZE,
    distribute_power,
    level_out,
    step_mellinger,
)
from cfplan.vehicle.rotations import yaw_of

# s after the last setpoint; the same in every firmware that may fly, see flight/firmware.py
LEVEL_AFTER, OFF_AFTER = Timeouts().level_out_at_latest, Timeouts().motors_off_at_latest
OFF_BY_WATCHDOG = Timeouts().keep_alive  # if the emergency-stop watchdog is enabled
_LONGEST = 4.0  # s that are simulated after the last setpoint, unless the vehicle lies on the floor before
_MOMENTS = 48  # at which the link is lost
_STEPS_A_CONTROL = round(CONTROL_PERIOD / TIME_STEP)


@dataclass(frozen=True, slots=True)
class LinkLoss:
    """The worst moment to lose the link, and where the vehicle goes from there."""

    moment: float  # s from the first setpoint
    distance: float  # m, horizontally from the last setpoint to the far corner of the box that the vehicle sweeps
    beyond: float  # m beyond the walls or the ceiling; negative inside

    def __str__(self) -> str:
        walls = f"{self.beyond:.1f} m beyond the walls" if self.beyond > 0 else "inside the walls"
        return f"at the worst moment, {self.moment:.1f} s, it comes down {self.distance:.1f} m on, {walls}"


def simulate_link_loss(payloads: NDArray, limits: Limits, rate: float = RATE) -> LinkLoss:
    """Lose the link at moments all along a flight, (N, 29) uint8 at `rate`, Hz; return what ends farthest out."""
    moments = np.linspace(0.0, (len(payloads) - 1) / rate, _MOMENTS)
    places, swept = swept_after_link_loss(payloads, limits, moments, rate)
    low, high = np.array(limits.space.low), np.array(limits.space.high)
    low[2] = -np.inf  # it ends on the floor
    beyond = np.maximum(low - swept[:, 0], swept[:, 1] - high).max(axis=1)
    away = np.abs(swept[:, :, :2] - places[:, None, :2]).max(axis=1)
    worst = int(np.argmax(beyond))
    return LinkLoss(float(moments[worst]), float(np.hypot(*away[worst])), float(beyond[worst]))


def swept_after_link_loss(
    payloads: NDArray, limits: Limits, moments: NDArray, rate: float = RATE
) -> tuple[NDArray, NDArray]:
    """Return the last setpoint's place, (K, 3) m, and the box swept after it, (K, 2, 3) m, for each moment, (K,) s.

    Moments must rise. The vehicle's estimate is taken to be perfect, although no pose comes either.
    """
    state, airframe = decode(payloads), limits.airframe
    rows = np.zeros((len(payloads), SETPOINT_SIZE))
    rows[:, 0:16] = np.hstack([state.position, state.velocity, state.acceleration, state.quaternion, state.body_rate])
    arrivals = np.round(np.arange(len(payloads)) / (rate * TIME_STEP)).astype(np.int64)
    steps = np.round(moments / TIME_STEP).astype(np.int64)
    swept = np.empty((len(steps), 2, 3))
    _run(
        swept,
        steps,
        hovering(airframe, state.position[0], float(yaw_of(state.quaternion[0]))),
        rows,
        arrivals,
        gains_for(airframe).pack(),
        pack_body(airframe),
        round(LEVEL_AFTER / TIME_STEP),
        round((OFF_BY_WATCHDOG if limits.firmware.watchdog else OFF_AFTER) / TIME_STEP),
        round(_LONGEST / TIME_STEP),
    )
    last = np.maximum(np.searchsorted(arrivals, steps) - 1, 0)
    return state.position[last], swept


@njit
def _control_and_move(
    step: int,
    state: NDArray,
    memory: NDArray,
    thrusts: NDArray,
    gains: NDArray,
    setpoint: NDArray,
    mode: NDArray,
    body: NDArray,
    wind: NDArray,
    efficiency: NDArray,
) -> None:
    if step % _STEPS_A_CONTROL == 0:
        control, motors = np.zeros(4), np.zeros(4)
        step_mellinger(control, memory, gains, setpoint, mode, state)
        distribute_power(control, motors)
        for k in range(4):
            thrusts[k] = motors[k] * (body[THRUST_MAX] / FULL_COMMAND)
    step_body(state, thrusts, body, wind, efficiency)


@njit
def _run(
    swept: NDArray,
    moments: NDArray,
    start: NDArray,
    setpoints: NDArray,
    arrivals: NDArray,
    gains: NDArray,
    body: NDArray,
    level_after: int,
    off_after: int,
    longest: int,
) -> None:
    state, memory, thrusts = start.copy(), np.zeros(MEMORY_SIZE), np.zeros(4)
    flying, wind, efficiency = FULL_STATE.copy(), STILL_AIR.copy(), FULL_EFFICIENCY.copy()
    newest, flown = 0, 0
    for number in range(len(moments)):
        for step in range(flown, moments[number]):
            while newest + 1 < len(arrivals) and arrivals[newest + 1] <= step:
                newest += 1
            _control_and_move(step, state, memory, thrusts, gains, setpoints[newest], flying, body, wind, efficiency)
        flown = moments[number]
        alone, mode, last = state.copy(), flying.copy(), setpoints[newest].copy()
        its_memory, its_thrusts = memory.copy(), thrusts.copy()
        for k in range(3):
            swept[number, 0, k], swept[number, 1, k] = alone[k], alone[k]
        for after in range(longest):
            if after == level_after:
                level_out(last, mode)
            if after < off_after:
                now = flown + after
                _control_and_move(now, alone, its_memory, its_thrusts, gains, last, mode, body, wind, efficiency)
            else:
                for k in range(4):
                    its_thrusts[k] = 0.0
                step_body(alone, its_thrusts, body, wind, efficiency)
            for k in range(3):
                if not swept[number, 0, k] <= alone[k]:  # so that what is no number is taken over
                    swept[number, 0, k] = alone[k]
                if not swept[number, 1, k] >= alone[k]:
                    swept[number, 1, k] = alone[k]
            if after > off_after and alone[2] <= 0.0:
                break
