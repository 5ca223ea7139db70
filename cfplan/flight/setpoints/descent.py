"""Straight down by setpoints: landings, gentle with poses and quick without, and stops that sink besides.

A descent goes on beneath the floor. A vehicle that stands on the floor, wherever that really is, no longer follows its
setpoints down, and so the pilot knows that it stands. Roll and pitch rates are zero: a vehicle that is left alone in a
descent levels out and comes down where it is.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.setpoints.encoding import encode_motion
from cfplan.flight.setpoints.packets import FullStateSetpoints, decode, encode
from cfplan.flight.telemetry import Triple
from cfplan.vehicle.rotations import about_z

TOUCH_SPEED = 0.1  # m/s, with which a gentle descent meets the floor
_SLOW_ABOVE = 0.05  # m above the floor at which it has slowed to that
_GENTLE = 0.8  # m/s², at which a gentle descent changes its speed
_QUICK = 3.0  # m/s², of a quick one: thrust stays above half of gravity, below which a vehicle counts as tumbling


def descent(
    begin: Triple, yaw: float, speed_now: float, floor: float, lowest: float, speed: float, rate: float
) -> NDArray:
    """Return payloads, (N, 29) uint8 at `rate`, Hz, straight down from `begin`, m, to the height `lowest`, m.

    It sinks at `speed_now` first, at `speed` at most, and from shortly above `floor`, m, on at TOUCH_SPEED; speeds in
    m/s. The last row rests.
    """

    def allowed(height: float) -> float:
        left = max(height - floor - _SLOW_ABOVE, 0.0)
        return min(speed, math.sqrt(TOUCH_SPEED**2 + 2.0 * _GENTLE * left))

    return _straight_down(begin, yaw, speed_now, lowest, allowed, _GENTLE, rate)


def quick_descent(begin: Triple, yaw: float, speed_now: float, lowest: float, speed: float, rate: float) -> NDArray:
    """Return the same of a descent that reaches its speed sooner, and does not slow down before the floor."""
    return _straight_down(begin, yaw, speed_now, lowest, lambda _: speed, _QUICK, rate)


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


def _straight_down(
    begin: Triple,
    yaw: float,
    speed_now: float,
    lowest: float,
    allowed: Callable[[float], float],
    acceleration: float,
    rate: float,
) -> NDArray:
    """Return payloads that sink as fast as `allowed` says of a height; they slow down at _QUICK where they must."""
    heights, speeds = [begin[2]], [max(speed_now, 0.0)]
    while heights[-1] > lowest:
        faster = min(speeds[-1] + acceleration / rate, allowed(heights[-1]))
        speeds.append(max(faster, speeds[-1] - _QUICK / rate))
        heights.append(max(heights[-1] - speeds[-1] / rate, lowest))
    count = len(heights) + 1
    position, velocity, change = np.tile(begin, (count, 1)), np.zeros((count, 3)), np.zeros((count, 3))
    position[:, 2] = [*heights, heights[-1]]
    velocity[:-1, 2] = -np.array(speeds)
    change[:-2, 2] = -np.diff(speeds) * rate
    still = np.zeros((count, 3))
    level = np.tile(about_z(yaw), (count, 1))
    return encode_motion(FullStateSetpoints(position, velocity, change, level, still), still)
