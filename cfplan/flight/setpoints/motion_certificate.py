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
from typing import Any

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
from cfplan.vehicle.flatness import ROUNDING
from cfplan.vehicle.panels import LANES
from cfplan.vehicle.rotations import Vector, cross, dot, heading_of

SPAN = 2  # setpoints before and after one whose velocities give its acceleration
_WIDTH = 128  # places in a row of a panel
_MOST = 120  # setpoints processed at once; their neighbours take the other places
_LARGE = 1e9  # in place of NaN and of larger values
# Rows of the panel of 16-bit words: position, velocity (beginning SPAN setpoints earlier), acceleration, body rate, and
# the quaternion's lower and upper half.
_PLACE, _SPEED, _FORCE, _RATE, _TURN, _WORDS = 0, 3, 6, 9, 12, 14
# Rows of the panel of running maxima: the measures, then other values; those whose minimum counts are negated.
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
    panel, words = np.full(_ROWS * _WIDTH, -_LARGE), np.zeros(_WORDS * _WIDTH, dtype=np.int16)
    _raise_by_runs(
        panel, words, _read_only(runs.reshape(len(runs), -1)), _read_only(before),
        runs.shape[1] if end is None else end, airframe.drag[0] / airframe.mass, FIRMWARE_GAINS.full_rate,
        moment_rates(airframe),
    )  # fmt: skip
    worst = panel.reshape(_ROWS, _WIDTH).max(axis=1)
    high = worst[: of.MEASURES].copy()
    high[of.ANGULAR_ACCELERATION] = np.nan
    low = np.full(of.MEASURES, np.nan)
    low[of.SPECIFIC_THRUST] = -worst[_LEAST_THRUST]
    # Torque divides the thrust among the motors: one gives the mean or more, and one the mean or less.
    for each, thrust in ((high, high[of.SPECIFIC_THRUST]), (low, low[of.SPECIFIC_THRUST])):
        each[of.MOTOR_THRUST : of.MOTOR_THRUST + 4] = thrust * airframe.mass / 4
    corners = np.array([-worst[_LOW:_ROWS], worst[_HIGH:_LOW]])
    turn = math.acos(max(1.0 - worst[_TURNED], -1.0))
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


@njit(error_model="numpy", fastmath=ROUNDING, allocates=False)
def _raise_by_runs(
    worst: NDArray, words: NDArray, runs: NDArray, before: NDArray, end: int, drag: float, full_rate: float,
    moment: tuple[float, float],
) -> None:  # fmt: skip
    """Update the panel of running maxima, (_ROWS * _WIDTH,), with rows before `end` of all runs, (R, L * 29)."""
    for r in range(len(runs)):
        if r > 0 and _is_left_of(runs[r], runs[r - 1]):
            continue  # all its rows have been processed
        begin = 0
        while begin < end:
            lanes = min(end - begin, _MOST) // LANES * LANES
            if lanes == 0:  # process some rows again rather than the last few one by one
                begin = max(end - LANES, 0)
                lanes = end - begin
            _take_words(words, runs[r], before[r : r + SPAN], begin, lanes)
            _raise_all(worst, words, lanes, drag, full_rate, moment)
            begin += lanes


@register_jitable
def _is_left_of(run: NDArray, other: NDArray) -> bool:
    """Return whether a run is the rest of another from its second row on, as for stops within a stop."""
    last = len(run) - PAYLOAD_SIZE
    differs = np.uint8(0)
    for at in range(PAYLOAD_SIZE):
        differs = np.uint8(differs | (run[at] ^ other[min(at + PAYLOAD_SIZE, len(run) - 1)]))
    if differs:  # the usual case, in which little is compared
        return False
    for at in range(last):
        differs = np.uint8(differs | (run[at] ^ other[at + PAYLOAD_SIZE]))
    for at in range(last, len(run)):
        differs = np.uint8(differs | (run[at] ^ other[at]))
    return differs == 0


