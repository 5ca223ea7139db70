"""Stops along the path, encoded before take-off for every moment of the flight.

From the setpoint that is due, the clock of the trajectory runs slower and slower until it stands: the vehicle brakes
on the path itself, where it was certified to be, and ends level at rest. With r the rate of that clock,

    v = r v₀,   a = r² a₀ + ṙ v₀,   attitude from a + g and planned yaw,   body rates from the turn between attitudes.

r falls as a quintic smoothstep, so the braking deceleration is at most 1.875 v₀ / duration, and begins from nothing. A
stop that begins at once, or is shorter, turns the vehicle so fast that link loss within it ends outside the walls.

Yaw is that of the Hopf fibration, as in plans: the Euler yaw of a leaning attitude differs from it by degrees, and a
vehicle that stopped often would turn away.
"""

import math
from collections.abc import Iterator

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.flight.setpoints.encoding import (
    LEADING_WEIGHT,
    RATE_LEAD,
    THRUST_LEAD,
    encode_motion,
)
from cfplan.flight.setpoints.packets import PAYLOAD_SIZE, FullStateSetpoints, arrays_of
from cfplan.flight.setpoints.rate_trade import FIRMWARE_GAINS, AttitudeGains, ahead
from cfplan.machine_code import njit
from cfplan.safety.space import Space
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.rotations import hopf_quaternion, yaw_of

DURATION = 1.2  # s, from full speed to rest: 3.1 m/s² from 2 m/s on top of the turn's own
_GRAVITY = np.array([0.0, 0.0, GRAVITY])
_CHUNK = 64  # stops at a time, so that all fields of them stay in a processor's cache


def encode_stops(
    motion: FullStateSetpoints,
    rate: float,
    duration: float = DURATION,
    rows: NDArray | None = None,
    gains: AttitudeGains = FIRMWARE_GAINS,
    space: Space | None = None,
) -> NDArray:
    """Return (N, M, 29) uint8: stop i begins with the place of the motion's row i and ends in hover; M at `rate`, Hz.

    `motion` is what the setpoints of the flight make the vehicle fly, N rows at `rate`. Where `rows` are given, stops
    from these alone. `gains` and `space` as for the setpoints of the flight.
    """
    begin = np.arange(len(motion.position)) if rows is None else rows
    out = np.empty((len(begin), round(duration * rate) + 1, PAYLOAD_SIZE), dtype=np.uint8)
    for some in chunks(len(begin)):
        stops, coming = stop_motion(motion, begin[some], rate, duration)
        out[some] = encode_motion(stops, coming, gains, space=space).reshape(-1, *out.shape[1:])
    return out


def chunks(count: int) -> Iterator[slice]:
    """Return slices of so many stops as are made at a time."""
    return (slice(first, min(first + _CHUNK, count)) for first in range(0, count, _CHUNK))


def rest_behind(
    motion: FullStateSetpoints, row: int, rate: float, duration: float = DURATION
) -> tuple[tuple[float, float, float], float]:
    """Return the place, m, and the yaw, rad, at which the stop from a row of a motion rests; it is level there.

    Bytes tell the place alone: a hover near a wall leans, so the attitude in them is not level, and is rounded.
    """
    stop, _ = stop_motion(motion, np.array([row]), rate, duration)
    x, y, z = stop.position[-1].tolist()
    return (x, y, z), float(yaw_of(stop.quaternion[-1]))


def stop_motion(
    motion: FullStateSetpoints,
    begin: NDArray,
    rate: float,
    duration: float = DURATION,
    *,
    rate_lead: float = RATE_LEAD,
    thrust_lead: float = THRUST_LEAD,
) -> tuple[FullStateSetpoints, NDArray]:
    """Return the stops from rows `begin`, (K,), of a motion, one after another, K · M rows, as motion to fly.

    With it comes the acceleration of each row BRAKE_LEAD later, (K · M, 3). Body rates and the length of the thrust
    vector have the leads, s, of the setpoints of a plan.
    """
    *_, z, w = motion.quaternion.T
    yaw = np.unwrap(2.0 * np.arctan2(z, w))  # of the Hopf fibration
    *fields, acceleration = _stop_rows(
        arrays_of(motion),
        np.array(yaw, dtype=float),
        np.array(begin, dtype=np.int64),
        stop_clock(rate, duration),
        rate,
        np.array([rate_lead * rate, thrust_lead * rate]),
    )
    stops = FullStateSetpoints(*(field.reshape(-1, field.shape[-1]) for field in fields))
    return stops, ahead(acceleration, rate).reshape(-1, 3)


def stop_clock(rate: float, duration: float = DURATION) -> NDArray:
    """Return a stop's clock, (3, M) at `rate`, Hz: setpoints elapsed along the motion, its rate, its change, 1/s."""
    steps = round(duration * rate)
    fraction = np.arange(steps + 1) / steps
    clock_rate = 1.0 - fraction**3 * (10.0 - 15.0 * fraction + 6.0 * fraction**2)
    slowing = -30.0 * fraction**2 * (1.0 - fraction) ** 2 / duration
    elapsed = fraction - 2.5 * fraction**4 + 3.0 * fraction**5 - fraction**6  # the integral of clock_rate
    elapsed *= duration * rate  # in setpoints
    return np.stack([elapsed, clock_rate, slowing])


