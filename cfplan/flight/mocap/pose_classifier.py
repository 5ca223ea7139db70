"""Classification of a tracked body's poses: good, hidden, repeated, frozen, jumped, flipped or broken.

A pose is compared with where the last good ones led. A pose that jumps away and stays away is not believed for a long
while: tracking that took another body, or turned the marker pattern over, looks exactly like that, and a vehicle in the
air is better off with no pose. `pose_faults` says why a second check follows in the pilot.
"""

import math
from collections import Counter, deque
from enum import StrEnum

from cfplan.flight.mocap.frames import TrackedBody
from cfplan.flight.mocap.pose_faults import MotionBounds, angle_between, is_finite, is_frozen, is_rotation
from cfplan.flight.telemetry import Quaternion, Triple

# Of one track; a marker pattern that is seen the wrong way round turns by 90° or 180°.
_BOUNDS = MotionBounds(speed=4.0, turn=0.5, turn_rate=12.0, largest_turn=1.3)
_ACCELERATION = 20.0  # m/s² by which the motion may have changed since the last good pose; twice what a flight may do
_ATTITUDE_LASTS = 0.2  # s; after a longer gap the vehicle's own attitude is better than that of its last pose
_HISTORY = 0.1  # s of good poses from which the velocity is taken
_EXTRAPOLATE = 0.3  # s for which that velocity is taken to last
_BELIEVE_AFTER = 30.0  # s that another track must last; no landing takes that long


class Verdict(StrEnum):
    """What a pose is; only a good one may be used."""

    GOOD = "good"
    OCCLUDED = "occluded"
    REPEATED = "repeated"  # the same frame once more
    FROZEN = "frozen"  # a new frame with the same pose
    JUMPED = "jumped"
    FLIPPED = "flipped"
    BROKEN = "not a pose"  # not a number, or no rotation


class PoseClassifier:
    """Classifies the poses of one body, in the order of their time.

    `jump` in m, of a pose from where the last ones led.
    """

    def __init__(self, jump: float):
        self._jump = jump
        self._good: deque[tuple[float, TrackedBody]] = deque()
        self._last: TrackedBody | None = None
        self._number: int | None = None
        self._other: tuple[float, TrackedBody] | None = None
        self._other_since = 0.0
        self._other_verdict = Verdict.JUMPED
        self.counts: Counter[Verdict] = Counter()
        self.attitude: Quaternion | None = None
        """The vehicle's own estimate: its gyroscopes tell a vehicle that turned while it was not seen from a marker
        pattern that was turned over."""

    def classify(self, time: float, body: TrackedBody | None, number: int | None = None) -> Verdict:
        """Return what this pose is; `body` is None where it was not seen, `number` the frame's where there is one."""
        verdict = self._verdict(time, body, number)
        self.counts[verdict] += 1
        if body is not None and verdict is not Verdict.BROKEN:
            self._last = body
        self._number = number
        if verdict is Verdict.GOOD and body is not None:
            self._good.append((time, body))
            while time - self._good[0][0] > _HISTORY:
                self._good.popleft()
        return verdict

    def _verdict(self, time: float, body: TrackedBody | None, number: int | None) -> Verdict:
        if number is not None and number == self._number:
            return Verdict.REPEATED
        if body is None or not any(body.position):  # some systems send a hidden body as all zeros
            return Verdict.OCCLUDED
        if not (is_finite(body) and is_rotation(body.quaternion)):
            return Verdict.BROKEN
        if self._last is not None and is_frozen(body, self._last):
            return Verdict.FROZEN
        if not self._good:
            return Verdict.GOOD
        if time <= self._good[-1][0]:
            return Verdict.REPEATED
        return self._against_track(time, body)

    def _against_track(self, time: float, body: TrackedBody) -> Verdict:
        last_time, last = self._good[-1]
        elapsed = time - last_time
        off = math.dist(body.position, self._expected(time))
        turned = angle_between(body.quaternion, last.quaternion)
        if self.attitude is not None and (turned > _BOUNDS.turn or elapsed > _ATTITUDE_LASTS):
            turned = angle_between(body.quaternion, self.attitude)
            turned = turned if turned > _BOUNDS.turn else 0.0
        if off <= self._jump and turned <= _BOUNDS.turn:
            self._other = None
            return Verdict.GOOD
        if self._other is not None and self._goes_on(time, body):
            self._other = (time, body)
            if time - self._other_since < _BELIEVE_AFTER:
                return self._other_verdict
            self._believe_other()
            return Verdict.GOOD
        if off > self._jump + _ACCELERATION / 2 * elapsed**2:
            verdict = Verdict.JUMPED
        elif turned > (_BOUNDS.turn if self.attitude is not None else _BOUNDS.turn_within(elapsed)):
            verdict = Verdict.FLIPPED
        else:
            self._other = None
            return Verdict.GOOD
        self._other, self._other_since, self._other_verdict = (time, body), time, verdict
        return verdict

    def _expected(self, time: float) -> Triple:
        """Return where, m, the last good poses led."""
        (first_time, first), (last_time, last) = self._good[0], self._good[-1]
        span = last_time - first_time
        ahead = min(time - last_time, _EXTRAPOLATE)
        share = ahead / span if span >= _HISTORY / 5 else 0.0
        x, y, z = (b + (b - a) * share for a, b in zip(first.position, last.position, strict=True))
        return x, y, z

    def _goes_on(self, time: float, body: TrackedBody) -> bool:
        """Return whether a pose continues the other track."""
        assert self._other is not None
        other_time, other = self._other
        elapsed = time - other_time
        near = math.dist(body.position, other.position) <= _BOUNDS.reach(self._jump, elapsed)
        return near and angle_between(body.quaternion, other.quaternion) <= _BOUNDS.turn_within(elapsed)

    def _believe_other(self) -> None:
        self._other = None
        self._good.clear()
