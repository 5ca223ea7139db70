"""The rate trade: body rates sent as a turn of the attitude, so that a vehicle whose setpoints stop levels out.

The Mellinger controller's torque about body x and y is 2 kR sin φ + kw (ω_sent - ω), φ being the turn from the attitude
to the wanted one. Any fraction of the rate can therefore be moved into the wanted attitude without changing the torque:

    Δ  = (ω - ω_sent)_xy                         ω: the rate to fly
    φ  = asin(|Δ| kw / 2kR) along Δ              in body axes, no z
    q̂  = q ⊗ exp(-τ ω_xy)                        the attitude that the controller believes: its filter's, of τ before
    q' = q̂ ⊗ exp(φ)                              sent instead of q
    a' = T / cos∠(z(q), z(q')) · z(q') - g       T: specific thrust; it acts along the true axis, hence the cosine

The roll and pitch rates that are sent are those that help once setpoints stop (level_out.py), and two bounds leave more
of the rate as a rate: φ grows to 90° as |Δ| nears 7 rad/s, so at most TRADED_RATE_MAX is traded; and z(q') may not lean
beyond LEAN_MAX, where little of the thrust carries the vehicle and the controller's heading is hardly defined. In the
axes of q̂, with n the direction of φ × z, and u the vertical in the plane of z and n,

    z(q')·u = u_n sin φ + u_z cos φ >= cos LEAN_MAX    ⟺    φ <= atan2(u_n, u_z) + acos(cos LEAN_MAX / |(u_n, u_z)|)

which changes steadily along a motion. If the attitude to fly itself leans that far, only righting rates are traded.

In flight the air turns the body in proportion to its velocity (Airframe.velocity_moment), and the controller must hold
against it. The rate that is traded is therefore ω + M v; with M v, kw gives exactly that torque.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.flight.firmware import MellingerGains
from cfplan.flight.setpoints.level_out import (
    BRAKE_LEAD,
    UNTIL_TIMEOUT,
    UNTIL_WATCHDOG,
    Faces,
    LevelOut,
    faces_of,
    helpful_rate,
    pull_of,
)
from cfplan.flight.setpoints.packets import FullStateSetpoints, arrays_of
from cfplan.machine_code import njit
from cfplan.safety.limits import Limits
from cfplan.safety.space import Space
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.rotations import Quaternion, matrices_of, norms, product

TRADED_RATE_MAX = 4.5  # rad/s; the excess is sent as a rate, as φ grows to 90° at 7 rad/s
LEAN_MAX = math.radians(60.0)  # of the thrust that is sent; plans under the shipped limits reach 45°
LEAST_LIFT = math.cos(LEAN_MAX)
ATTITUDE_AGE = 0.007
"""s, τ: age of the attitude by which the controller goes, as the firmware's filter predicts it every 10 ms only. In the
virtual vehicle it was 6.6 to 7.3 ms about roll and pitch, on three paths."""
_QUANTUM = 1e-3  # rad/s, of rates in a packet
_LONGEST_GAP = 0.05  # s between setpoints, after which they are read anew
_ROWS_AHEAD = 2  # of 10 ms, that rates are sent ahead


@dataclass(frozen=True, slots=True)
class AttitudeGains:
    """The firmware's attitude gains, by their names in the group ctrlMel, with the defaults there."""

    kR_xy: float = MellingerGains().kR_xy
    kw_xy: float = MellingerGains().kw_xy
    moment_rates: tuple[float, float] = (0.0, 0.0)
    """rad/s per m/s, M: rate about x by velocity along y, and about y by velocity along x, in body axes."""
    level_out: LevelOut = UNTIL_WATCHDOG

    @property
    def full_rate(self) -> float:
        """Return the rate, rad/s, that a turn of the attitude by 90° makes up for: 2 kR / kw."""
        return 2.0 * self.kR_xy / self.kw_xy


FIRMWARE_GAINS = AttitudeGains()
GAIN_TOLERANCE = 0.05
"""Fraction by which 2 kR / kw of a vehicle may differ from that of the packets; 10 % makes up to 3.1 cm deviation."""


def gains_under(limits: Limits) -> AttitudeGains:
    """Return the firmware's gains for an airframe, with level-out as long as safety.yaml lets it last."""
    level_out = UNTIL_WATCHDOG if limits.firmware.watchdog else UNTIL_TIMEOUT
    return replace(FIRMWARE_GAINS, moment_rates=moment_rates(limits.airframe), level_out=level_out)


def moment_rates(airframe: Airframe) -> tuple[float, float]:
    """Return the rates, rad/s per m/s, whose torque holds the body against the air; as AttitudeGains has them.

    The controller adds kw/2 to two motors and takes it from the others, in 16-bit units, for each rad/s.
    """
    per_thrust = airframe.command_per_thrust / (1.0 - airframe.thrust_curvature)  # of a change around hover
    torque = FIRMWARE_GAINS.kw_xy * airframe.arm / (2.0 * per_thrust)  # N m for each rad/s
    about_x, about_y = airframe.velocity_moment
    return -about_x / torque, about_y / torque