_Rows = tuple[NDArray, NDArray, NDArray, NDArray, NDArray, NDArray]


@njit(error_model="numpy", nogil=True)
def _stop_rows(
    motion: tuple[NDArray, ...], yaw: NDArray, begin: NDArray, clock: NDArray, rate: float, leads: NDArray
) -> _Rows:
    """Return position, velocity, acceleration as sent, attitude, body rate, and acceleration, (K, M, …), of K stops.

    `motion` are the fields of N setpoints, and `yaw`, (N,) rad, is that of each in the Hopf fibration.
    `clock`, (3, M), is the time elapsed along the motion, in rows, its rate, and how that rate changes, 1/s. `leads`
    are those of rates and of thrust, in rows.
    """
    position, velocity, acceleration, _, _ = motion
    count, stops, length = len(position), len(begin), clock.shape[1]
    places, speeds, sent, made, rates = (
        np.empty((stops, length, 3)), np.empty((stops, length, 3)), np.empty((stops, length, 3)),
        np.empty((stops, length, 3)), np.empty((stops, length, 3)),
    )  # fmt: skip
    attitudes, thrust, turning = np.empty((stops, length, 4)), np.empty(length), np.empty((length, 3))
    for k in range(stops):
        for m in range(length):
            place = min(begin[k] + clock[0, m], count - 1.0)
            row = min(int(place), max(count - 2, 0))
            after, between = min(row + 1, count - 1), place - row
            for i in range(3):
                speed = velocity[row, i] + between * (velocity[after, i] - velocity[row, i])
                along = acceleration[row, i] + between * (acceleration[after, i] - acceleration[row, i])
                places[k, m, i] = position[row, i] + between * (position[after, i] - position[row, i])
                speeds[k, m, i] = clock[1, m] * speed
                made[k, m, i] = clock[1, m] ** 2 * along + clock[2, m] * speed
            half = 0.5 * (yaw[row] + between * (yaw[after] - yaw[row]))
            a, b, c = made[k, m, 0], made[k, m, 1], made[k, m, 2] + GRAVITY
            thrust[m] = math.sqrt(a * a + b * b + c * c)
            axis = a / thrust[m], b / thrust[m], c / thrust[m]
            attitude = hopf_quaternion(axis, math.cos(half), math.sin(half))
            attitudes[k, m, 0], attitudes[k, m, 1], attitudes[k, m, 2], attitudes[k, m, 3] = attitude
        for m in range(length):
            periods = 1.0 if m == 0 or m == length - 1 else 2.0
            _write_turn(turning[m], attitudes[k, max(m - 1, 0)], attitudes[k, min(m + 1, length - 1)], rate / periods)
        for m in range(length):
            for i in range(3):
                later, before = _between(turning, m + leads[0], i), _between(turning, m - leads[0], i)
                rates[k, m, i] = LEADING_WEIGHT * later + (1.0 - LEADING_WEIGHT) * before
            place = min(m + leads[1], length - 1.0)
            row = int(place)
            after, between = min(row + 1, length - 1), place - row
            scale = (thrust[row] + between * (thrust[after] - thrust[row])) / thrust[m]
            sent[k, m, 0], sent[k, m, 1] = scale * made[k, m, 0], scale * made[k, m, 1]
            sent[k, m, 2] = scale * (made[k, m, 2] + GRAVITY) - GRAVITY
        rates[k, length - 1] = 0.0  # the vehicle may be left with the last setpoint
    return places, speeds, sent, attitudes, rates, made


@register_jitable
def _between(values: NDArray, place: float, column: int) -> float:
    """Return what is between two rows of (M, K) values; the first and the last hold."""
    place = min(max(place, 0.0), len(values) - 1.0)
    row = int(place)
    after = min(row + 1, len(values) - 1)
    return values[row, column] + (place - row) * (values[after, column] - values[row, column])


@register_jitable
def _write_turn(out: NDArray, before: NDArray, after: NDArray, rate: float) -> None:
    """Write the turn, (3,), from one attitude to another, (4,) each, times a rate."""
    x0, y0, z0, w0 = before[0], before[1], before[2], before[3]
    x1, y1, z1, w1 = after[0], after[1], after[2], after[3]
    x = w0 * x1 - w1 * x0 - (y0 * z1 - z0 * y1)
    y = w0 * y1 - w1 * y0 - (z0 * x1 - x0 * z1)
    z = w0 * z1 - w1 * z0 - (x0 * y1 - y0 * x1)
    scalar = w0 * w1 + x0 * x1 + y0 * y1 + z0 * z1
    sine = math.sqrt(x * x + y * y + z * z)
    angle = 2.0 * math.atan2(sine, abs(scalar))
    scale = (-angle if scalar < 0.0 else angle) / max(sine, 1e-12) * rate
    out[0], out[1], out[2] = x * scale, y * scale, z * scale
