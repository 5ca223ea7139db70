"""One simulated body, whose motors are asked for the same thrusts all the time."""

import numpy as np

from cfplan.simulation.engine.body import TIME_STEP, step_body
from cfplan.simulation.engine.layout import (
    ASKED,
    EFFICIENCY,
    FULL_EFFICIENCY,
    STATE_SIZE,
    STILL_AIR,
    WIND,
    new_vehicle,
)


def stepped(state, asked, airframe, seconds, *, wind=STILL_AIR, efficiency=FULL_EFFICIENCY) -> np.ndarray:
    """Return the state, (17,), `seconds` later, of a packed airframe, (26,)."""
    vehicle = new_vehicle(state, airframe)
    vehicle[ASKED : ASKED + 4], vehicle[WIND : WIND + 3], vehicle[EFFICIENCY : EFFICIENCY + 4] = asked, wind, efficiency
    for _ in range(round(seconds / TIME_STEP)):
        step_body(vehicle, TIME_STEP)
    return vehicle[:STATE_SIZE].copy()