def held_against_air(motion: FullStateSetpoints, gains: AttitudeGains, sign: float = 1.0) -> FullStateSetpoints:
    """Return a motion with the rates to ask for instead of those to fly; with `sign` -1 the other way round."""
    if gains.moment_rates == (0.0, 0.0):
        return motion
    rate = np.array(motion.body_rate, dtype=float)
    along = np.einsum("nij,ni->nj", matrices_of(motion.quaternion), motion.velocity)  # in body axes
    rate[:, 0] += sign * gains.moment_rates[0] * along[:, 1]
    rate[:, 1] += sign * gains.moment_rates[1] * along[:, 0]
    return replace(motion, body_rate=rate)


def trade_rates(
    motion: FullStateSetpoints,
    acceleration_ahead: NDArray,
    gains: AttitudeGains = FIRMWARE_GAINS,
    space: Space | None = None,
) -> FullStateSetpoints:
    """Return setpoints with the same torque and thrust as the motion, but harmless roll and pitch rates.

    `motion` has the attitudes and rates to fly and, as acceleration, the thrust to give less gravity;
    `acceleration_ahead`, (N, 3) m/s², is that of the motion BRAKE_LEAD later; without a space there are no walls to
    lean away from. The rates come out in whole millirad/s, as packets hold them, and the attitudes make up for those.
    """
    rows = arrays_of(held_against_air(motion, gains))
    ahead = np.array(acceleration_ahead, dtype=float, order="C")
    rate, quaternion, acceleration = _traded(rows, ahead, faces_of(space), gains.level_out, gains.full_rate)
    return replace(motion, acceleration=acceleration, quaternion=quaternion, body_rate=rate)


@njit(error_model="numpy")
def _traded(
    motion: tuple[NDArray, ...], ahead: NDArray, faces: Faces, level_out: LevelOut, full_rate: float
) -> tuple[NDArray, NDArray, NDArray]:
    """Return the body rates (N, 3), attitudes (N, 4) and accelerations (N, 3) that are sent for a motion."""
    position, velocity, acceleration, quaternion, body_rate = motion
    rates, attitudes, accelerations = body_rate.copy(), np.empty_like(quaternion), np.empty_like(acceleration)
    for n in range(len(position)):
        attitude = (quaternion[n, 0], quaternion[n, 1], quaternion[n, 2], quaternion[n, 3])
        x, y = body_rate[n, 0], body_rate[n, 1]
        pull = pull_of(position[n], velocity[n], ahead[n], faces, level_out)
        helpful_x, helpful_y = helpful_rate(pull, attitude, full_rate, level_out.rate_max)
        back = _turn_back(x, y)
        fraction = _fraction_to_trade(product(attitude, back), x - helpful_x, y - helpful_y, full_rate)
        rates[n, 0] = math.floor((x - fraction * (x - helpful_x)) / _QUANTUM + 0.5) * _QUANTUM
        rates[n, 1] = math.floor((y - fraction * (y - helpful_y)) / _QUANTUM + 0.5) * _QUANTUM

        turn = product(back, _turn_for(x - rates[n, 0], y - rates[n, 1], full_rate))
        a, b, c, d = product(attitude, turn)
        attitudes[n, 0], attitudes[n, 1], attitudes[n, 2], attitudes[n, 3] = a, b, c, d
        fx, fy, fz = acceleration[n, 0], acceleration[n, 1], acceleration[n, 2] + GRAVITY
        cosine = 1.0 - 2.0 * (turn[0] * turn[0] + turn[1] * turn[1])  # between the axes of thrust
        thrust = math.sqrt(fx * fx + fy * fy + fz * fz) / cosine
        accelerations[n, 0] = thrust * 2.0 * (a * c + b * d)
        accelerations[n, 1] = thrust * 2.0 * (b * c - a * d)
        accelerations[n, 2] = thrust * (1.0 - 2.0 * (a * a + b * b)) - GRAVITY
    return rates, attitudes, accelerations


@register_jitable
def _fraction_to_trade(believed: Quaternion, x: float, y: float, full_rate: float) -> float:
    """Return which fraction of roll and pitch rates, rad/s, may be traded: up to the two bounds."""
    size = math.sqrt(x * x + y * y)
    if size == 0.0:
        return 1.0
    a, b, c, d = believed
    across = 2.0 * ((a * c - b * d) * y - (b * c + a * d) * x) / size  # u_n
    lift = 1.0 - 2.0 * (a * a + b * b)  # u_z
    most = min(size, TRADED_RATE_MAX)
    sine = most / full_rate  # sin φ
    if across * sine + lift * math.sqrt(1.0 - sine * sine) >= LEAST_LIFT:  # the usual case, in which no angle is needed
        return most / size
    reached = math.sqrt(across * across + lift * lift)
    widest = math.atan2(across, lift)
    if reached > LEAST_LIFT:
        widest += math.acos(LEAST_LIFT / reached)
    return min(most, full_rate * math.sin(min(max(widest, 0.0), 0.5 * math.pi))) / size


