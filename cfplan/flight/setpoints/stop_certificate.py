"""The certificate of the stops: their bytes, as the vehicle decodes them, held against the limits.

A stop may exceed the limits of the plan: where a turn is flown at its limit, braking adds to it. Longer stops gain
little (5.7 m/s² instead of 5.8 for twice the way), so all are short, and must keep what the table of quantities says
that a stop may reach: the limits of the flight, a tilt at which the controller is stable, the thrust of the motors.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import NotCertifiedError
from cfplan.flight.setpoints.packets import decode
from cfplan.safety.limits import Limits
from cfplan.safety.quantities import AT_MOST, PACKET_ROUNDING, QUANTITIES
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.flatness import motor_thrusts
from cfplan.vehicle.measures import measures_of

BOUND = tuple(quantity for quantity in QUANTITIES if quantity.in_stop)
_CHUNK = 1000  # stops at a time
_SPAN = 2  # setpoints on each side, over which body rates are differentiated, as packets round them to a millirad/s


@dataclass(frozen=True, slots=True)
class StopCertificate:
    """Worst values over every moment of every stop."""

    count: int
    as_planned: int  # stops that keep the limits of the plan too
    worst: dict[str, float]  # of each quantity that binds stops, by its name

    def require(self, limits: Limits) -> None:
        """Raise NotCertifiedError where a stop exceeds what stops may reach."""
        for quantity in BOUND:
            assert quantity.in_stop
            value, limit = self.worst[quantity.name], quantity.in_stop(limits)
            if not quantity.excess(value, limit) <= 0.0:
                side = "at most" if quantity.side == AT_MOST else "at least"
                unit = quantity.unit
                if unit == "rad":
                    value, limit, unit = math.degrees(value), math.degrees(limit), "°"
                raise NotCertifiedError(
                    f"a stop reaches a {quantity.noun} of {value:.3g} {unit}; it may be {side} {limit:.3g}",
                    where="stops",
                    hint="plan with a lower speed or acceleration",
                )


def certify_stops(stops: NDArray, limits: Limits, rate: float) -> StopCertificate:
    """Return the worst values of stops (N, M, 29) uint8 at `rate`, Hz."""
    worst = np.concatenate(
        [_worst(stops[first : first + _CHUNK], limits.airframe, rate) for first in range(0, len(stops), _CHUNK)], axis=1
    )
    allowed = np.array([quantity.allowed(limits.plan) for quantity in BOUND])
    sides = np.array([quantity.side for quantity in BOUND])
    excess = sides[:, None] * (worst - allowed[:, None])
    as_planned = (excess <= PACKET_ROUNDING * (1.0 + allowed[:, None])).all(axis=0).sum()
    worst_of_all = sides * (sides[:, None] * worst).max(axis=1)
    names = [quantity.name for quantity in BOUND]
    return StopCertificate(len(stops), int(as_planned), dict(zip(names, worst_of_all.tolist(), strict=True)))


def _worst(stops: NDArray, airframe: Airframe, rate: float) -> NDArray:
    """Return (len(BOUND), N): the worst value of each quantity in each of the stops, (N, M, 29)."""
    decoded = decode(stops)
    shape = (*stops.shape[:2], 3)
    velocity, sent, body_rate = (
        values.reshape(shape) for values in (decoded.velocity, decoded.acceleration, decoded.body_rate)
    )
    force = sent + np.array([0.0, 0.0, GRAVITY])
    thrust = np.linalg.norm(force, axis=2)
    turning = _differentiated(body_rate, rate)
    measured = measures_of(
        velocity=velocity,
        acceleration=sent - airframe.drag[0] / airframe.mass * velocity,  # what is sent makes up for drag besides
        body_rate=body_rate,
        thrust_axis=force / thrust[..., None],
        specific_thrust=thrust,
        angular_acceleration=turning,
        motor_thrust=_motors(airframe, thrust, body_rate, turning),
    )
    worst = [quantity.worst(measured) for quantity in BOUND]
    return np.stack([q.side * (q.side * values).max(axis=1) for q, values in zip(BOUND, worst, strict=True)])


def _differentiated(body_rate: NDArray, rate: float) -> NDArray:
    """Return (N, M, 3) rad/s²: the change of body rates from _SPAN setpoints before to as many after."""
    place = np.arange(body_rate.shape[1])
    ahead, behind = np.minimum(place + _SPAN, place[-1]), np.maximum(place - _SPAN, 0)
    return (body_rate[:, ahead] - body_rate[:, behind]) * (rate / np.maximum(ahead - behind, 1))[:, None]


def _motors(airframe: Airframe, specific_thrust: NDArray, body_rate: NDArray, turning: NDArray) -> NDArray:
    """Return (N, M, 4) N: the thrust of each motor, torque counted."""
    inertia = np.array(airframe.inertia)
    torque = inertia * turning + np.cross(body_rate, inertia * body_rate)
    parts = torque[..., 0], torque[..., 1], torque[..., 2]
    return np.stack(motor_thrusts(airframe, airframe.mass * specific_thrust, parts), axis=-1)
