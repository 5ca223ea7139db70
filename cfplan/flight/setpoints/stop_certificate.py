"""The certificate of the stops: the motion that their bytes make the vehicle fly, held against the limits.

A stop may exceed the limits of the plan: where a turn is flown at its limit, braking adds to it. Longer stops gain
little (5.7 m/s² instead of 5.8 for twice the way), so all are short, and must keep what the table of quantities says
that a stop may reach: the limits of the flight, a tilt at which the controller is stable, the thrust of the motors.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import NotCertifiedError
from cfplan.flight.setpoints.encoding import check_motion, encode_motion
from cfplan.flight.setpoints.packets import PAYLOAD_SIZE, FullStateSetpoints
from cfplan.flight.setpoints.rate_trade import FIRMWARE_GAINS, AttitudeGains
from cfplan.flight.setpoints.stops import DURATION, chunks, stop_motion
from cfplan.safety.limits import Limits
from cfplan.safety.quantities import AT_MOST, PACKET_ROUNDING, QUANTITIES
from cfplan.safety.space import Space
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.flatness import motor_thrusts
from cfplan.vehicle.measures import measures_of
from cfplan.vehicle.rotations import norms

BOUND = tuple(quantity for quantity in QUANTITIES if quantity.in_stop)
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


def certify_stops(
    stops: NDArray,
    motion: FullStateSetpoints,
    limits: Limits,
    rate: float,
    rows: NDArray | None = None,
    gains: AttitudeGains = FIRMWARE_GAINS,
    space: Space | None = None,
) -> StopCertificate:
    """Return the worst values of stops (N, M, 29) uint8 at `rate`, Hz, from each row of a motion, or from `rows`.

    Raises NotCertifiedError where the bytes do not make the vehicle fly just that stop.
    """
    begin = np.arange(len(motion.position)) if rows is None else rows
    duration = (stops.shape[1] - 1) / rate
    measured = []
    for some in chunks(len(stops)):
        made = stop_motion(motion, begin[some], rate, duration)
        measured.append(_measured(stops[some], made, begin, some.start, limits, rate, gains, space))
    return _certificate(np.concatenate(measured, axis=1), limits)


def encode_certified_stops(
    motion: FullStateSetpoints,
    limits: Limits,
    rate: float,
    gains: AttitudeGains = FIRMWARE_GAINS,
    space: Space | None = None,
    *,
    count: int | None = None,
) -> tuple[NDArray, StopCertificate]:
    """Return a stop from each row of a motion as encode_stops() does, and their certificate, in less time than both.

    `count` is of how many rows, from the first on; of all where it is not given.

    Raises NotCertifiedError as certify_stops() does.
    """
    count, length = len(motion.position) if count is None else count, round(DURATION * rate) + 1
    begin = np.arange(min(_resting_from(motion) + 1, count))  # those behind are the same
    stops, measured = np.empty((count, length, PAYLOAD_SIZE), dtype=np.uint8), []
    for some in chunks(len(begin)):
        made = stop_motion(motion, begin[some], rate, DURATION)
        stops[some] = encode_motion(*made, gains, space=space).reshape(-1, length, PAYLOAD_SIZE)
        measured.append(_measured(stops[some], made, begin, some.start, limits, rate, gains, space))
    stops[len(begin) :] = stops[begin[-1]]
    measured.append(np.repeat(measured[-1][:, -1:], count - len(begin), axis=1))
    return stops, _certificate(np.concatenate(measured, axis=1), limits)


def _resting_from(motion: FullStateSetpoints) -> int:
    """Return the first row from which on nothing of a motion changes."""
    changes = np.zeros(len(motion.position), dtype=bool)
    for name in FullStateSetpoints.__slots__:
        values = getattr(motion, name)
        changes[1:] |= (values[1:] != values[:-1]).any(axis=1)
    return int(np.flatnonzero(changes).max(initial=0))


def _measured(
    stops: NDArray,
    made: tuple[FullStateSetpoints, NDArray],
    begin: NDArray,
    first: int,
    limits: Limits,
    rate: float,
    gains: AttitudeGains,
    space: Space | None,
) -> NDArray:
    """Return (len(BOUND), K) worst values of K stops, which are to fly what was made of them; `first` is their number.

    Raises NotCertifiedError where their bytes do not make the vehicle fly that.
    """
    length = stops.shape[1]
    try:
        flown = check_motion(stops.reshape(-1, PAYLOAD_SIZE), *made, gains, first * length, space=space)
    except NotCertifiedError as error:
        number = int(error.where.split()[-1])
        where = f"setpoint {number % length} of the stop from {begin[number // length]}"
        raise NotCertifiedError(error.what, where=where, hint=error.hint) from None
    return _worst(flown, length, limits.airframe, rate)


def _certificate(worst: NDArray, limits: Limits) -> StopCertificate:
    """Return the certificate of stops by their worst values, (len(BOUND), N)."""
    allowed = np.array([quantity.allowed(limits.plan) for quantity in BOUND])
    sides = np.array([quantity.side for quantity in BOUND])
    excess = sides[:, None] * (worst - allowed[:, None])
    as_planned = (excess <= PACKET_ROUNDING * (1.0 + allowed[:, None])).all(axis=0).sum()
    worst_of_all = sides * (sides[:, None] * worst).max(axis=1)
    names = [quantity.name for quantity in BOUND]
    return StopCertificate(worst.shape[1], int(as_planned), dict(zip(names, worst_of_all.tolist(), strict=True)))


def _worst(flown: FullStateSetpoints, length: int, airframe: Airframe, rate: float) -> NDArray:
    """Return (len(BOUND), N): the worst value of each quantity in each of N stops of `length` rows."""
    velocity, sent, body_rate = (
        values.reshape(-1, length, 3) for values in (flown.velocity, flown.acceleration, flown.body_rate)
    )
    force = sent + np.array([0.0, 0.0, GRAVITY])
    thrust = norms(force)
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