@register_jitable
def _turn_for(x: float, y: float, full_rate: float) -> Quaternion:
    """Return the turn whose torque is that of roll and pitch rates, rad/s."""
    sine = min(math.sqrt(x * x + y * y) / full_rate, 1.0)
    half = math.sqrt(0.5 + 0.5 * math.sqrt(1.0 - sine * sine))  # the cosine of half of it
    return _turn(x, y, 0.5 * sine / half, half)


@register_jitable
def _turn_back(x: float, y: float) -> Quaternion:
    """Return the turn from the attitude to the one that the controller believes, by roll and pitch rates, rad/s."""
    half = -0.5 * ATTITUDE_AGE * math.sqrt(x * x + y * y)
    return _turn(x, y, math.sin(half), math.cos(half))


@register_jitable
def _turn(x: float, y: float, sin_half: float, cos_half: float) -> Quaternion:
    """Return the quaternion of a turn about (x, y, 0), by sine and cosine of half its angle."""
    size = math.sqrt(x * x + y * y)
    scale = sin_half / size if size > 0.0 else 0.0
    return scale * x, scale * y, 0.0, cos_half


def turns_for(rate: NDArray, gains: AttitudeGains = FIRMWARE_GAINS) -> NDArray:
    """Return the rotation vectors φ, (N, 3) rad in body axes, that make up for roll and pitch rates, (N, 2) rad/s."""
    size = norms(rate)
    angle = np.arcsin(np.minimum(size / gains.full_rate, 1.0))
    scale = np.where(size > 0.0, angle / np.where(size > 0.0, size, 1.0), 0.0)
    return np.concatenate([rate * scale[:, None], np.zeros((len(rate), 1))], axis=1)


def ahead(acceleration: NDArray, rate: float) -> NDArray:
    """Return accelerations, (..., N, 3) at `rate`, Hz, as they are BRAKE_LEAD later; the last one holds."""
    place = np.minimum(np.arange(acceleration.shape[-2]) + round(BRAKE_LEAD * rate), acceleration.shape[-2] - 1)
    return acceleration[..., place, :]


def motion_of_sent(
    times: NDArray, acceleration: NDArray, attitude: NDArray, body_rate: NDArray, gains: AttitudeGains = FIRMWARE_GAINS
) -> tuple[NDArray, NDArray, NDArray]:
    """Return the attitudes (N, 4), accelerations (N, 3) and body rates (N, 3) that setpoints sent at `times`, s, mean.

    For people to see, of setpoints alone: the attitude turns at the rates that it is asked for, which soon forgets how
    it began. `attitude`, (N, 4), is what the controller makes of each. Setpoints whose rates are not traded mean what
    they say.
    """
    return _meant(
        *(np.array(each, dtype=float) for each in (times, acceleration, attitude, body_rate)), gains.full_rate
    )


@njit(error_model="numpy")
def _meant(
    times: NDArray, acceleration: NDArray, attitude: NDArray, body_rate: NDArray, full_rate: float
) -> tuple[NDArray, NDArray, NDArray]:
    attitudes, accelerations, rates = attitude.copy(), acceleration.copy(), body_rate.copy()
    now = (0.0, 0.0, 0.0, 1.0)
    for n in range(len(times)):
        step = times[n] - times[n - 1] if n > 0 else _LONGEST_GAP
        if 0.0 < step < _LONGEST_GAP:
            wx, wy, wz = rates[max(n - _ROWS_AHEAD, 0)]  # rates are sent ahead
            size = math.sqrt(wx * wx + wy * wy + wz * wz)
            share = math.sin(0.5 * size * step) / size if size > 0.0 else 0.0
            now = product(now, (wx * share, wy * share, wz * share, math.cos(0.5 * size * step)))
        else:
            now = (attitude[n, 0], attitude[n, 1], attitude[n, 2], attitude[n, 3])
        x, y, z, w = now
        asked = product((-x, -y, -z, w), attitude[n])
        sine = 2.0 * asked[3]  # of the turn from here to what is asked for, about x and y
        rates[n, 0] += full_rate * sine * asked[0]
        rates[n, 1] += full_rate * sine * asked[1]
        fx, fy, fz = acceleration[n, 0], acceleration[n, 1], acceleration[n, 2] + GRAVITY
        ax, ay, az = 2.0 * (x * z + y * w), 2.0 * (y * z - x * w), 1.0 - 2.0 * (x * x + y * y)
        thrust = fx * ax + fy * ay + fz * az
        accelerations[n, 0], accelerations[n, 1], accelerations[n, 2] = thrust * ax, thrust * ay, thrust * az - GRAVITY
        for k in range(4):
            attitudes[n, k] = now[k]
    return attitudes, accelerations, rates
