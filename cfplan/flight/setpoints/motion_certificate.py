"""Motion certificate: holds the motion that setpoints ask for against limits, by their bytes alone, without the plan.

The velocities SPAN setpoints before and after a setpoint give its acceleration. Acceleration, gravity and drag give the
thrust vector of the motion, whose direction is the axis z of the attitude to fly. The thrust vector that is sent leans
away from z, by the turn that replaces traded rates (see rate_trade.py). With f the thrust vector sent, K = 2 kR / kw,
and τ the age of the attitude that the controller believes,

    thrust     T = f · z
    body rate  ω = (ω_sent + K z × f / |f|) / (1 - K τ)        about body x and y; about z it is ω_sent

less the rates that hold the body against the air, where the denominator compensates for that age. For the bytes of a
certified plan or stop, these values are the certified ones within TOLERANCES.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.flight.setpoints.encoding import RATE
from cfplan.flight.setpoints.packets import FIELD_PLACES, PAYLOAD_SIZE, QUATERNION_PLACE, decompressed
from cfplan.flight.setpoints.rate_trade import ATTITUDE_AGE, FIRMWARE_GAINS, TRADED_RATE_MAX, moment_rates
from cfplan.machine_code import njit
from cfplan.safety.limits import Limits
from cfplan.safety.quantities import AT_MOST, QUANTITIES
from cfplan.vehicle import measures as of
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.rotations import Vector, cross, dot, heading_of

SPAN = 2  # setpoints before and after one whose velocities give its acceleration
_REPLACEMENT = 1e9  # in place of NaN and of larger values
_PLACE, _SPEED, _FORCE, _RATE = FIELD_PLACES  # bytes at which position, velocity, acceleration and body rate begin
# Rows of the running maxima: the measures, then other values; those whose minimum counts are negated.
_LEAST_THRUST, _TRADED, _JUMP, _TURNED = of.MEASURES, of.MEASURES + 1, of.MEASURES + 2, of.MEASURES + 3
_HIGH, _LOW, _ROWS = of.MEASURES + 4, of.MEASURES + 7, of.MEASURES + 10
TOLERANCES = {"m/s": 1e-3, "m/s²": 0.1, "rad": math.radians(0.5), "rad/s": 0.3, "N": 1e-3}
"""By unit, how far the bytes of a certified motion may seem to exceed a limit. Velocities rounded to 1 mm/s give the
acceleration within 0.043 m/s² and its direction within 0.25°. The largest excess of 48 plans at all kinds of limits was
0.018 m/s², 0.15° and 0.02 rad/s, and that of their stops 0.03 m/s², 0.13° and 0.1 rad/s."""
FASTEST_HEADING = 2.0  # times the largest body rate: how fast the heading of an attitude that leans by 60° may turn
LED_THRUST = 1.0  # m/s², more for acceleration in stops, whose thrust is sent ahead of the certified motion


@dataclass(frozen=True, slots=True, eq=False)
class MotionExtremes:
    """The worst values of runs of setpoints."""

    high: NDArray  # (MEASURES,), the largest value of each measure; NaN where bytes do not determine it
    low: NDArray  # (MEASURES,), the least value of each measure
    traded: float  # rad/s, the largest body rate that is sent as a turn of the thrust
    turn: float  # rad, the largest turn of the heading between two setpoints
    jump: float  # m, the largest difference of a step in position from the one that velocities give
    corners: NDArray  # (2, 3) m, the least and the largest coordinates


def motion_extremes(runs: NDArray, before: NDArray, airframe: Airframe, end: int | None = None) -> MotionExtremes:
    """Return the worst values of rows before `end` of runs of setpoints, (R, L, 29) uint8, R and L at least 1.

    Run r follows the setpoints r to r + SPAN of `before`, (R + SPAN, 29) or more; its last row is repeated behind it.
    """
    worst = np.full(_ROWS, -_REPLACEMENT)
    vehicle = _Vehicle(airframe.drag[0] / airframe.mass, FIRMWARE_GAINS.full_rate, moment_rates(airframe))
    _raise_by_runs(worst, _read_only(runs), _read_only(before), runs.shape[1] if end is None else end, vehicle)
    high = worst[: of.MEASURES].copy()
    high[of.ANGULAR_ACCELERATION] = np.nan
    low = np.full(of.MEASURES, np.nan)
    low[of.SPECIFIC_THRUST] = -worst[_LEAST_THRUST]
    # Torque divides the thrust among the motors: one gives the mean or more, and one the mean or less.
    for each, thrust in ((high, high[of.SPECIFIC_THRUST]), (low, low[of.SPECIFIC_THRUST])):
        each[of.MOTOR_THRUST : of.MOTOR_THRUST + 4] = thrust * airframe.mass / 4
    corners = np.array([-worst[_LOW:_ROWS], worst[_HIGH:_LOW]])
    turn = math.acos(min(max(1.0 - worst[_TURNED], -1.0), 1.0))
    return MotionExtremes(high, low, math.sqrt(worst[_TRADED]), turn, float(worst[_JUMP]), corners)


def excess_of(worst: MotionExtremes, limits: Limits, *, in_stop: bool) -> str:
    """Return which limit of plans, or `in_stop` of stops, a motion exceeds, and its value there; empty if none."""
    if not worst.traded <= TRADED_RATE_MAX + TOLERANCES["rad/s"]:
        return f"sends {worst.traded:.3g} rad/s as a turn of the thrust; it may be at most {TRADED_RATE_MAX:.3g}"
    most = FASTEST_HEADING * limits.plan.angular_velocity / RATE
    if not worst.turn <= most:
        return f"turns the heading by {math.degrees(worst.turn):.3g}°; it may be at most {math.degrees(most):.3g}"
    for quantity in QUANTITIES:
        if quantity.measure == of.ANGULAR_ACCELERATION or (in_stop and quantity.in_stop is None):
            continue
        limit = quantity.in_stop(limits) if in_stop and quantity.in_stop else quantity.allowed(limits.plan)
        value = float(quantity.worst(worst.high if quantity.side == AT_MOST else worst.low))
        tolerance = TOLERANCES[quantity.unit] + (LED_THRUST if in_stop and quantity.measure == of.ACCELERATION else 0.0)
        if not quantity.excess(value, limit) <= tolerance:
            side, unit = "at most" if quantity.side == AT_MOST else "at least", quantity.unit
            if unit == "rad":
                value, limit, unit = math.degrees(value), math.degrees(limit), "°"
            article = "an" if quantity.noun[0] in "aeiou" else "a"
            return f"reaches {article} {quantity.noun} of {value:.3g} {unit}; it may be {side} {limit:.3g}"
    return ""


def _read_only(array: NDArray) -> NDArray:
    """Return a read-only view: for writable arrays, another variant of the code would be compiled."""
    view = np.ascontiguousarray(array).view()
    view.setflags(write=False)
    return view


class _Vehicle(NamedTuple):
    """The constants of a vehicle that the motion of its setpoints depends on."""

    drag: float  # 1/s, over its mass
    full_rate: float  # rad/s, K
    moment_rates: tuple[float, float]  # rad/s per m/s, as AttitudeGains has them


@njit(error_model="numpy", allocates=False)
def _raise_by_runs(worst: NDArray, runs: NDArray, before: NDArray, end: int, vehicle: _Vehicle) -> None:
    """Update the running maxima, (_ROWS,), with rows before `end` of all runs, (R, L, 29)."""
    for r in range(len(runs)):
        if r == 0 or not _is_left_of(runs[r], runs[r - 1]):  # else all its rows have been processed
            for row in range(end):
                _raise_worst(worst, runs[r], before[r : r + SPAN], row, vehicle)


@register_jitable
def _is_left_of(run: NDArray, other: NDArray) -> bool:
    """Return whether a run is the rest of another from its second row on, as for stops within a stop."""
    last = len(run) - 1
    for row in range(len(run)):
        for byte in range(PAYLOAD_SIZE):
            if run[row, byte] != other[min(row + 1, last), byte]:
                return False
    return True


@register_jitable(forceinline=True)
def _raise_worst(worst: NDArray, run: NDArray, before: NDArray, row: int, vehicle: _Vehicle) -> None:
    """Update the running maxima with one setpoint."""
    ahead = min(row + 1, len(run) - 1)
    place, place_ahead = _triple(run[row], _PLACE), _triple(run[ahead], _PLACE)
    velocity, velocity_ahead = _triple(run[row], _SPEED), _triple(run[ahead], _SPEED)
    later = _triple(run[min(row + SPAN, len(run) - 1)], _SPEED)
    earlier = _triple(run[row - SPAN] if row >= SPAN else before[row], _SPEED)
    over, half = RATE / (2 * SPAN), 0.5 / RATE
    x, y, z = (later[0] - earlier[0]) * over, (later[1] - earlier[1]) * over, (later[2] - earlier[2]) * over
    _raise(worst, of.ACCELERATION, x * x + y * y + z * z)
    drag = vehicle.drag
    force = x + drag * velocity[0], y + drag * velocity[1], z + drag * velocity[2] + GRAVITY
    inverse = 1.0 / math.sqrt(dot(force, force))
    axis = force[0] * inverse, force[1] * inverse, force[2] * inverse
    x, y, z = _triple(run[row], _FORCE)
    sent = x, y, z + GRAVITY
    scale, lean = vehicle.full_rate / math.sqrt(dot(sent, sent)), cross(axis, sent)
    traded = scale * lean[0], scale * lean[1], scale * lean[2]
    heading, heading_ahead = _heading(run[row]), _heading(run[ahead])
    thrust, rate = dot(axis, sent), _body_rate(run[row], heading, traded, sent, velocity, vehicle)

    _raise(worst, of.BODY_RATE, dot(rate, rate))
    _raise(worst, of.TILT, (1.0 - axis[2]) / (1.0 + axis[2]))
    _raise(worst, of.SPECIFIC_THRUST, thrust)
    _raise(worst, _LEAST_THRUST, -thrust)
    _raise(worst, _TRADED, dot(traded, traded))
    (cos, sin), (cos_ahead, sin_ahead) = heading, heading_ahead
    norm = math.sqrt((cos * cos + sin * sin) * (cos_ahead * cos_ahead + sin_ahead * sin_ahead))
    _raise(worst, _TURNED, 1.0 - (cos * cos_ahead + sin * sin_ahead) / norm)
    _raise(worst, of.SPEED, dot(velocity, velocity))
    for k in range(3):
        _raise(worst, _JUMP, abs(place_ahead[k] - place[k] - half * (velocity[k] + velocity_ahead[k])))
        _raise(worst, _HIGH + k, place[k])
        _raise(worst, _LOW + k, -place[k])


@register_jitable(forceinline=True)
def _body_rate(
    payload: NDArray, heading: tuple[float, float], traded: Vector, sent: Vector, velocity: Vector, vehicle: _Vehicle
) -> Vector:
    """Return the body rates, rad/s, that a setpoint makes the vehicle fly; `traded` are those sent as a turn.

    Those that hold the body against the air are taken off; vectors are in world axes.
    """
    cos, sin = heading
    a, b, c = sent
    left = -c * sin, c * cos, a * sin - b * cos  # the controller's y axis, and x is left × sent
    ahead = cross(left, sent)
    across, along = 1.0 / math.sqrt(dot(left, left)), 1.0 / math.sqrt(dot(ahead, ahead))
    about_x, about_y = dot(traded, ahead) * along, dot(traded, left) * across
    sent_x, sent_y, about_z = _triple(payload, _RATE)
    believed = 1.0 / (1.0 - ATTITUDE_AGE * vehicle.full_rate)
    held_x = vehicle.moment_rates[0] * dot(velocity, left) * across
    held_y = vehicle.moment_rates[1] * dot(velocity, ahead) * along
    return (sent_x + about_x) * believed - held_x, (sent_y + about_y) * believed - held_y, about_z


@register_jitable(forceinline=True)
def _heading(payload: NDArray) -> tuple[float, float]:
    """Return the horizontal components of the body's x axis that a setpoint asks for."""
    bits = 0
    for byte in range(4):
        bits |= int(payload[QUATERNION_PLACE + byte]) << (8 * byte)
    return heading_of(decompressed(bits))


@register_jitable(forceinline=True)
def _triple(payload: NDArray, place: int) -> Vector:
    """Return the three values that begin at a byte of a payload, in m, m/s, m/s² or rad/s."""
    return _milli(payload, place), _milli(payload, place + 2), _milli(payload, place + 4)


@register_jitable(forceinline=True)
def _milli(payload: NDArray, place: int) -> float:
    """Return the value of 16 bits, in thousandths."""
    bits = int(payload[place]) | int(payload[place + 1]) << 8
    return 1e-3 * (bits - 65536 if bits >= 32768 else bits)


@register_jitable(forceinline=True)
def _raise(worst: NDArray, row: int, value: float) -> None:
    """Update a running maximum; NaN is larger than any number."""
    worst[row] = max(worst[row], value if value < _REPLACEMENT else _REPLACEMENT)
