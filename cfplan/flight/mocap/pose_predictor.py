"""Latency compensation: predict where the vehicle is when a pose reaches it.

A pose is some 15 ms old when it is sent on: the latency of motion capture and the wait for the next tick. The
vehicle's filter takes it as the truth of the moment in which it arrives, so at 2 m/s its estimate would trail by 3 cm
and its controller would fly ahead by as much. A straight line through the last poses makes up for that.
"""

import math
from collections import deque

from cfplan.flight.mocap.poses import Pose
from cfplan.flight.telemetry import Triple

WINDOW = 0.06  # s of poses that the line is drawn through: 1 mm of noise gives 0.02 m/s at 100 Hz
FARTHEST = 0.05  # s that it is trusted beyond the last pose
_FEWEST = 4


class PosePredictor:
    """Predicts the position shortly after the last pose."""

    def __init__(self) -> None:
        self._poses: deque[Pose] = deque()

    def add(self, pose: Pose) -> None:
        """Take a good pose, newer than those before."""
        self._poses.append(pose)
        while self._poses[0].time < pose.time - WINDOW:
            self._poses.popleft()

    @property
    def last(self) -> Pose:
        """Return the last pose. Needs one."""
        return self._poses[-1]

    @property
    def middle(self) -> float:
        """Return the time, s, in the middle of the line; not a number while there are too few poses."""
        count = len(self._poses)
        return sum([pose.time for pose in self._poses]) / count if count >= _FEWEST else math.nan

    def velocity(self) -> Triple:
        """Return the slope of the line, m/s; zero while there are too few poses."""
        count = len(self._poses)
        if count < _FEWEST:
            return 0.0, 0.0, 0.0
        middle = self.middle
        spread = x = y = z = 0.0
        for pose in self._poses:
            off, (px, py, pz) = pose.time - middle, pose.position
            spread += off**2
            x, y, z = x + off * px, y + off * py, z + off * pz
        return x / spread, y / spread, z / spread

    def position(self, time: float) -> Triple:
        """Return the position, m, at a time, s, shortly after the last pose. Needs one pose."""
        last = self._poses[-1]
        elapsed = min(max(time - last.time, 0.0), FARTHEST)
        (x, y, z), (vx, vy, vz) = last.position, self.velocity()
        return x + elapsed * vx, y + elapsed * vy, z + elapsed * vz
