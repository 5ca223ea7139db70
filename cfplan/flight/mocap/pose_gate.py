"""The last check of a pose before it is sent to the vehicle, whose filter takes every pose as the truth.

`pose_faults` says why this check stands behind that of the motion capture source.
"""

import math

from cfplan.flight.mocap.pose_faults import MotionBounds, angle_between, is_finite, is_frozen, is_rotation
from cfplan.flight.mocap.poses import Pose
from cfplan.flight.telemetry import Triple

_BOUNDS = MotionBounds(speed=6.0, turn=0.5, turn_rate=25.0)  # beyond what a vehicle can do
_GAP = 0.1  # s without a good pose, after which the vehicle's own estimate tells where the next one must be
_DRIFT = 0.5  # m/s², by which that estimate may go wrong meanwhile


class PoseGate:
    """Tells good poses from repeated, frozen, jumping and broken ones.

    `jump` in m, between a pose and the last good one.
    """

    def __init__(self, jump: float):
        self._jump = jump
        self.last: Pose | None = None  # the last good one

    def fault(self, pose: Pose, believed: Triple | None = None) -> str:
        """Return why a pose must not be forwarded; empty for a good one, which is remembered.

        `believed`, m, is where the vehicle itself believes that it was then; None where it does not tell. After a gap a
        pose must agree with that: poses that jumped, and stay away, look as if the vehicle had flown there unseen.
        """
        why = self._fault(pose) or self._disbelieved(pose, believed)
        if not why:
            self.last = pose
        return why

    def _fault(self, pose: Pose) -> str:
        if not (math.isfinite(pose.time) and is_finite(pose)):
            return "not a number"
        if not is_rotation(pose.quaternion):
            return "its quaternion is no rotation"
        last = self.last
        if last is None:
            return ""
        elapsed = pose.time - last.time
        if elapsed <= 0.0:
            return "not newer than the last"
        if is_frozen(pose, last):
            return "frozen"
        moved = math.dist(pose.position, last.position)
        if moved > _BOUNDS.reach(self._jump, elapsed):
            return f"jumped {moved:.2f} m"
        turned = angle_between(pose.quaternion, last.quaternion)
        if turned > _BOUNDS.turn_within(elapsed):
            return f"turned {math.degrees(turned):.0f}°"
        return ""

    def _disbelieved(self, pose: Pose, believed: Triple | None) -> str:
        gap = pose.time - self.last.time if self.last is not None else 0.0
        if believed is None or gap < _GAP:
            return ""
        off = math.dist(pose.position, believed)
        return f"{off:.2f} m from the estimate" if off > self._jump + _DRIFT / 2.0 * gap**2 else ""
