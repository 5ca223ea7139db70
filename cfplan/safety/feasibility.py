"""What makes a plan impossible before any solver is asked."""

import math

from cfplan.geometry.path import Path
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.flatness import flat_state
from cfplan.vehicle.profile import BoundaryState

HARDLY = 1e-3
# share by which a boundary state may exceed a limit: noise of whoever made it


def infeasible_limit(airframe: Airframe, limits: PlanLimits) -> str:
    """Which limit excludes every flight, because it excludes hovering; empty where none does."""
    for name in PlanLimits.__slots__:
        value = getattr(limits, name)
        unbounded = name == "angular_acceleration" and value == math.inf
        if not (math.isfinite(value) or unbounded) or value < 0 or (value == 0 and name != "motor_thrust_min"):
            return f"the limit {name} is {value}"
    hover = airframe.hover_thrust
    if hover >= limits.motor_thrust_max:
        return f"hovering takes {hover:.3g} N a motor, motor_thrust_max allows {limits.motor_thrust_max:.3g} N"
    if hover <= limits.motor_thrust_min:
        return f"hovering takes {hover:.3g} N a motor, motor_thrust_min asks for {limits.motor_thrust_min:.3g} N"
    if limits.specific_thrust_min >= GRAVITY:
        return f"hovering gives {GRAVITY} m/s², specific_thrust_min asks for {limits.specific_thrust_min:.3g} m/s²"
    return ""


def violated_limit(boundary: BoundaryState, path: Path, s: float, airframe: Airframe, limits: PlanLimits) -> str:
    """Which limit a boundary state breaks by itself, whatever follows; empty where it breaks none."""
    if boundary.h <= 0:
        return f"h must be positive, not {boundary.h:g}"
    first, second, third, fourth = (path(s, order).tolist() for order in (1, 2, 3, 4))
    flat = flat_state(
        airframe, (first, second, third, fourth), (boundary.h, boundary.dh, boundary.ddh, 0.0),
        (boundary.yaw, boundary.dyaw, 0.0), math.cos, math.sin,
    )  # fmt: skip
    checks = (
        ("speed", math.hypot(*flat.velocity), limits.speed, "m/s"),
        ("acceleration", math.hypot(*flat.acceleration), limits.acceleration, "m/s²"),
        ("angular velocity", math.hypot(*flat.body_rate), limits.angular_velocity, "rad/s"),
        ("tilt", math.acos(max(-1.0, min(1.0, flat.thrust_axis[2]))), limits.tilt, "rad"),
    )
    for name, value, limit, unit in checks:
        if not value <= limit * (1 + HARDLY):
            return f"{name} is {value:.4g} {unit}, the limit {limit:.4g} {unit}"
    if not flat.specific_thrust >= limits.specific_thrust_min * (1 - HARDLY):
        return f"specific thrust is {flat.specific_thrust:.4g} m/s², the least {limits.specific_thrust_min:.4g} m/s²"
    return ""
