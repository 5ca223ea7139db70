"""Faults of a pose, as both stages that poses pass understand them: broken, frozen, jumped, turned.

The first stage, `PoseClassifier`, stands at the motion capture system. It sees raw frames: which body is hidden, frame
numbers, and what the vehicle believes of its attitude. It decides which track is the vehicle, and may reject a track
for as long as a landing takes.

The second stage, `PoseGate`, stands in the pilot, right before the radio. It sees only poses, from any source, and is
the last check before the vehicle's filter, which takes every pose as the truth. Its bounds on motion are wider: it
stops what a source without a first stage, or a faulty one, lets pass.
"""

import math
from dataclasses import dataclass
from typing import Protocol

from cfplan.flight.telemetry import Quaternion, Triple

_NORM_TOLERANCE = 0.01  # by which the norm of a quaternion may differ from 1


class Placed(Protocol):
    """Anything with a position, m, and an attitude."""

    @property
    def position(self) -> Triple: ...

    @property
    def quaternion(self) -> Quaternion: ...


@dataclass(frozen=True, slots=True)
class MotionBounds:
    """How far a body can move and turn from one pose to the next."""

    speed: float  # m/s
    turn: float  # rad, however short the time between them
    turn_rate: float  # rad/s
    largest_turn: float = math.inf  # rad, however long the time

    def reach(self, jump: float, elapsed: float) -> float:
        """Return the largest distance, m, after `elapsed`, s, where `jump`, m, is always allowed."""
        return jump + self.speed * elapsed

    def turn_within(self, elapsed: float) -> float:
        """Return the largest turn, rad, after `elapsed`, s."""
        return min(self.turn + self.turn_rate * elapsed, self.largest_turn)


def is_finite(pose: Placed) -> bool:
    """Return whether every number of a pose is one."""
    return all(map(math.isfinite, (*pose.position, *pose.quaternion)))


def is_rotation(quaternion: Quaternion) -> bool:
    """Return whether a quaternion has unit norm."""
    return abs(math.hypot(*quaternion) - 1.0) <= _NORM_TOLERANCE


def is_frozen(pose: Placed, last: Placed) -> bool:
    """Return whether a pose is the last one to the last bit, as no measurement of a body is."""
    return pose.position == last.position and pose.quaternion == last.quaternion


def angle_between(first: Quaternion, second: Quaternion) -> float:
    """Return the angle, rad, between two attitudes; the sign of a quaternion means nothing."""
    (x, y, z, w), (a, b, c, d) = first, second
    aligned = abs(math.fsum((x * a, y * b, z * c, w * d)))
    return 2.0 * math.acos(min(1.0, aligned))