@register_jitable
def _take_words(words: NDArray, run: NDArray, before: NDArray, begin: int, lanes: int) -> None:
    """Write `lanes` rows of a run from `begin` on to the panel, and the fields of their neighbours that count."""
    last = len(run) // PAYLOAD_SIZE - 1
    for n in range(lanes):
        row = PAYLOAD_SIZE * min(begin + n, last)
        for axis in range(3):
            words[(_PLACE + axis) * _WIDTH + n] = _word(run, row + FIELD_PLACES[0] + 2 * axis)
            words[(_SPEED + axis) * _WIDTH + n + SPAN] = _word(run, row + FIELD_PLACES[1] + 2 * axis)
            words[(_FORCE + axis) * _WIDTH + n] = _word(run, row + FIELD_PLACES[2] + 2 * axis)
            words[(_RATE + axis) * _WIDTH + n] = _word(run, row + FIELD_PLACES[3] + 2 * axis)
        words[_TURN * _WIDTH + n] = _word(run, row + QUATERNION_PLACE)
        words[(_TURN + 1) * _WIDTH + n] = _word(run, row + QUATERNION_PLACE + 2)
    ahead = PAYLOAD_SIZE * min(begin + lanes, last) + QUATERNION_PLACE
    words[_TURN * _WIDTH + lanes], words[(_TURN + 1) * _WIDTH + lanes] = _word(run, ahead), _word(run, ahead + 2)
    for axis in range(3):
        place, speed = FIELD_PLACES[0] + 2 * axis, FIELD_PLACES[1] + 2 * axis
        words[(_PLACE + axis) * _WIDTH + lanes] = _word(run, PAYLOAD_SIZE * min(begin + lanes, last) + place)
        for n in range(SPAN):
            ahead, behind = PAYLOAD_SIZE * min(begin + lanes + n, last), begin + n - SPAN
            velocity = _word(before[begin + n], speed) if behind < 0 else _word(run, PAYLOAD_SIZE * behind + speed)
            words[(_SPEED + axis) * _WIDTH + n] = velocity
            words[(_SPEED + axis) * _WIDTH + lanes + SPAN + n] = _word(run, ahead + speed)


@register_jitable(forceinline=True)
def _word(run: NDArray, at: int) -> Any:
    return np.int16(np.uint16(run[at]) | np.uint16(np.uint16(run[at + 1]) << np.uint16(8)))


@register_jitable(fastmath=ROUNDING)
def _raise_all(
    worst: NDArray, words: NDArray, lanes: int, drag: float, full_rate: float, moment: tuple[float, float]
) -> None:
    lanes = min(lanes, _MOST)  # the compiler must see that no index overflows
    for n in range(lanes):
        _raise_worst(worst, words, n, drag, full_rate, moment)


@register_jitable(forceinline=True, fastmath=ROUNDING)
def _raise_worst(
    worst: NDArray, words: NDArray, n: int, drag: float, full_rate: float, moment: tuple[float, float]
) -> None:
    """Update the running maxima with one setpoint."""
    place, place_ahead = _triple(words, _PLACE, n), _triple(words, _PLACE, n + 1)
    velocity, velocity_ahead = _triple(words, _SPEED, n + SPAN), _triple(words, _SPEED, n + SPAN + 1)
    earlier, later = _triple(words, _SPEED, n), _triple(words, _SPEED, n + 2 * SPAN)
    over, half = RATE / (2 * SPAN), 0.5 / RATE
    acceleration = (later[0] - earlier[0]) * over, (later[1] - earlier[1]) * over, (later[2] - earlier[2]) * over
    x, y, z = acceleration
    force = x + drag * velocity[0], y + drag * velocity[1], z + drag * velocity[2] + GRAVITY
    x, y, z = force
    inverse = 1.0 / math.sqrt(dot(force, force))
    axis = x * inverse, y * inverse, z * inverse
    x, y, z = _triple(words, _FORCE, n)
    sent = x, y, z + GRAVITY
    scale, lean = full_rate / math.sqrt(dot(sent, sent)), cross(axis, sent)
    traded = scale * lean[0], scale * lean[1], scale * lean[2]
    rate_x, rate_y, rate_z = _body_rate(traded, sent, velocity, moment, words, n, full_rate)
    thrust = dot(axis, sent)

    _raise(worst, of.ACCELERATION, n, dot(acceleration, acceleration))
    _raise(worst, of.BODY_RATE, n, rate_x * rate_x + rate_y * rate_y + rate_z * rate_z)
    _raise(worst, of.TILT, n, (1.0 - axis[2]) / (1.0 + axis[2]))
    _raise(worst, of.SPECIFIC_THRUST, n, thrust)
    _raise(worst, _LEAST_THRUST, n, -thrust)
    _raise(worst, _TRADED, n, dot(traded, traded))
    (cos, sin), (cos_ahead, sin_ahead) = _heading(words, n), _heading(words, n + 1)
    norm = math.sqrt((cos * cos + sin * sin) * (cos_ahead * cos_ahead + sin_ahead * sin_ahead))
    _raise(worst, _TURNED, n, 1.0 - (cos * cos_ahead + sin * sin_ahead) / norm)
    _raise(worst, of.SPEED, n, dot(velocity, velocity))
    _raise_place(worst, 0, n, place[0], place_ahead[0], half * (velocity[0] + velocity_ahead[0]))
    _raise_place(worst, 1, n, place[1], place_ahead[1], half * (velocity[1] + velocity_ahead[1]))
    _raise_place(worst, 2, n, place[2], place_ahead[2], half * (velocity[2] + velocity_ahead[2]))


