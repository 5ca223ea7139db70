"""Which poses may be forwarded: the vehicle's filter takes whatever it is given as the truth of that moment."""

import math

from cfplan.flight.mocap.poses import Pose

_FASTEST = 6.0  # m/s that a pose may have moved since the last good one, over the jump that is allowed
_TURN = 0.5  # rad that the attitude may turn between poses, over what it turns at the fastest
_FASTEST_TURN = 25.0  # rad/s


class PoseGate:
    """Tells good poses from repeated, frozen, jumping and broken ones."""

    def __init__(self, jump: float):
        # jump in m, between a pose and the last good one
        self._jump = jump
        self.last: Pose | None = None

    def fault(self, pose: Pose) -> str:
        """Why a pose must not be forwarded; empty for a good one, which is remembered."""
        why = self._fault(pose)
        if not why:
            self.last = pose
        return why

    def _fault(self, pose: Pose) -> str:
        if not all(map(math.isfinite, (pose.time, *pose.position, *pose.quaternion))):
            return "not a number"
        if abs(math.hypot(*pose.quaternion) - 1.0) > 0.01:
            return "its quaternion is no rotation"
        last = self.last
        if last is None:
            return ""
        elapsed = pose.time - last.time
        if elapsed <= 0.0:
            return "not newer than the last"
        if pose.position == last.position and pose.quaternion == last.quaternion:
            return "frozen"
        moved = math.dist(pose.position, last.position)
        if moved > self._jump + _FASTEST * elapsed:
            return f"jumped {moved:.2f} m"
        aligned = abs(sum(a * b for a, b in zip(pose.quaternion, last.quaternion, strict=True)))
        turned = 2.0 * math.acos(min(1.0, aligned))
        if turned > _TURN + _FASTEST_TURN * elapsed:
            return f"turned {math.degrees(turned):.0f}°"
        return ""
