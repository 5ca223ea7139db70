"""Link loss step by step at 1 kHz, with the controller at its own rate, from the last setpoint to the floor."""

from dataclasses import replace

import numpy as np

from cfplan.flight.firmware import gains_for
from cfplan.flight.setpoints.packets import FullStateSetpoints, decode
from cfplan.simulation.engine.body import TIME_STEP, step_body
from cfplan.simulation.engine.flight import fly_setpoints
from cfplan.simulation.engine.layout import (
    ASKED,
    MEMORY,
    SETPOINT,
    SETPOINT_SIZE,
    hovering,
    new_vehicle,
    pack_airframe,
    setpoint_rows,
)
from cfplan.simulation.engine.mellinger import FULL_STATE, LEVEL_OUT, fly_mellinger
from cfplan.vehicle.rotations import yaw_of


def fly_on(payloads, airframe, last: int, *, lag: float, level_after=540, off_after=2040, longest=4000) -> np.ndarray:
    """Return the places, (M, 3) m at 1 kHz, after the setpoint `last` of a flight, (N, 29), has arrived."""
    airframe, state = replace(airframe, motor_time_constant=lag), decode(payloads)
    before = FullStateSetpoints(*(getattr(state, name)[: last + 1] for name in state.__slots__))
    start = hovering(airframe, state.position[0], float(yaw_of(state.quaternion[0])))
    flown = fly_setpoints(before, np.arange(last + 1) / 100.0, airframe, start, duration=last / 100.0)
    vehicle, mode = new_vehicle(flown.states[-1], pack_airframe(airframe)), FULL_STATE
    gains = gains_for(airframe).pack()
    setpoint = vehicle[SETPOINT : SETPOINT + SETPOINT_SIZE]
    setpoint[:] = setpoint_rows(state)[last]
    # The integrals are small, the rates are not.
    vehicle[MEMORY + 6 : MEMORY + 10] = vehicle[10], -vehicle[11], setpoint[13], -setpoint[14]
    places = []
    for step in range(longest):
        if step == level_after:
            setpoint[15], mode = 0.0, LEVEL_OUT
        if step >= off_after:
            vehicle[ASKED : ASKED + 4] = 0.0
        elif step % 2 == 0:
            fly_mellinger(vehicle, gains, mode)
        step_body(vehicle, TIME_STEP)
        places.append(vehicle[:3].copy())
        if step > off_after and vehicle[2] <= 0.0:
            break
    return np.array(places)