@register_jitable(forceinline=True)
def _raise_place(worst: NDArray, axis: int, n: int, here: float, ahead: float, way: float) -> None:
    """Update the running maxima with a coordinate of a setpoint and of the next, and the way that velocities give."""
    _raise(worst, _JUMP, n, abs(ahead - here - way))
    _raise(worst, _HIGH + axis, n, here)
    _raise(worst, _LOW + axis, n, -here)


@register_jitable(forceinline=True, fastmath=ROUNDING)
def _body_rate(
    traded: Vector,
    sent: Vector,
    velocity: Vector,
    moment: tuple[float, float],
    words: NDArray,
    n: int,
    full_rate: float,
) -> Vector:
    """Return the body rates, rad/s, that a setpoint makes the vehicle fly; `traded` are those sent as a turn.

    Those that hold the body against the air, `moment` for each m/s, are taken off; vectors are in world axes.
    """
    cos, sin = _heading(words, n)
    a, b, c = sent
    left = -c * sin, c * cos, a * sin - b * cos  # the controller's y axis, and x is left × sent
    ahead = cross(left, sent)
    across, along = 1.0 / math.sqrt(dot(left, left)), 1.0 / math.sqrt(dot(ahead, ahead))
    about_x, about_y = dot(traded, ahead) * along, dot(traded, left) * across
    sent_x, sent_y, about_z = _triple(words, _RATE, n)
    believed = 1.0 / (1.0 - ATTITUDE_AGE * full_rate)
    held_x, held_y = moment[0] * dot(velocity, left) * across, moment[1] * dot(velocity, ahead) * along
    return (sent_x + about_x) * believed - held_x, (sent_y + about_y) * believed - held_y, about_z


@register_jitable(forceinline=True)
def _heading(words: NDArray, n: int) -> tuple[float, float]:
    """Return the horizontal components of the body's x axis that a setpoint asks for."""
    lower, upper = int(words[_TURN * _WIDTH + n]) & 0xFFFF, int(words[(_TURN + 1) * _WIDTH + n]) & 0xFFFF
    return heading_of(decompressed(upper << 16 | lower))


@register_jitable(forceinline=True)
def _triple(words: NDArray, row: int, n: int) -> Vector:
    """Return the values of three rows at a place, in m, m/s, m/s² or rad/s."""
    return (
        1e-3 * words[row * _WIDTH + n],
        1e-3 * words[(row + 1) * _WIDTH + n],
        1e-3 * words[(row + 2) * _WIDTH + n],
    )


@register_jitable(forceinline=True)
def _raise(worst: NDArray, row: int, n: int, value: float) -> None:
    """Update the running maximum at a place; NaN is larger than any number."""
    before = worst[row * _WIDTH + n]
    value = value if value < _LARGE else _LARGE
    worst[row * _WIDTH + n] = value if value > before else before
