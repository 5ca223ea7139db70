"""Values that a rule of the preflight table must refuse."""

import math
import struct

from cfplan.flight.pilot.vehicle_rules import ParameterRule
from cfplan.safety.limits import Limits
from cfplan.simulation.virtual_crazyflie.parameters import parameter_toc

LAYOUTS = {entry.full_name: entry.format for entry in parameter_toc().variables}


def wrong_values(rule: ParameterRule, limits: Limits) -> list[float]:
    """Return values just outside what is allowed on each side of each interval."""
    intervals = rule.allowed(limits)
    step = max(abs(end) for interval in intervals for end in interval if math.isfinite(end)) * 1e-3 or 1.0
    ends = [low - step for low, _ in intervals] + [high + step for _, high in intervals if math.isfinite(high)]
    return [value for value in ends if not any(low <= value <= high for low, high in intervals)]


def wrong_on_board(rule: ParameterRule, limits: Limits) -> float:
    """Return one that the parameter's type can hold, as it holds it."""
    layout = LAYOUTS[rule.name]
    for value in wrong_values(rule, limits):
        try:
            (held,) = struct.unpack(layout, struct.pack(layout, value if layout == "<f" else math.floor(value)))
        except struct.error:  # too large or too small for the type
            continue
        if not rule.accepts(held, limits):
            return held
    raise AssertionError(f"every value of {rule.name} is allowed")
