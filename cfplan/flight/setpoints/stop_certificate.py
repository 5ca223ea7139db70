"""Stop certificate: the worst values of the motion that the bytes of stops make the vehicle fly, against their limits.

A stop may exceed the limits of the plan: where a turn is flown at its limit, braking adds to it. Longer stops gain
little (5.7 m/s² instead of 5.8 for twice the way), so all are short, and have limits of their own in the table of
quantities: the limits of the flight, a tilt at which the controller is stable, the thrust of the motors.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import NotCertifiedError
from cfplan.flight.setpoints.byte_check import check_motion
from cfplan.flight.setpoints.encoding import encode_motion
from cfplan.flight.setpoints.packets import PAYLOAD_SIZE, FullStateSetpoints
from cfplan.flight.setpoints.rate_trade import FIRMWARE_GAINS, AttitudeGains
from cfplan.flight.setpoints.stops import DURATION, chunks, stop_motion
from cfplan.machine_code import njit
from cfplan.safety.limits import Limits
from cfplan.safety.quantities import AT_MOST, PACKET_ROUNDING, QUANTITIES
from cfplan.safety.space import Space
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.flatness import ROUNDING, Body, Flat, compiled_body, motor_thrusts
from cfplan.vehicle.measures import MEASURES, measures

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
    *,  # as for encode_stops()
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
        flown = _flown(stops[some], made, begin[some], gains, space)
        measured.append(_worst(flown, stops.shape[1], limits.airframe, rate))
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

    With `count`, only stops from the first `count` rows are made. Raises NotCertifiedError as certify_stops() does.
    """
    count, length = len(motion.position) if count is None else count, round(DURATION * rate) + 1
    begin = np.arange(min(_resting_from(motion) + 1, count))  # those behind are the same
    stops, measured = np.empty((count, length, PAYLOAD_SIZE), dtype=np.uint8), []
    for some in chunks(len(begin)):
        made = stop_motion(motion, begin[some], rate, DURATION)
        stops[some] = encode_motion(*made, gains, space=space).reshape(-1, length, PAYLOAD_SIZE)
        flown = _flown(stops[some], made, begin[some], gains, space)
        measured.append(_worst(flown, length, limits.airframe, rate))
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


def _flown(
    stops: NDArray, made: tuple[FullStateSetpoints, NDArray], begin: NDArray, gains: AttitudeGains, space: Space | None
) -> FullStateSetpoints:
    """Return the motion that stops, (K, M, 29), make; `made` is what they are to fly, from the rows `begin`, (K,).

    Raises NotCertifiedError where their bytes do not make the vehicle fly that.
    """
    try:
        return check_motion(stops.reshape(-1, PAYLOAD_SIZE), *made, gains, space=space)
    except NotCertifiedError as error:
        stop, row = divmod(int(error.where.split()[-1]), stops.shape[1])
        where = f"setpoint {row} of the stop from {begin[stop]}"
        raise NotCertifiedError(error.what, where=where, hint=error.hint) from None


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
    known = (flown.velocity, flown.acceleration, flown.body_rate)
    velocity, sent, body_rate = (np.array(each, dtype=float, order="C").reshape(-1, length, 3) for each in known)
    low, high = _extremes(velocity, sent, body_rate, compiled_body(airframe), rate)
    # Values grow with measures, so the worst value is that of the worst measure.
    return np.stack([quantity.worst(high if quantity.side == AT_MOST else low) for quantity in BOUND])


@njit(error_model="numpy", fastmath=ROUNDING)
def _extremes(velocity: NDArray, sent: NDArray, body_rate: NDArray, body: Body, rate: float) -> tuple[NDArray, NDArray]:
    """Return the least and the largest of each measure in each of N stops, (MEASURES, N); NaN where one is NaN.

    Velocity, acceleration as sent and body rate are (N, M, 3); body rates are differentiated from _SPAN setpoints
    before to as many after.
    """
    count, length, nan = len(velocity), velocity.shape[1], np.nan
    low, high = np.full((MEASURES, count), np.inf), np.full((MEASURES, count), -np.inf)
    drag = body.drag[0] / body.mass  # what is sent makes up for drag besides
    for k in range(count):
        for m in range(length):
            ahead, behind = min(m + _SPAN, length - 1), max(m - _SPAN, 0)
            over = rate / max(ahead - behind, 1)
            wx, wy, wz = body_rate[k, m, 0], body_rate[k, m, 1], body_rate[k, m, 2]
            ax = (body_rate[k, ahead, 0] - body_rate[k, behind, 0]) * over
            ay = (body_rate[k, ahead, 1] - body_rate[k, behind, 1]) * over
            az = (body_rate[k, ahead, 2] - body_rate[k, behind, 2]) * over
            jx, jy, jz = body.inertia
            torque = (
                jx * ax + wy * (jz * wz) - wz * (jy * wy),
                jy * ay + wz * (jx * wx) - wx * (jz * wz),
                jz * az + wx * (jy * wy) - wy * (jx * wx),
            )
            x, y, z = sent[k, m, 0], sent[k, m, 1], sent[k, m, 2] + GRAVITY
            vx, vy, vz = velocity[k, m, 0], velocity[k, m, 1], velocity[k, m, 2]
            thrust = math.sqrt(x * x + y * y + z * z)
            values = measures(
                Flat(
                    (vx, vy, vz),
                    (sent[k, m, 0] - drag * vx, sent[k, m, 1] - drag * vy, sent[k, m, 2] - drag * vz),
                    (nan, nan, nan),
                    (nan, nan, nan),
                    thrust,
                    (x / thrust, y / thrust, z / thrust),
                    (wx, wy, wz),
                    (ax, ay, az),
                    torque,
                    motor_thrusts(body, body.mass * thrust, torque),
                )
            )
            for row in range(MEASURES):
                value = values[row]
                if not value >= low[row, k] and low[row, k] == low[row, k]:
                    low[row, k] = value
                if not value <= high[row, k] and high[row, k] == high[row, k]:
                    high[row, k] = value
    return low, high
