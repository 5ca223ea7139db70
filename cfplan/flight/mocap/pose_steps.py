"""Steps of the poses, taken out and let in slowly.

Where a marker is hidden or a pattern is fitted otherwise, poses step by some centimetres in one frame, as no vehicle
can. The vehicle's filter explains such a step by a speed: 0.14 m along x made it believe 0.7 m/s otherwise for a fifth
of a second. A tracked body that steps is often lost next, and then the vehicle flies on by that speed. So poses that
step go on to the vehicle from where they were expected, and come to where they are at a speed that does no harm.
"""

import math
from dataclasses import replace

from cfplan.flight.mocap.poses import Pose
from cfplan.flight.telemetry import Triple

SMALLEST = 0.02  # m beside where the last poses led, which counts as a step; the filter makes 0.1 m/s of it
_LET_IN = 0.1  # m/s
_GAP = 0.1  # s without a good pose, after which a step is as likely the vehicle's


class PoseSteps:
    """Keeps how far poses are still off from where they lead the vehicle. At most `jump`, m, is taken out."""

    def __init__(self, jump: float):
        self._jump = jump
        self._offset: Triple = (0.0, 0.0, 0.0)  # m, to be added to the poses
        self._time = -math.inf  # s, of the last pose

    @property
    def kept_back(self) -> bool:
        """Return whether a part of a step is still kept from the vehicle."""
        return any(self._offset)

    def smooth(self, pose: Pose, expected: Triple | None) -> Pose:
        """Return the pose without its step; `expected`, m, is where the smoothed poses before lead, None if unknown."""
        elapsed, self._time = pose.time - self._time, pose.time
        if elapsed > _GAP:
            self._offset = (0.0, 0.0, 0.0)
            return pose
        size = math.hypot(*self._offset)
        if size > 0.0:
            x, y, z = self._offset
            share = max(1.0 - _LET_IN * elapsed / size, 0.0)
            self._offset = share * x, share * y, share * z
        if expected is not None and math.dist(_sum(pose.position, self._offset), expected) > SMALLEST:
            x, y, z = (wanted - seen for wanted, seen in zip(expected, pose.position, strict=True))
            self._offset = (x, y, z) if math.hypot(x, y, z) <= self._jump else (0.0, 0.0, 0.0)
        return replace(pose, position=_sum(pose.position, self._offset)) if self.kept_back else pose


def _sum(first: Triple, second: Triple) -> Triple:
    return first[0] + second[0], first[1] + second[1], first[2] + second[2]
