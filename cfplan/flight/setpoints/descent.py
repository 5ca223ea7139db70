"""Descents as setpoints: landings, gentle with poses and quick without, and stops that also sink.

A descent continues below the floor, whose height is only roughly known. A standing vehicle no longer follows its
setpoints down, which is how the pilot detects it. Roll and pitch rates are small; if setpoints stop, the vehicle levels
out, leans away from a nearby wall, and comes down where it is.

Without poses the vehicle drifts, so as it sinks it also moves away from the walls nearby. That must be over before it
touches the floor, where sideways motion would tip it over, so it moves only as far as its time allows.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.setpoints.encoding import controller_attitude, encode_motion
from cfplan.flight.setpoints.packets import FullStateSetpoints, decode, encode
from cfplan.flight.setpoints.rate_trade import gains_under
from cfplan.flight.telemetry import Triple
from cfplan.safety.limits import Limits
from cfplan.safety.space import SIDES, Space, inside
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.rotations import about_z, quaternions_of

_CRUISE = 1.5  # sink rate between the ends of a descent, as a multiple of the mean landing speed
_QUICK_ACCELERATION = 3.0  # m/s²: thrust stays above half of gravity, below which a vehicle counts as tumbling
# m above the floor, and m/s² below that height, for a vehicle that has just braked: its controller commands less thrust
# than the setpoint has. With 3 m/s² it stopped all motors, and without thrust the vehicle tilted by 40°.
_GENTLE_BELOW, _GENTLE_ACCELERATION = 0.6, 1.0
_WALL_DISTANCE = 1.0  # m; a vehicle without poses moves away from walls that are nearer
_ASIDE_MAX = 0.4  # m, along x or y, in one stop or descent
_ASIDE_ACCELERATION = 1.5  # m/s², of a descent sideways: a tilt of 9°
_STOP_ASIDE_ACCELERATION = 3.0  # m/s², of a stop's setpoints, which the vehicle does not follow as fast
_BY_SMOOTHSTEP = 10.0 / math.sqrt(3.0)  # peak acceleration of a quintic smoothstep over 1 m in 1 s
MIN_HEIGHT_ASIDE = 0.1  # m above the floor, below which a vehicle does not move sideways without poses

_Sideways = tuple[NDArray, NDArray, NDArray]


@dataclass(frozen=True, slots=True)
class Pace:
    """How fast a descent sinks."""

    speed: float  # m/s, at most
    acceleration: float  # m/s²
    touch_speed: float  # m/s, at the floor and below it
    slow_above: float  # m above the floor, where it has slowed to that

    def at(self, height: float) -> float:
        """Return the speed, m/s, at a height above the floor, m."""
        left = max(height - self.slow_above, 0.0)
        return min(self.speed, math.sqrt(self.touch_speed**2 + 2.0 * self.acceleration * left))


def gentle(mean_speed: float) -> Pace:
    """Return the pace of a landing with poses, at `mean_speed`, m/s, with its slow ends."""
    return Pace(_CRUISE * mean_speed, acceleration=0.8, touch_speed=0.1, slow_above=0.05)


# Without poses: as fast as after a fall from 0.2 m, and near the floor as after a fall from 2 cm.
QUICK = Pace(2.0, acceleration=_QUICK_ACCELERATION, touch_speed=0.6, slow_above=0.1)


def descent(
    begin: Triple,
    yaw: float,
    speed_now: float,
    pace: Pace,
    floor: float,
    lowest: float,
    *,  # limits, rate and sideways displacement
    limits: Limits,
    rate: float,
    aside: tuple[float, float] = (0.0, 0.0),
) -> NDArray:
    """Return payloads, (N, 29) uint8 at `rate`, Hz, down from `begin`, m, to the height `lowest`, m.

    It sinks at `speed_now`, m/s, first, then at the pace for a floor at the height `floor`, m. The last row rests.
    Meanwhile it moves `aside`, x and y in m, or less if it would reach the floor first.
    """
    heights, speeds = [begin[2]], [max(speed_now, 0.0)]
    while heights[-1] > lowest:
        limit = _GENTLE_ACCELERATION if heights[-1] - floor < _GENTLE_BELOW else _QUICK_ACCELERATION
        faster = min(speeds[-1] + min(pace.acceleration, limit) / rate, pace.at(heights[-1] - floor))
        speeds.append(max(faster, speeds[-1] - _QUICK_ACCELERATION / rate))
        heights.append(max(heights[-1] - speeds[-1] / rate, lowest))
    count = len(heights) + 1
    position, velocity, change = np.tile(begin, (count, 1)), np.zeros((count, 3)), np.zeros((count, 3))
    position[:, 2] = [*heights, heights[-1]]
    velocity[:-1, 2] = -np.array(speeds)
    change[:-2, 2] = -np.diff(speeds) * rate
    above = sum(height - floor > MIN_HEIGHT_ASIDE for height in heights)
    sideways = _sideways(aside, above, count, rate, _ASIDE_ACCELERATION)
    position[:, :2] += sideways[0]
    velocity[:, :2], change[:, :2] = sideways[1:]
    still = np.zeros((count, 3))
    attitude = np.tile(about_z(yaw), (count, 1))
    if sideways[2].any():
        attitude = quaternions_of(controller_attitude(change + np.array([0.0, 0.0, GRAVITY]), attitude))
    motion = FullStateSetpoints(position, velocity, change, attitude, still)
    return encode_motion(motion, still, gains_under(limits), space=limits.space)


def off_walls(position: Triple, space: Space) -> tuple[float, float]:
    """Return the displacement, x and y in m, away from nearby walls, or zero if an obstacle is there."""
    x, y = (
        min(max(_away_from_walls(place, low, high) - place, -_ASIDE_MAX), _ASIDE_MAX)
        for place, low, high in zip(position[:2], space.low[:2], space.high[:2], strict=True)
    )
    height = max(position[2] - space.low[2], 0.0)
    half = np.array([abs(x), abs(y), height]) / 2  # of the box around the descent
    middle = (position[0] + x / 2, position[1] + y / 2, space.low[2] + height / 2)
    return (x, y) if inside(space.beyond(middle, half)[SIDES:]).all() else (0.0, 0.0)


def _away_from_walls(place: float, low: float, high: float) -> float:
    """Return the nearest place that is far enough from two opposite walls, or the middle between them."""
    clearance = min(_WALL_DISTANCE, 0.5 * (high - low))
    return min(max(place, low + clearance), high - clearance)


def _sideways(aside: tuple[float, float], within: int, count: int, rate: float, acceleration: float) -> _Sideways:
    """Return position, m, velocity, m/s, and acceleration, m/s², (N, 2) each, of a displacement in `within` rows.

    It covers as much of `aside`, m, as `acceleration`, m/s², permits.
    """
    duration, length = max(within, 1) / rate, math.hypot(*aside)
    reach = acceleration * duration**2 / _BY_SMOOTHSTEP if within else 0.0
    way = np.array(aside) * (min(1.0, reach / length) if length > 0.0 else 0.0)
    fraction = np.minimum(np.arange(count)[:, None] / max(within, 1), 1.0)
    return (
        fraction**3 * (10.0 - 15.0 * fraction + 6.0 * fraction**2) * way,
        30.0 * fraction**2 * (1.0 - fraction) ** 2 / duration * way,
        60.0 * fraction * (1.0 - fraction) * (1.0 - 2.0 * fraction) / duration**2 * way,
    )


def sinking(
    payloads: NDArray, lowest: float, speed: float, rate: float, aside: Callable[[Triple], tuple[float, float]]
) -> NDArray:
    """Return the motion of `payloads`, (N, 29) uint8 at `rate`, Hz, that also sinks, at most at `speed`, m/s.

    It sinks no lower than the height `lowest`, m, and not at all if the motion is that low already. It also moves by
    `aside` of its end, x and y in m. Only position and velocity change, so it is feedback that moves the vehicle.
    """
    motion = decode(payloads)
    room = max(float(motion.position[:, 2].min()) - lowest, 0.0)
    depth, fall = np.zeros((len(payloads), 3)), np.zeros((len(payloads), 3))
    for row in range(1, len(payloads)):
        allowed = min(speed, math.sqrt(2.0 * _QUICK_ACCELERATION * (room - depth[row - 1, 2])))
        fall[row, 2] = min(fall[row - 1, 2] + _QUICK_ACCELERATION / rate, allowed)
        depth[row, 2] = min(depth[row - 1, 2] + fall[row, 2] / rate, room)
    x, y, z = motion.position[-1].tolist()
    rows = len(payloads)
    place, along, _ = _sideways(aside((x, y, z)), rows - 1, rows, rate, _STOP_ASIDE_ACCELERATION)
    depth[:, :2], fall[:, :2] = -place, -along
    return encode(replace(motion, position=motion.position - depth, velocity=motion.velocity - fall))
