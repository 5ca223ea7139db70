"""Glitch assessment: how close a gap in setpoints or poses from any setpoint on comes to losing the vehicle."""

import numpy as np

from cfplan.flight.setpoints.encoding import EncodedFlight
from cfplan.numbers import coordinates
from cfplan.preparation.local_slowing import Assessment
from cfplan.safety.limits import Limits
from cfplan.simulation.glitches import GAP, KINDS, glitch_at_sampled_setpoints

KEPT = 0.9  # usage that planning keeps; at 1 the vehicle counts as lost
_ABOUT = (0.0, GAP + 0.3)  # s before and after a setpoint at fault, to be slowed: the gap, and the catching up
_HINT = "make the path gentler there, or plan with a lower speed or acceleration"


def assess_glitches(encoded: EncodedFlight, limits: Limits) -> Assessment:
    """Simulate a gap at each setpoint; one is at fault if deviation or tilt nearly lose the vehicle."""
    moments = glitch_at_sampled_setpoints(encoded.payloads, limits)
    usage = moments.usage(limits)
    kind, share = np.argmax(usage, axis=0), usage.max(axis=0)

    def describe(at: int) -> str:
        off, tilt = moments.deviation[kind[at], at], np.degrees(moments.tilt[kind[at], at])
        return f"of {GAP:g} s in {KINDS[kind[at]]} takes the vehicle {off:.2f} m off, at a tilt of {tilt:.0f}°"

    def near(at: int) -> str:
        return f"{coordinates(encoded.decoded.position[at], '.2f')} m"

    return Assessment("a gap", encoded.times, share - KEPT, share, describe, near, _HINT, about=_ABOUT)
