"""Feasibility checks before any search: hover within the limits, its thrust reserve, and boundary states."""

import math
from functools import lru_cache

from cfplan.geometry.path import Path
from cfplan.safety.limits import PlanLimits
from cfplan.safety.quantities import AT_MOST, INSTANT, QUANTITIES, Quantity
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.flatness import flat_state
from cfplan.vehicle.measures import measures
from cfplan.vehicle.profile import BoundaryState

LEAST_SPARE = 1e-3  # N, least assumed thrust reserve, so that no estimate divides by zero
BOUNDARY_TOLERANCE = 1e-3  # relative tolerance of a boundary state: rounding of the planner that made it


def hover_violation(airframe: Airframe, limits: PlanLimits) -> Quantity | None:
    """Return the first quantity whose limit hovering does not keep with some reserve; None if it keeps all."""
    for quantity in QUANTITIES:
        if quantity.excess(quantity.hover(airframe), quantity.allowed(limits)) >= 0.0:
            return quantity
    return None


def describe_hover(quantity: Quantity, airframe: Airframe, limits: PlanLimits) -> str:
    """Describe the value in hover and the limit."""
    side = "at most" if quantity.side == AT_MOST else "at least"
    return (
        f"hovering takes a {quantity.noun} of {quantity.hover(airframe):.3g} {quantity.unit}, {quantity.limit} asks "
        f"for {side} {quantity.allowed(limits):.3g} {quantity.unit}"
    )


def spare_thrust(airframe: Airframe, limits: PlanLimits) -> tuple[float, float]:
    """Return how much each motor may increase and decrease its thrust from hover, N."""
    return limits.motor_thrust_max - airframe.hover_thrust, airframe.hover_thrust - limits.motor_thrust_min


def spare_turning(airframe: Airframe, limits: PlanLimits) -> float:
    """Return the angular acceleration about roll or pitch, rad/s², of the motors' reserve in hover."""
    spare = max(min(spare_thrust(airframe, limits)), LEAST_SPARE)
    return 4 * airframe.arm * spare / max(airframe.inertia[:2])


def smoothing_half_width(airframe: Airframe, limits: PlanLimits) -> float:
    """Return half the width, s, of the window that turns a jump of acceleration to its opposite into feasible motion.

    Over w a jump of 2a makes a jerk of 2a/w and a snap of at most 4a/w², and g times the thrust axis's first and second
    derivative are about that: they must be met by body rate, and by the torque reserve of the motors in hover.
    """
    turning = min(spare_turning(airframe, limits), limits.angular_acceleration)
    most = min(limits.acceleration, 4 * limits.motor_thrust_max / airframe.mass)
    rate, acceleration = GRAVITY * limits.angular_velocity, GRAVITY * turning
    return max(2 * most / rate, (4 * most / acceleration) ** 0.5)


@lru_cache(maxsize=64)
def infeasible_limit(airframe: Airframe, limits: PlanLimits) -> str:
    """Return which limit excludes hovering, and so every flight; empty if none does."""
    for name in PlanLimits.__slots__:
        value = getattr(limits, name)
        unbounded = name == "angular_acceleration" and value == math.inf
        if not (math.isfinite(value) or unbounded) or value < 0 or (value == 0 and name != "motor_thrust_min"):
            return f"the limit {name} is {value}"
    violated = hover_violation(airframe, limits)
    return describe_hover(violated, airframe, limits) if violated else ""


def violated_limit(boundary: BoundaryState, path: Path, s: float, airframe: Airframe, limits: PlanLimits) -> str:
    """Return which limit a boundary state itself violates; empty if none."""
    if boundary.h <= 0:
        return f"h must be positive, not {boundary.h:g}"
    first, second, third, fourth = (path(s, order).tolist() for order in (1, 2, 3, 4))
    flat = flat_state(
        airframe, (first, second, third, fourth), (boundary.h, boundary.dh, boundary.ddh, 0.0),
        (boundary.yaw, boundary.dyaw, 0.0), math.cos, math.sin,
    )  # fmt: skip
    measured = measures(flat)
    for quantity in INSTANT:
        value, limit = float(quantity.value(measured[quantity.measure])), quantity.allowed(limits)
        if not quantity.excess(value, limit) <= BOUNDARY_TOLERANCE * limit:
            which = "the limit" if quantity.side == AT_MOST else "the least"
            return f"{quantity.noun} is {value:.4g} {quantity.unit}, {which} {limit:.4g} {quantity.unit}"
    return ""
