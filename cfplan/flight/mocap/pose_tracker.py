"""Tracker of the vehicle's poses: which poses are good, where the vehicle is now, and which pose to send to it.

The vehicle's filter takes every pose as a measurement of the moment at which it arrives. Besides rejecting bad poses
(`pose_check`), the tracker therefore compensates for three things:

*Latency.* A pose is some 15 ms old when it is sent: at 2 m/s the estimate would lag by 3 cm, and the controller would
fly ahead by as much. A straight line through the last poses extrapolates recent poses; older ones are extrapolated by
the motion that the vehicle's sensors have measured since (`dead_reckoning`).

*Steps.* When a marker is hidden or the pattern is fitted differently, poses jump by some centimetres in one frame,
which no vehicle can. The filter explains such a step by a velocity: 0.14 m along x changed the estimate by 0.7 m/s for
a fifth of a second. A tracked body that steps is often lost next, and then the vehicle flies on with that velocity.
Therefore the step is subtracted from the poses that are sent, and the offset decays slowly.

*Wrong axes.* If the axes of the tracked body are not the vehicle's, or it is a different body, the velocities of poses
and estimate disagree. Such poses cannot hold the vehicle, but it can land by its own sensors: all poses are ignored.
"""

import math
from collections import Counter, deque
from dataclasses import replace

from cfplan.flight.mocap.dead_reckoning import SensedMotion
from cfplan.flight.mocap.pose_check import PoseCheck, Verdict
from cfplan.flight.mocap.poses import Pose
from cfplan.flight.telemetry import Estimate, Quaternion, Triple, VehicleStatus
from cfplan.safety.limits import PoseLimits

MAX_EXTRAPOLATION = 0.05  # s, largest extrapolation of the line through the last poses
_FIT_WINDOW = 0.06  # s of poses to which the line is fitted: 1 mm of noise gives 0.02 m/s at 100 Hz
_MIN_FIT_POSES = 4  # for the line
_HISTORY = 1.0  # s of good poses to keep
_MIN_HEIGHTS = 3  # to decide whether a body rests
_RATE_SLACK = 1.2  # poses are used at up to this multiple of the expected rate; more would only enlarge the record

SMALLEST_STEP = 0.02  # m from the extrapolated position; such a step shifts the filter's velocity by 0.1 m/s
_STEP_FADE_SPEED = 0.1  # m/s, at which the offset of a step decays
_STEP_GAP = 0.1  # s without a good pose, after which a step may be real motion

VELOCITY_MISMATCH = 0.2
"""m/s, horizontal: difference between the velocities of poses and estimate, beyond which slow flight distrusts poses if
it lasts. In the virtual lab it is 0.05, in wind 0.15, and 0.4 once the vehicle cannot hold its position."""


