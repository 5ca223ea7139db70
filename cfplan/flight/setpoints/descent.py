"""Straight down by setpoints: landings, gentle with poses and quick without, and stops that sink besides.

A descent goes on beneath the floor. A vehicle that stands on the floor, wherever that really is, no longer follows its
setpoints down, and so the pilot knows that it stands. Roll and pitch rates are small, for a vehicle that is left alone:
it levels out, leans away from a wall nearby, and comes down where it is.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.setpoints.encoding import encode_motion
from cfplan.flight.setpoints.packets import FullStateSetpoints, decode, encode
from cfplan.flight.setpoints.rate_trade import gains_under
from cfplan.flight.telemetry import Triple
from cfplan.safety.limits import Limits
from cfplan.vehicle.rotations import about_z

_CRUISE = 1.5  # times the mean speed of landing: what a descent sinks at between its ends
_QUICK = 3.0  # m/s²: thrust stays above half of gravity, below which a vehicle counts as tumbling


@dataclass(frozen=True, slots=True)
class Pace:
    """How fast a descent sinks."""

    speed: float  # m/s, at most
    acceleration: float  # m/s²
    touch_speed: float  # m/s, with which it meets the floor and goes on beneath it
    slow_above: float  # m above the floor at which it has slowed to that

    def at(self, height: float) -> float:
        """Return the speed, m/s, at a height above the floor, m."""
        left = max(height - self.slow_above, 0.0)
        return min(self.speed, math.sqrt(self.touch_speed**2 + 2.0 * self.acceleration * left))


def gentle(mean_speed: float) -> Pace:
    """Return the pace of a landing with poses, at `mean_speed`, m/s, with its slow ends."""
    return Pace(_CRUISE * mean_speed, acceleration=0.8, touch_speed=0.1, slow_above=0.05)


# Without poses: as fast as what falls from 0.2 m, and where the floor may be, as what falls from 2 cm.
QUICK = Pace(2.0, acceleration=_QUICK, touch_speed=0.6, slow_above=0.1)


def descent(
    begin: Triple, yaw: float, speed_now: float, pace: Pace, floor: float, lowest: float, limits: Limits, rate: float
) -> NDArray:
    """Return payloads, (N, 29) uint8 at `rate`, Hz, straight down from `begin`, m, to the height `lowest`, m.

    It sinks at `speed_now`, m/s, first, then at the pace for a floor at the height `floor`, m. The last row rests.
    """
    heights, speeds = [begin[2]], [max(speed_now, 0.0)]
    while heights[-1] > lowest:
        faster = min(speeds[-1] + pace.acceleration / rate, pace.at(heights[-1] - floor))
        speeds.append(max(faster, speeds[-1] - _QUICK / rate))
        heights.append(max(heights[-1] - speeds[-1] / rate, lowest))
    count = len(heights) + 1
    position, velocity, change = np.tile(begin, (count, 1)), np.zeros((count, 3)), np.zeros((count, 3))
    position[:, 2] = [*heights, heights[-1]]
    velocity[:-1, 2] = -np.array(speeds)
    change[:-2, 2] = -np.diff(speeds) * rate
    still = np.zeros((count, 3))
    level = np.tile(about_z(yaw), (count, 1))
    motion = FullStateSetpoints(position, velocity, change, level, still)
    return encode_motion(motion, still, gains_under(limits), space=limits.space)


def sinking(payloads: NDArray, lowest: float, speed: float, rate: float) -> NDArray:
    """Return the motion of `payloads`, (N, 29) uint8 at `rate`, Hz, sinking besides, at `speed`, m/s, at most.

    It sinks to the height `lowest`, m, at most, and not at all where the motion is that low anyway. Only position and
    velocity change, so it is feedback that makes the vehicle sink.
    """
    motion = decode(payloads)
    room = max(float(motion.position[:, 2].min()) - lowest, 0.0)
    depth, fall = np.zeros((len(payloads), 3)), np.zeros((len(payloads), 3))
    for row in range(1, len(payloads)):
        allowed = min(speed, math.sqrt(2.0 * _QUICK * (room - depth[row - 1, 2])))
        fall[row, 2] = min(fall[row - 1, 2] + _QUICK / rate, allowed)
        depth[row, 2] = min(depth[row - 1, 2] + fall[row, 2] / rate, room)
    return encode(replace(motion, position=motion.position - depth, velocity=motion.velocity - fall))
