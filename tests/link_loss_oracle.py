"""Link loss step by step at 1 kHz, with the controller at its own rate, from the last setpoint to the floor."""

from dataclasses import replace

import numpy as np

from cfplan.flight.firmware import gains_for
from cfplan.flight.setpoints.packets import FullStateSetpoints, decode
from cfplan.simulation.dynamics.body import FULL_EFFICIENCY, STILL_AIR, THRUST_MAX, hovering, pack_body, step_body
from cfplan.simulation.dynamics.closed_loop import fly_setpoints
from cfplan.simulation.dynamics.mellinger import (
    FULL_COMMAND,
    FULL_STATE,
    MEMORY_SIZE,
    SETPOINT_SIZE,
    distribute_power,
    level_out,
    step_mellinger,
)
from cfplan.vehicle.rotations import yaw_of


def fly_on(payloads, airframe, last: int, *, lag: float, level_after=540, off_after=2040, longest=4000) -> np.ndarray:
    """Return the places, (M, 3) m at 1 kHz, after the setpoint `last` of a flight, (N, 29), has arrived."""
    airframe, state = replace(airframe, motor_time_constant=lag), decode(payloads)
    before = FullStateSetpoints(*(getattr(state, name)[: last + 1] for name in state.__slots__))
    start = hovering(airframe, state.position[0], float(yaw_of(state.quaternion[0])))
    flown = fly_setpoints(before, np.arange(last + 1) / 100.0, airframe, start, duration=last / 100.0)
    now, thrusts, body = flown.states[-1].copy(), np.zeros(4), pack_body(airframe)
    memory, gains, mode = np.zeros(MEMORY_SIZE), gains_for(airframe).pack(), FULL_STATE.copy()
    setpoint = np.zeros(SETPOINT_SIZE)
    fields = (state.position, state.velocity, state.acceleration, state.quaternion, state.body_rate)
    setpoint[:16] = np.concatenate([field[last] for field in fields])
    memory[6:10] = [now[10], -now[11], setpoint[13], -setpoint[14]]  # the integrals are small, the rates are not
    control, motors, places = np.zeros(4), np.zeros(4), []
    for step in range(longest):
        if step == level_after:
            level_out(setpoint, mode)
        if step >= off_after:
            thrusts[:] = 0.0
        elif step % 2 == 0:
            step_mellinger(control, memory, gains, setpoint, mode, now)
            distribute_power(control, motors)
            thrusts[:] = motors * (body[THRUST_MAX] / FULL_COMMAND)
        step_body(now, thrusts, body, STILL_AIR, FULL_EFFICIENCY)
        places.append(now[:3].copy())
        if step > off_after and now[2] <= 0.0:
            break
    return np.array(places)