class PoseTracker:
    """Tracks one vehicle from its poses, its sensed motion and the time.

    Its attributes are for reading; methods change them.
    """

    def __init__(self, limits: PoseLimits):
        self._limits = limits
        self._check, self._sensed = PoseCheck(limits.jump), SensedMotion()
        self._airborne = False
        self._estimate: Estimate | None = None  # the vehicle's, in flight and while its log is fresh
        self._log_since = -math.inf  # s, since when the log has been fresh
        self._next = -math.inf  # s, earliest time of the next pose to use
        self._line: deque[Pose] = deque()  # the last good poses, with steps removed
        self._offset: Triple = (0.0, 0.0, 0.0)  # m, added to poses to hide a step from the vehicle
        self._smoothed_until = -math.inf  # s, time of the last pose with steps removed
        self._unsent: Pose | None = None  # the newest good pose since `to_send`
        self._mismatch_since = math.inf  # s, since when the velocities of poses and estimate have differed
        self.recent: deque[Pose] = deque()  # the good poses of the last second
        self.fault = ""  # why the last pose was not good
        self.distrusted = ""  # why poses are ignored for the rest of the flight; empty while they are trusted
        self.step = 0.0  # m, size of the step that is being hidden; 0 for none

    @property
    def last(self) -> Pose | None:
        """Return the last good pose."""
        return self.recent[-1] if self.recent else None

    @property
    def verdicts(self) -> Counter[Verdict]:
        """Return the number of poses by verdict."""
        return self._check.counts

    def sense(
        self, now: float, estimate: Estimate | None, status: VehicleStatus | None, *, airborne: bool, fresh: bool
    ) -> None:
        """Take the newest messages of the vehicle's log; `fresh`: its estimate is still being received."""
        self._sensed.note(estimate, status)
        self._airborne = airborne
        self._estimate = estimate if airborne and fresh else None
        self._check.attitude = None if self._estimate is None else self._estimate.quaternion
        if self._estimate is None:
            self._log_since = now

    def take(self, pose: Pose) -> bool:
        """Judge a pose, and use it if it is good: `fault` is empty then.

        Return whether to record it: it is of the body, and poses do not exceed the expected rate.
        """
        verdict = self._check.judge(pose.time, pose, pose.number, self._believed(pose.time))
        self.fault = self.distrusted or ("" if verdict is Verdict.GOOD else str(verdict))
        if verdict not in (Verdict.GOOD, Verdict.ASTRAY) or pose.time < self._next:
            return False
        period = 1.0 / (self._limits.rate * _RATE_SLACK)
        self._next = max(self._next, pose.time - period) + period
        if not self.fault:
            self._accept(pose)
        return True

    def _believed(self, time: float) -> Triple | None:
        """Return the vehicle's estimate of its position, m; None unless its log was fresh since the last pose.

        If the radio was dead meanwhile, late poses may have corrupted the estimate.
        """
        if self._estimate is None or self.last is None or self.last.time < self._log_since:
            return None
        return self._estimate.position_at(time)

    def _accept(self, pose: Pose) -> None:
        self._line.append(self._smooth_step(pose) if self._airborne else pose)
        while self._line[0].time < pose.time - _FIT_WINDOW:
            self._line.popleft()
        self._unsent = pose
        self.recent.append(pose)
        while self.recent[0].time < pose.time - _HISTORY:
            self.recent.popleft()

    # Steps.

    def _smooth_step(self, pose: Pose) -> Pose:
        elapsed, self._smoothed_until = pose.time - self._smoothed_until, pose.time
        if elapsed > _STEP_GAP:
            self._offset, self.step = (0.0, 0.0, 0.0), 0.0
            return pose
        if self.step:
            left = max(1.0 - _STEP_FADE_SPEED * elapsed / math.hypot(*self._offset), 0.0)
            x, y, z = self._offset
            self._offset = left * x, left * y, left * z
        extrapolated = self.position(pose.time)
        jump = math.dist(pose.position, extrapolated)
        expected = extrapolated if jump <= SMALLEST_STEP else self._dead_reckoned(pose.time)
        if expected is not None and math.dist(_sum(pose.position, self._offset), expected) > SMALLEST_STEP:
            x, y, z = (there - measured for there, measured in zip(expected, pose.position, strict=True))
            self._offset = x, y, z
            if math.hypot(x, y, z) > self._limits.jump:  # too large to hide
                self._offset = (0.0, 0.0, 0.0)
                self._line.clear()  # a line across the step would show a speed
        self.step = (self.step or jump) if any(self._offset) else 0.0
        return replace(pose, position=_sum(pose.position, self._offset)) if self.step else pose

    # Where the vehicle is.

    def position(self, now: float) -> Triple:
        """Return the position, m, at a time, s, by the line through the last good poses. Needs at least one."""
        last = self._line[-1]
        ahead = min(max(now - last.time, 0.0), MAX_EXTRAPOLATION)
        (x, y, z), (vx, vy, vz) = last.position, self.velocity
        return x + ahead * vx, y + ahead * vy, z + ahead * vz

    @property
    def velocity(self) -> Triple:
        """Return the slope of that line, m/s; zero while there are too few poses."""
        line = self._line_fit()
        return line[1] if line is not None else (0.0, 0.0, 0.0)

    def _line_fit(self) -> tuple[float, Triple] | None:
        """Return the time, s, in the middle of the line, and its slope, m/s; None while there are too few poses."""
        count = len(self._line)
        if count < _MIN_FIT_POSES:
            return None
        middle = sum([pose.time for pose in self._line]) / count
        spread = x = y = z = 0.0
        for pose in self._line:
            offset, (px, py, pz) = pose.time - middle, pose.position
            spread += offset**2
            x, y, z = x + offset * px, y + offset * py, z + offset * pz
        return middle, (x / spread, y / spread, z / spread)

    def _dead_reckoned(self, now: float) -> Triple | None:
        """Return the position, m, by the last good poses and the sensed motion since; None if that is unknown."""
        line, last = self._line_fit(), self._line[-1]
        way = self._sensed.displacement(line[1], line[0], last.time, now) if line is not None else None
        return _sum(last.position, way) if way is not None else None

    def to_send(self, now: float) -> tuple[Triple, Quaternion] | None:
        """Return the newest pose, extrapolated to `now`: position, m, and attitude; None if there is nothing to send.

        Each pose is returned once. A late one is returned only if the motion since is known.
        """
        newest, self._unsent = self._unsent, None
        if newest is None or now - newest.time >= self._limits.age_brake:
            return None
        if not self._airborne or now - newest.time <= MAX_EXTRAPOLATION:
            return self.position(now), newest.quaternion
        position, turned = self._dead_reckoned(now), self._sensed.turn(newest.quaternion, newest.time, now)
        return None if position is None or turned is None else (position, turned)

    def heights(self, since: float) -> list[float]:
        """Return the heights, m, of the good poses after a time, s; none if they reach back less."""
        heights = [pose.position[2] for pose in self.recent if pose.time > since]
        return heights if len(heights) >= _MIN_HEIGHTS and self.recent[0].time <= since else []

    # Distrust.

    def compare_motion(self, now: float, patience: float, *, slow: bool) -> None:
        """Distrust all poses once their velocity has differed from the estimate's for `patience`, s.

        Only `slow` flight counts, where little else explains a difference. On the floor yaw is not observable.
        """
        mismatch, line = 0.0, self._line_fit()
        if slow and self._estimate is not None and line and now - self.recent[-1].time <= self._limits.age_warning:
            mismatch = math.dist(line[1][:2], self._estimate.velocity_at(line[0])[:2])
        self._mismatch_since = min(self._mismatch_since, now) if mismatch > VELOCITY_MISMATCH else math.inf
        if now - self._mismatch_since >= patience and not self.distrusted:
            self.distrusted = (
                f"velocities of the tracked body and of the vehicle's estimate differ by {mismatch:.2f} m/s: "
                "do their axes agree?"
            )


def _sum(first: Triple, second: Triple) -> Triple:
    return first[0] + second[0], first[1] + second[1], first[2] + second[2]
