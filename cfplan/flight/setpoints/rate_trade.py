"""The rate trade: body rates sent as a turn of the attitude, so that a vehicle whose setpoints stop levels out.

The Mellinger controller's torque about body x and y is 2 kR sin φ + kw (ω_sent - ω), φ being the turn from the attitude
to the wanted one. Any fraction of the rate can therefore be moved into the wanted attitude without changing the torque:

    Δ  = (ω - ω_sent)_xy                         ω: the rate to fly
    φ  = asin(|Δ| kw / 2kR) along Δ              in body axes, no z
    q̂  = q ⊗ exp(-τ ω_xy)                        the attitude that the controller believes: its filter's, of τ before
    q' = q̂ ⊗ exp(φ)                              sent instead of q
    a' = T / cos∠(z(q), z(q')) · z(q') - g       T: specific thrust; it acts along the true axis, hence the cosine

This matters once setpoints stop: the firmware then wants a level attitude, yet keeps the last roll and pitch rates, and
settles at a tilt of asin(ω_sent kw / 2kR), which at 3 rad/s is 25°. So the only rates sent are those whose tilt helps:
it brakes the horizontal speed that remains after the vehicle has first held its last place for half a second, v_left =
0.41 v + 0.089 s · a(t + 0.15 s). Within 1.5 m of a wall it leans away from it, more so the nearer the wall, so that an
error of its attitude does not carry it there; it leans away from obstacles as well.
How much depends on how long level-out lasts until the motors stop (LevelOut).

Two bounds leave more of the rate as a rate: φ grows to 90° as |Δ| nears 7 rad/s, so at most TRADED_RATE_MAX is traded;
and z(q') may not lean beyond LEAN_MAX, where little of the thrust carries the vehicle and the controller's heading is
hardly defined. In the axes of q̂, with n the direction of φ × z, and u the vertical in the plane of z and n,

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
from cfplan.flight.setpoints.packets import FullStateSetpoints
from cfplan.machine_code import njit
from cfplan.safety.limits import Limits
from cfplan.safety.space import Space
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.panels import (
    WIDTH,
    give_out,
    lanes_for,
    pair_in,
    quaternion_in,
    take_in,
    triple_in,
    write_pair,
    write_quaternion_in,
    write_triple,
)
from cfplan.vehicle.rotations import dot, heading_of, matrices_of, matrix_rows, norms, product, transpose, turn_rows
from cfplan.vehicle.trigonometry import cosine, sine

BRAKE_LEAD = 0.15  # s by which the acceleration in the formula of the remaining speed is ahead of the setpoint
SPEED_LEFT = 0.41  # fraction of the velocity that remains when the firmware begins to level out
SPEED_GAINED = 0.089  # s, speed gained until then for each m/s² of acceleration
WALL_LEAD = 0.3  # s by which the place whose distance to walls counts is ahead of the setpoint
TRADED_RATE_MAX = 4.5  # rad/s; the excess is sent as a rate, as φ grows to 90° at 7 rad/s
LEAN_MAX = math.radians(60.0)  # of the thrust that is sent; plans under the shipped limits reach 45°
_LEAST_LIFT = math.cos(LEAN_MAX)
ATTITUDE_AGE = 0.007
"""s, τ: age of the attitude by which the controller goes, as the firmware's filter predicts it every 10 ms only. In the
virtual vehicle it was 6.6 to 7.3 ms about roll and pitch, on three paths."""
_QUANTUM = 1e-3  # rad/s, of rates in a packet
_LONGEST_GAP = 0.05  # s between setpoints, after which they are read anew
_ROWS_AHEAD = 2  # of 10 ms, that rates are sent ahead


@dataclass(frozen=True, slots=True)
class LevelOut:
    """Parameters of level-out, by its duration until the motors stop."""

    braking: float  # 1/s, deceleration over the speed left
    rate_max: float  # rad/s, of the rates that are sent for it
    wall_reach: float  # m from a wall, within which it leans away from it
    wall_stiffness: float  # 1/s², acceleration away from a wall for each m nearer than that
    wall_pull_max: float  # m/s², of that acceleration

    def pack(self) -> NDArray:
        """Return (5,), in the order of the fields."""
        return np.array([self.braking, self.rate_max, self.wall_reach, self.wall_stiffness, self.wall_pull_max])


# Half a second, at up to 13° of tilt; and 1.5 s, at up to 5°.
UNTIL_WATCHDOG = LevelOut(braking=2.0, rate_max=1.6, wall_reach=1.5, wall_stiffness=1.2, wall_pull_max=1.6)
UNTIL_TIMEOUT = LevelOut(braking=1.0, rate_max=0.6, wall_reach=1.5, wall_stiffness=0.35, wall_pull_max=0.45)


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


GAIN_TOLERANCE = 0.05
"""Fraction by which 2 kR / kw of a vehicle may differ from that of the packets; 10 % makes up to 3.1 cm deviation."""


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
    motion = held_against_air(motion, gains)
    rate, quaternion, acceleration = _traded(
        np.array(motion.position, dtype=float, order="C"),
        np.array(motion.velocity, dtype=float, order="C"),
        np.array(motion.acceleration, dtype=float, order="C"),
        np.array(acceleration_ahead, dtype=float, order="C"),
        np.array(motion.quaternion, dtype=float, order="C"),
        np.array(motion.body_rate, dtype=float, order="C"),
        _walls(space),
        _off_obstacles(motion, space, gains.level_out),
        gains.full_rate,
        gains.level_out.pack(),
    )
    return replace(motion, acceleration=acceleration, quaternion=quaternion, body_rate=rate)


def harmless_rates(
    motion: FullStateSetpoints,
    acceleration_ahead: NDArray,
    gains: AttitudeGains = FIRMWARE_GAINS,
    space: Space | None = None,
) -> NDArray:
    """Return the roll and pitch rates to send, (N, 2) rad/s: those that do good, and what must not be traded.

    The check of the bytes compares with these, so they are computed apart from trade_rates, from a(t) to tilt to rate.
    """
    motion = held_against_air(motion, gains)
    return _harmless(
        np.array(motion.position, dtype=float, order="C"),
        np.array(motion.velocity, dtype=float, order="C"),
        np.array(acceleration_ahead, dtype=float, order="C"),
        np.array(motion.quaternion, dtype=float, order="C"),
        np.array(motion.body_rate, dtype=float, order="C"),
        _walls(space),
        _off_obstacles(motion, space, gains.level_out),
        gains.full_rate,
        gains.level_out.pack(),
    )


def turns_for(rate: NDArray, gains: AttitudeGains = FIRMWARE_GAINS) -> NDArray:
    """Return the rotation vectors φ, (N, 3) rad in body axes, that make up for roll and pitch rates, (N, 2) rad/s."""
    size = norms(rate)
    angle = np.arcsin(np.minimum(size / gains.full_rate, 1.0))
    share = np.where(size > 0.0, angle / np.where(size > 0.0, size, 1.0), 0.0)
    return np.concatenate([rate * share[:, None], np.zeros((len(rate), 1))], axis=1)


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


def _walls(space: Space | None) -> NDArray:
    """Return (2, 2) m: x and y of the low walls and of the high ones."""
    return np.array([space.low[:2], space.high[:2]]) if space else np.array([[-np.inf] * 2, [np.inf] * 2])


def _off_obstacles(motion: FullStateSetpoints, space: Space | None, goal: LevelOut) -> NDArray:
    """Return the accelerations, (N, 2) m/s², away from obstacles, as large as from a wall at the same distance."""
    if space is None or not space.obstacles:
        return np.zeros((len(motion.position), 2))
    soon = np.array(motion.position, dtype=float)
    soon[:, :2] += WALL_LEAD * motion.velocity[:, :2]
    prisms = np.array([each.prism for each in space.obstacles])
    return _pushed_off(soon, prisms, goal.pack())


@njit(error_model="numpy")
def _pushed_off(place: NDArray, prisms: NDArray, level_out: NDArray) -> NDArray:
    """Return the accelerations of _off_obstacles().

    The height of an obstacle above the vehicle adds to its distance; one beneath counts as beside, since the vehicle
    comes down there. Accelerations of several obstacles add up, at most to that of one.
    """
    out = np.zeros((len(place), 2))
    reach, stiffness, pull_max = level_out[2], level_out[3], level_out[4]
    for k in range(len(prisms)):
        cos, sin = math.cos(prisms[k, 7]), math.sin(prisms[k, 7])
        foot = prisms[k, 2] - prisms[k, 5]
        for n in range(len(place)):
            x, y = place[n, 0] - prisms[k, 0], place[n, 1] - prisms[k, 1]
            u, v = cos * x + sin * y, cos * y - sin * x
            over_u, over_v = abs(u) - prisms[k, 3], abs(v) - prisms[k, 4]
            aside_u, aside_v = max(over_u, 0.0), max(over_v, 0.0)
            size = math.sqrt(aside_u * aside_u + aside_v * aside_v)
            if size > 0.0:
                flat, aside_u, aside_v = size, aside_u / size, aside_v / size
            else:
                flat, aside_u = max(over_u, over_v), 1.0 if over_u >= over_v else 0.0
                aside_v = 1.0 - aside_u
            flat -= prisms[k, 6]
            above = max(foot - place[n, 2], 0.0)
            away = math.sqrt(flat * flat + above * above) if above > 0.0 else flat
            pull = min(stiffness * max(reach - away, 0.0), pull_max)
            aside_u, aside_v = math.copysign(aside_u, u) * pull, math.copysign(aside_v, v) * pull
            out[n, 0] += cos * aside_u - sin * aside_v
            out[n, 1] += sin * aside_u + cos * aside_v
    for n in range(len(place)):
        size = math.sqrt(out[n, 0] * out[n, 0] + out[n, 1] * out[n, 1])
        if size > pull_max:
            out[n, 0], out[n, 1] = out[n, 0] * pull_max / size, out[n, 1] * pull_max / size
    return out


# Rows of the panels of _traded: what comes in, what is in between, and what goes out.
_PLACE, _SPEED, _FORCE, _AHEAD, _ATTITUDE, _TURNING = 0, 2, 4, 7, 9, 13
_BACK, _TRADED, _SIZE, _MOST = 15, 19, 21, 22
_RATE, _TURNED, _PUSH, _OFF, _ROWS = 23, 25, 29, 32, 34


@njit(error_model="numpy")
def _traded(
    position: NDArray,
    velocity: NDArray,
    acceleration: NDArray,
    acceleration_ahead: NDArray,
    quaternion: NDArray,
    body_rate: NDArray,
    walls: NDArray,
    off_obstacles: NDArray,
    full_rate: float,
    level_out: NDArray,
) -> tuple[NDArray, NDArray, NDArray]:
    """Return what trade_rates gives: body rates (N, 3), attitudes (N, 4) and accelerations (N, 3)."""
    rates, attitudes, accelerations = body_rate.copy(), np.empty_like(quaternion), np.empty_like(acceleration)
    panel = np.empty(_ROWS * WIDTH)
    sides = (walls[0, 0], walls[1, 0]), (walls[0, 1], walls[1, 1])
    goal = (level_out[0], level_out[1], level_out[2], level_out[3], level_out[4])
    for begin in range(0, len(velocity), WIDTH):
        lanes = lanes_for(len(velocity) - begin)
        take_in(panel, _PLACE, position[:, :2], begin, lanes)
        take_in(panel, _SPEED, velocity[:, :2], begin, lanes)
        take_in(panel, _FORCE, acceleration, begin, lanes)
        take_in(panel, _AHEAD, acceleration_ahead[:, :2], begin, lanes)
        take_in(panel, _ATTITUDE, quaternion, begin, lanes)
        take_in(panel, _TURNING, body_rate[:, :2], begin, lanes)
        take_in(panel, _OFF, off_obstacles, begin, lanes)
        _find_trades(panel, lanes, sides, goal, full_rate)
        for n in range(lanes):
            if math.isnan(panel[_MOST * WIDTH + n]):
                attitude = product(quaternion_in(panel, _ATTITUDE, n), quaternion_in(panel, _BACK, n))
                dx, dy = pair_in(panel, _TRADED, n)
                panel[_MOST * WIDTH + n] = _most_by_lean(attitude, dx, dy, panel[_SIZE * WIDTH + n], full_rate)
        _make_trades(panel, lanes, full_rate)
        give_out(rates[:, :2], begin, panel, _RATE)
        give_out(attitudes, begin, panel, _TURNED)
        give_out(accelerations, begin, panel, _PUSH)
    return rates, attitudes, accelerations


_Sides = tuple[tuple[float, float], tuple[float, float]]  # the walls' x, and y
_Goal = tuple[float, float, float, float, float]  # LevelOut, packed


@register_jitable
def _find_trades(panel: NDArray, lanes: int, sides: _Sides, goal: _Goal, full_rate: float) -> None:
    lanes = min(lanes, WIDTH)  # the compiler must see that no index overflows
    for n in range(lanes):
        _find_trade(panel, n, sides, goal, full_rate)


@register_jitable(forceinline=True)
def _find_trade(panel: NDArray, n: int, sides: _Sides, goal: _Goal, full_rate: float) -> None:
    """Write how the attitude is believed turned back, the rate that would best be traded, and how much of it may be.

    That is the full rate where all of it, or TRADED_RATE_MAX, may, which is seen without an angle; else it is NaN.
    """
    attitude, (wx, wy) = quaternion_in(panel, _ATTITUDE, n), pair_in(panel, _TURNING, n)
    place, speed, coming = pair_in(panel, _PLACE, n), pair_in(panel, _SPEED, n), pair_in(panel, _AHEAD, n)
    off = pair_in(panel, _OFF, n)
    good_x, good_y = _good_rate(place, speed, coming, attitude, sides, off, full_rate, goal)
    half = -0.5 * ATTITUDE_AGE * math.sqrt(wx * wx + wy * wy)
    back = _turn(sine(half), cosine(half), wx, wy)
    dx, dy = wx - good_x, wy - good_y
    size = math.sqrt(dx * dx + dy * dy)
    aside, lift = _lean(product(attitude, back), dx, dy, size)
    share = min(size, TRADED_RATE_MAX) / full_rate  # the sine of the turn
    upright = lift * math.sqrt(max(1.0 - share * share, 0.0)) + aside * share
    most = full_rate if upright >= _LEAST_LIFT else math.nan
    most = most if share < 1.0 else math.nan
    write_quaternion_in(panel, _BACK, n, back)
    write_pair(panel, _TRADED, n, dx, dy)
    panel[_SIZE * WIDTH + n], panel[_MOST * WIDTH + n] = size, full_rate if size == 0.0 else most


@register_jitable
def _make_trades(panel: NDArray, lanes: int, full_rate: float) -> None:
    lanes = min(lanes, WIDTH)
    for n in range(lanes):
        _make_trade(panel, n, full_rate)


@register_jitable(forceinline=True)
def _make_trade(panel: NDArray, n: int, full_rate: float) -> None:
    """Write the rates that are sent, the attitude with what is traded, and the acceleration along it."""
    (wx, wy), (dx, dy), size = pair_in(panel, _TURNING, n), pair_in(panel, _TRADED, n), panel[_SIZE * WIDTH + n]
    most = min(TRADED_RATE_MAX, panel[_MOST * WIDTH + n])
    share = most / size if size > most else 1.0
    rate_x = np.floor((wx - share * dx) / _QUANTUM + 0.5) * _QUANTUM
    rate_y = np.floor((wy - share * dy) / _QUANTUM + 0.5) * _QUANTUM

    dx, dy = wx - rate_x, wy - rate_y
    size = math.sqrt(dx * dx + dy * dy)
    share = min(size / full_rate, 1.0)  # the sine of the turn
    half = math.sqrt(0.5 + 0.5 * math.sqrt(1.0 - share * share))  # the cosine of half of it
    turn = product(quaternion_in(panel, _BACK, n), _turn(0.5 * share / half, half, dx, dy))
    turned = product(quaternion_in(panel, _ATTITUDE, n), turn)

    x, y, z, w = turned
    fx, fy, fz = triple_in(panel, _FORCE, n)
    fz += GRAVITY
    thrust = math.sqrt(fx * fx + fy * fy + fz * fz) / (1.0 - 2.0 * (turn[0] ** 2 + turn[1] ** 2))
    scale = 2.0 * thrust / (x * x + y * y + z * z + w * w)
    push = scale * (x * z + y * w), scale * (y * z - x * w), thrust - scale * (x * x + y * y) - GRAVITY
    write_pair(panel, _RATE, n, rate_x, rate_y)
    write_quaternion_in(panel, _TURNED, n, turned)
    write_triple(panel, _PUSH, n, push)


@register_jitable(forceinline=True)
def _turn(sin_half: float, cos_half: float, x: float, y: float) -> tuple[float, float, float, float]:
    """Return the quaternion that turns about (x, y, 0), by twice the angle with that sine and cosine."""
    size = math.sqrt(x * x + y * y)
    along = sin_half / (size if size > 0.0 else 1.0)
    along = along if size > 0.0 else 0.0
    return along * x, along * y, 0.0, cos_half


@register_jitable(forceinline=True)
def _lean(quaternion: tuple[float, float, float, float], dx: float, dy: float, size: float) -> tuple[float, float]:
    """Return by how much the thrust leans in the vertical plane in which a rate along (dx, dy) turns it, and rises."""
    x, y, z, w = quaternion
    square = x * x + y * y + z * z + w * w
    aside = 2.0 * ((x * z - y * w) * dy - (y * z + x * w) * dx) / ((size if size > 0.0 else 1.0) * square)
    return aside, 1.0 - 2.0 * (x * x + y * y) / square


@register_jitable
def _most_by_lean(
    quaternion: tuple[float, float, float, float], dx: float, dy: float, size: float, full_rate: float
) -> float:
    """Return how much of a rate along (dx, dy), of that size, rad/s, may be traded until the thrust leans too far."""
    aside, lift = _lean(quaternion, dx, dy, size)
    reached = math.sqrt(aside * aside + lift * lift)
    turn = math.atan2(aside, lift)
    if reached > _LEAST_LIFT:
        turn += math.acos(_LEAST_LIFT / reached)
    return full_rate * math.sin(min(max(turn, 0.0), 0.5 * math.pi))


@register_jitable(forceinline=True)
def _good_rate(
    place: tuple[float, float],
    velocity: tuple[float, float],
    ahead: tuple[float, float],
    quaternion: tuple[float, float, float, float],
    sides: _Sides,
    off: tuple[float, float],
    full_rate: float,
    goal: _Goal,
) -> tuple[float, float]:
    """Return the roll and pitch rates, rad/s, at which level-out brakes the speed left and leans away from walls.

    `off`, m/s², is the acceleration away from obstacles.
    """
    braking, rate_max = goal[0], goal[1]
    x, y = heading_of(quaternion)
    size = math.sqrt(x * x + y * y)
    length = size if size > 0.0 else 1.0  # interpreted, a division by zero is an error
    cos, sin = x / length, y / length
    cos, sin = cos if size > 0.0 else 1.0, sin if size > 0.0 else 0.0
    pull_x = -braking * (SPEED_LEFT * velocity[0] + SPEED_GAINED * ahead[0])
    pull_y = -braking * (SPEED_LEFT * velocity[1] + SPEED_GAINED * ahead[1])
    pull_x += _pull_off(place[0] + WALL_LEAD * velocity[0], sides[0], goal) + off[0]
    pull_y += _pull_off(place[1] + WALL_LEAD * velocity[1], sides[1], goal) + off[1]
    forward, left = cos * pull_x + sin * pull_y, cos * pull_y - sin * pull_x
    pull = math.sqrt(forward * forward + left * left)
    scale = full_rate / math.sqrt(GRAVITY * GRAVITY + pull * pull)  # sin(atan(pull / g)) / pull
    scale = rate_max / pull if scale * pull > rate_max else scale
    return -scale * left, scale * forward


@register_jitable(forceinline=True)
def _pull_off(place: float, sides: tuple[float, float], goal: _Goal) -> float:
    """Return the acceleration, m/s², away from two opposite walls."""
    _, _, reach, stiffness, pull_max = goal
    off_low = min(max(stiffness * (reach - (place - sides[0])), 0.0), pull_max)
    off_high = min(max(stiffness * (reach - (sides[1] - place)), 0.0), pull_max)
    return off_low - off_high


# Rows of the panels of _harmless: what comes in, what is in between, and what goes out.
_EXCESS, _LENGTH, _LEANING, _ALLOWED, _HARMLESS, _OFF_TOO, _HARMLESS_ROWS = 15, 17, 18, 20, 21, 23, 25


@njit(error_model="numpy")
def _harmless(
    position: NDArray,
    velocity: NDArray,
    acceleration_ahead: NDArray,
    quaternion: NDArray,
    body_rate: NDArray,
    walls: NDArray,
    off_obstacles: NDArray,
    full_rate: float,
    level_out: NDArray,
) -> NDArray:
    """Return what harmless_rates gives, (N, 2) rad/s."""
    out, panel = np.empty((len(position), 2)), np.empty(_HARMLESS_ROWS * WIDTH)
    sides = (walls[0, 0], walls[1, 0]), (walls[0, 1], walls[1, 1])
    goal = (level_out[0], level_out[1], level_out[2], level_out[3], level_out[4])
    for begin in range(0, len(position), WIDTH):
        lanes = lanes_for(len(position) - begin)
        take_in(panel, _PLACE, position[:, :2], begin, lanes)
        take_in(panel, _SPEED, velocity[:, :2], begin, lanes)
        take_in(panel, _AHEAD, acceleration_ahead[:, :2], begin, lanes)
        take_in(panel, _ATTITUDE, quaternion, begin, lanes)
        take_in(panel, _TURNING, body_rate[:, :2], begin, lanes)
        take_in(panel, _OFF_TOO, off_obstacles, begin, lanes)
        _find_excesses(panel, lanes, sides, goal, full_rate)
        for n in range(lanes):
            if math.isnan(panel[_ALLOWED * WIDTH + n]):
                aside, up_z = pair_in(panel, _LEANING, n)
                upright = math.atan2(aside, up_z)  # the turn after which the axis leans least, by acos(reached)
                reached = math.sqrt(aside * aside + up_z * up_z)
                widest = upright + math.acos(_LEAST_LIFT / max(reached, _LEAST_LIFT))
                panel[_ALLOWED * WIDTH + n] = full_rate * math.sin(min(max(widest, 0.0), 0.5 * math.pi))
        _leave_excesses(panel, lanes)
        give_out(out, begin, panel, _HARMLESS)
    return out


@register_jitable
def _leave_excesses(panel: NDArray, lanes: int) -> None:
    """Write the rates less what of the excess may be traded."""
    lanes = min(lanes, WIDTH)
    for n in range(lanes):
        (wx, wy), (dx, dy) = pair_in(panel, _TURNING, n), pair_in(panel, _EXCESS, n)
        size = panel[_LENGTH * WIDTH + n]
        share = min(size, min(TRADED_RATE_MAX, panel[_ALLOWED * WIDTH + n])) / size
        write_pair(panel, _HARMLESS, n, wx - share * dx, wy - share * dy)


@register_jitable
def _find_excesses(panel: NDArray, lanes: int, sides: _Sides, goal: _Goal, full_rate: float) -> None:
    lanes = min(lanes, WIDTH)
    for n in range(lanes):
        _find_excess(panel, n, sides, goal, full_rate)


@register_jitable(forceinline=True)
def _find_excess(panel: NDArray, n: int, sides: _Sides, goal: _Goal, full_rate: float) -> None:
    """Write the rate that does no good, and how much of it may be traded: all, or NaN where that takes angles to tell.

    All may be traded where the thrust, turned as far as that takes, does not lean too far.
    """
    braking, rate_max, reach, stiffness, pull_max = goal
    place, speed, coming = pair_in(panel, _PLACE, n), pair_in(panel, _SPEED, n), pair_in(panel, _AHEAD, n)
    quaternion, (wx, wy) = quaternion_in(panel, _ATTITUDE, n), pair_in(panel, _TURNING, n)
    pushed_x = _push(place[0], speed[0], sides[0], reach, stiffness, pull_max)
    pushed_y = _push(place[1], speed[1], sides[1], reach, stiffness, pull_max)
    off_x, off_y = pair_in(panel, _OFF_TOO, n)
    wanted_x = pushed_x + off_x - braking * (SPEED_LEFT * speed[0] + SPEED_GAINED * coming[0])
    wanted_y = pushed_y + off_y - braking * (SPEED_LEFT * speed[1] + SPEED_GAINED * coming[1])
    x, y = heading_of(quaternion)
    size = max(math.sqrt(x * x + y * y), 1e-12)
    cos, sin = x / size, y / size
    forward, left = wanted_x * cos + wanted_y * sin, wanted_y * cos - wanted_x * sin
    size = max(math.sqrt(forward * forward + left * left), 1e-12)
    tangent = size / GRAVITY  # of the tilt
    rate = min(full_rate * (tangent / math.sqrt(1.0 + tangent * tangent)), rate_max) / size
    dx, dy = wx + rate * left, wy - rate * forward
    size = max(math.sqrt(dx * dx + dy * dy), 1e-12)

    x, y, z, w = quaternion
    _, _, vertical = matrix_rows(quaternion, 2.0 / (x * x + y * y + z * z + w * w))
    turned = max(ATTITUDE_AGE * math.sqrt(wx * wx + wy * wy), 1e-12)
    half = sine(0.5 * turned) / turned
    seen = turn_rows(-ATTITUDE_AGE * wx, -ATTITUDE_AGE * wy, sine(turned) / turned, 2.0 * half * half)
    of_x, of_y, of_z = transpose(seen)
    up_x, up_y, up_z = dot(vertical, of_x), dot(vertical, of_y), dot(vertical, of_z)  # in the axes believed
    aside = (up_x * dy - up_y * dx) / size
    turn = min(size, TRADED_RATE_MAX) / full_rate  # its sine
    lift = up_z * math.sqrt(max(1.0 - turn * turn, 0.0)) + aside * turn
    write_pair(panel, _EXCESS, n, dx, dy)
    write_pair(panel, _LEANING, n, aside, up_z)
    panel[_LENGTH * WIDTH + n] = size
    panel[_ALLOWED * WIDTH + n] = TRADED_RATE_MAX if lift >= _LEAST_LIFT else math.nan


@register_jitable(forceinline=True)
def _push(
    place: float, speed: float, sides: tuple[float, float], reach: float, stiffness: float, pull_max: float
) -> float:
    """Return the acceleration, m/s², that two opposite walls ask for."""
    soon = place + WALL_LEAD * speed
    off_low = min(stiffness * max(reach - (soon - sides[0]), 0.0), pull_max)
    off_high = min(stiffness * max(reach - (sides[1] - soon), 0.0), pull_max)
    return off_low - off_high
