"""Level-out: what the vehicle does once setpoints stop, and the roll and pitch rates that help it then.

The firmware then wants a level attitude, yet keeps the last roll and pitch rates. With the gains of the Mellinger
controller it settles at a tilt of asin(ω kw / 2kR), which at 3 rad/s is 25°. So setpoints send only rates whose tilt
helps. It brakes the horizontal speed that remains after the vehicle has first held its last place for half a second:

    v_left = 0.41 v + 0.089 s · a(t + 0.15 s)
    pull   = -braking · v_left + away from walls and obstacles                       m/s², horizontal
    |ω|    = 2kR / kw · sin(atan(|pull| / g)), at most rate_max                      which tilts the thrust along pull

Within 1.5 m of a wall or an obstacle the vehicle leans away from it, more so the nearer it is, so that an error of its
attitude does not carry it there. How much depends on how long level-out lasts until the motors stop (LevelOut).
"""

import math
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.safety.space import Space
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.rotations import Quaternion, direction, heading_of

BRAKE_LEAD = 0.15  # s by which the acceleration in the formula of the remaining speed is ahead of the setpoint
SPEED_LEFT = 0.41  # fraction of the velocity that remains when the firmware begins to level out
SPEED_GAINED = 0.089  # s, speed gained until then for each m/s² of acceleration
WALL_LEAD = 0.3  # s by which the place whose distance to walls counts is ahead of the setpoint


class LevelOut(NamedTuple):
    """Parameters of level-out, by its duration until the motors stop."""

    braking: float  # 1/s, deceleration for each m/s of the speed left
    rate_max: float  # rad/s, of the rates that are sent for it
    wall_reach: float  # m from a wall, within which the vehicle leans away from it
    wall_stiffness: float  # 1/s², acceleration away from a wall for each m nearer than that
    wall_pull_max: float  # m/s², of that acceleration


# Half a second, at up to 13° of tilt; and 1.5 s, at up to 5°.
UNTIL_WATCHDOG = LevelOut(braking=2.0, rate_max=1.6, wall_reach=1.5, wall_stiffness=1.2, wall_pull_max=1.6)
UNTIL_TIMEOUT = LevelOut(braking=1.0, rate_max=0.6, wall_reach=1.5, wall_stiffness=0.35, wall_pull_max=0.45)


class Faces(NamedTuple):
    """What level-out leans away from, for compiled code."""

    low: tuple[float, float]  # m, x and y of the low walls
    high: tuple[float, float]  # m, x and y of the high walls
    prisms: NDArray  # (K, 8), of the obstacles


def faces_of(space: Space | None) -> Faces:
    """Return the walls and obstacles of a space; without one there is nothing to lean away from."""
    if space is None:
        return Faces((-math.inf, -math.inf), (math.inf, math.inf), np.empty((0, 8)))
    (low_x, low_y, _), (high_x, high_y, _) = space.low, space.high
    prisms = np.array([each.prism for each in space.obstacles]).reshape(-1, 8)
    return Faces((float(low_x), float(low_y)), (float(high_x), float(high_y)), prisms)


@register_jitable
def pull_of(
    place: NDArray, velocity: NDArray, ahead: NDArray, faces: Faces, level_out: LevelOut
) -> tuple[float, float]:
    """Return the horizontal acceleration, m/s², that level-out should give after a setpoint.

    `place`, m, and `velocity`, m/s, are the setpoint's, (3,); `ahead` is the acceleration BRAKE_LEAD later, m/s².
    """
    x, y = place[0] + WALL_LEAD * velocity[0], place[1] + WALL_LEAD * velocity[1]
    off_x, off_y = push_off_obstacles(x, y, place[2], faces.prisms, level_out)
    off_x += _push_off_walls(x, faces.low[0], faces.high[0], level_out)
    off_y += _push_off_walls(y, faces.low[1], faces.high[1], level_out)
    return (
        off_x - level_out.braking * (SPEED_LEFT * velocity[0] + SPEED_GAINED * ahead[0]),
        off_y - level_out.braking * (SPEED_LEFT * velocity[1] + SPEED_GAINED * ahead[1]),
    )


@register_jitable
def helpful_rate(
    pull: tuple[float, float], attitude: Quaternion, full_rate: float, rate_max: float
) -> tuple[float, float]:
    """Return the roll and pitch rates, rad/s, at which a vehicle of this heading settles at the tilt for a pull.

    `full_rate`, rad/s, is the rate whose torque a tilt by 90° balances: 2 kR / kw.
    """
    x, y = heading_of(attitude)
    cos, sin = direction(x, y)
    forward, left = cos * pull[0] + sin * pull[1], cos * pull[1] - sin * pull[0]
    size = math.sqrt(forward * forward + left * left)
    scale = full_rate / math.sqrt(GRAVITY * GRAVITY + size * size)  # sin(atan(size / g)) / size
    if scale * size > rate_max:
        scale = rate_max / size
    return -scale * left, scale * forward


@register_jitable
def _push_off_walls(place: float, low: float, high: float, level_out: LevelOut) -> float:
    """Return the acceleration, m/s², away from two opposite walls."""
    return _push(place - low, level_out) - _push(high - place, level_out)


@register_jitable
def _push(distance: float, level_out: LevelOut) -> float:
    """Return the acceleration, m/s², away from a face at a distance, m."""
    return min(level_out.wall_stiffness * max(level_out.wall_reach - distance, 0.0), level_out.wall_pull_max)


@register_jitable
def push_off_obstacles(x: float, y: float, z: float, prisms: NDArray, level_out: LevelOut) -> tuple[float, float]:
    """Return the acceleration, m/s², away from obstacles; several together push at most as much as one may.

    The height of an obstacle above the vehicle adds to its distance; one beneath counts as beside, since the vehicle
    comes down there.
    """
    total_x, total_y = 0.0, 0.0
    for k in range(len(prisms)):
        cos, sin = math.cos(prisms[k, 7]), math.sin(prisms[k, 7])
        u = cos * (x - prisms[k, 0]) + sin * (y - prisms[k, 1])  # in the prism's axes, from its middle
        v = cos * (y - prisms[k, 1]) - sin * (x - prisms[k, 0])
        over_u, over_v = abs(u) - prisms[k, 3], abs(v) - prisms[k, 4]
        aside_u, aside_v = max(over_u, 0.0), max(over_v, 0.0)
        distance = math.sqrt(aside_u * aside_u + aside_v * aside_v)
        if distance > 0.0:
            aside_u, aside_v = aside_u / distance, aside_v / distance
        else:  # within its outline: the nearer side
            distance = max(over_u, over_v)
            aside_u, aside_v = (1.0, 0.0) if over_u >= over_v else (0.0, 1.0)
        distance -= prisms[k, 6]
        above = max(prisms[k, 2] - prisms[k, 5] - z, 0.0)
        if above > 0.0:
            distance = math.sqrt(distance * distance + above * above)
        push = _push(distance, level_out)
        aside_u, aside_v = math.copysign(aside_u, u) * push, math.copysign(aside_v, v) * push
        total_x += cos * aside_u - sin * aside_v
        total_y += sin * aside_u + cos * aside_v
    size = math.sqrt(total_x * total_x + total_y * total_y)
    if size > level_out.wall_pull_max:
        return total_x * level_out.wall_pull_max / size, total_y * level_out.wall_pull_max / size
    return total_x, total_y
