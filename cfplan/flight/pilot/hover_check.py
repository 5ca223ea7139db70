"""The hover check: thrust scale and battery, measured in the hover after take-off, against what was certified.

In hover the motors carry the weight. What they are commanded, from the logged PWM and battery voltage by the firmware's
motor curve, therefore shows the thrust scale at the mass that the airframe states. A climb that has not ended counts by
the change of the estimated velocity. Masses and thrusts in proportion hover alike, so a wrong mass shows here as well.
"""

import math
from dataclasses import dataclass

import numpy as np

from cfplan.flight.pilot.abort_reasons import AbortReason
from cfplan.flight.pilot.flight_loop import AbortRaised, FlightLoop
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.telemetry import Estimate, Level, VehicleStatus
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.motor_commands import FULL_COMMAND, command_shares

HOVER = 1.0  # s
_FEWEST = 20  # reports of the motors; the log has fifty a second


@dataclass(frozen=True, slots=True)
class HoverMeasurement:
    """What a hover shows of the vehicle."""

    thrust_scale: float  # of the airframe as stated: actual over commanded thrust
    battery_voltage: float  # V, under the load of hovering
    full_thrust: float  # N, the most that one motor gives at this voltage


def measure_hover(
    statuses: list[VehicleStatus], estimates: tuple[Estimate, Estimate], airframe: Airframe
) -> HoverMeasurement:
    """Return what a hover shows; `estimates` are from its beginning and its end. NaN where the log holds no numbers."""
    before, after = estimates
    voltage = np.array([status.battery_voltage for status in statuses])
    shares = command_shares(np.array([status.motor for status in statuses], dtype=float), voltage, airframe)
    commanded = airframe.motor_thrust_max * float(shares.sum(axis=1).mean())  # N, of all motors
    climbs = (after.velocity[2] - before.velocity[2]) / (after.time - before.time)
    scale = airframe.mass * (GRAVITY + climbs) / commanded if commanded > 0.0 else math.nan
    mean = float(voltage.mean())
    full = float(command_shares(np.full((1, 1), FULL_COMMAND), np.array([mean]), airframe)[0, 0])
    return HoverMeasurement(scale, mean, scale * airframe.motor_thrust_max * full)


def certified_scales(airframe: Airframe) -> tuple[float, float]:
    """Return the least and the largest thrust scale that dry runs draw, at the mass as stated."""
    spread = airframe.spread.thrust_scale + airframe.spread.mass
    return airframe.thrust_scale * (1.0 - spread), airframe.thrust_scale * (1.0 + spread)


def check_hover(loop: FlightLoop) -> None:
    """Hover for HOVER, s, and measure. Raises AbortRaised outside of what the plan was certified for.

    A log that is silent decides nothing: it is reported, and the abort monitor has its own rules for it.
    """
    statuses: list[VehicleStatus] = []
    estimates: list[Estimate] = []

    def collect() -> bool:
        status, estimate = loop.status, loop.estimate
        if status is not None and (not statuses or status.time > statuses[-1].time):
            statuses.append(status)
        if estimate is not None and (not estimates or estimate.time > estimates[-1].time):
            estimates.append(estimate)
        return False

    loop.until(collect, HOVER)
    airframe, add_event = loop.limits.airframe, loop.history.add_event
    if len(statuses) < _FEWEST or len(estimates) < _FEWEST:
        add_event(Level.WARNING, "hover: the thrust scale is not known, as the vehicle's log was silent")
        return
    seen = measure_hover(statuses, (estimates[0], estimates[-1]), airframe)
    if not (math.isfinite(seen.thrust_scale) and math.isfinite(seen.battery_voltage)):
        add_event(Level.WARNING, "hover: the thrust scale is not known: the log has no motor commands or no voltage")
        return
    add_event(Level.INFO, f"hover: thrust scale {seen.thrust_scale:.3f}, battery {seen.battery_voltage:.2f} V")
    _require_certified(seen, airframe, loop.limits.plan)


def _require_certified(seen: HoverMeasurement, airframe: Airframe, plan: PlanLimits) -> None:
    least, most = certified_scales(airframe)
    if not least <= seen.thrust_scale <= most:
        raise AbortRaised(
            AbortReason.OTHER_THRUST.abort(
                Rung.LAND, scale=seen.thrust_scale, least=least, most=most,
                mass=airframe.mass * airframe.thrust_scale / seen.thrust_scale,
            )
        )  # fmt: skip
    if seen.full_thrust < plan.motor_thrust_max:
        raise AbortRaised(AbortReason.BATTERY_LOW.abort(Rung.LAND, volts=seen.battery_voltage))
