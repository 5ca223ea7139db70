"""Tells good poses of a body from those that must not reach its filter, which would take them as the truth.

A pose is held against where the last good ones led. What leaps away and stays away is not believed for a long while:
tracking that took another body, or turned the marker pattern over, looks exactly like that, and a vehicle in the air
is better off with no pose.
"""

import math
from collections import Counter, deque
from enum import StrEnum

from cfplan.flight.mocap.frames import TrackedBody
from cfplan.flight.telemetry import Quaternion, Triple

_ACCELERATION = 20.0  # m/s² by which the motion may have changed since; twice what a flight may do
_TURN = 0.5  # rad that the attitude may turn from one pose to the next
_TURN_RATE = 12.0  # rad/s by which it may have turned on since
_MOST_TURN = 1.3  # rad, however long ago; a pattern seen the wrong way round turns by 90° or 180°
_SEEN_LATELY = 0.2  # s; after longer the vehicle knows better how it turned than its last pose does
_SPEED = 4.0  # m/s at which another track may go on
_HISTORY = 0.1  # s of good poses from which the velocity is taken
_EXTRAPOLATE = 0.3  # s for which that velocity is taken to last
_BELIEVE_AFTER = 30.0  # s that another track must last; no landing takes so long


class Verdict(StrEnum):
    """What a pose is."""

    GOOD = "good"
    OCCLUDED = "occluded"
    REPEATED = "repeated"  # the same frame once more
    FROZEN = "frozen"  # a new frame with the same pose
    JUMPED = "jumped"
    FLIPPED = "flipped"
    BROKEN = "not a pose"  # not a number, or no rotation


class PoseClassifier:
    """Sorts the poses of one body, in the order of their time."""

    def __init__(self, jump: float):
        # jump in m, of a pose from where the last ones led
        self._jump = jump
        self._good: deque[tuple[float, TrackedBody]] = deque()
        self._last: TrackedBody | None = None
        self._number: int | None = None
        self._other: tuple[float, TrackedBody] | None = None
        self._other_since = 0.0
        self._other_verdict = Verdict.JUMPED
        self.counts: Counter[Verdict] = Counter()
        # as the vehicle itself believes it: its gyroscopes tell a vehicle that turned, while it was not seen, from a
        # pattern that was turned over
        self.attitude: Quaternion | None = None

    def classify(self, time: float, body: TrackedBody | None, number: int | None = None) -> Verdict:
        """What this pose is. Only a good one may be used."""
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
        if not all(map(math.isfinite, (*body.position, *body.quaternion))):
            return Verdict.BROKEN
        if abs(math.hypot(*body.quaternion) - 1.0) > 0.01:
            return Verdict.BROKEN
        if self._last is not None and _same(body, self._last):
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
        turned = _angle(body.quaternion, last.quaternion)
        if self.attitude is not None and (turned > _TURN or elapsed > _SEEN_LATELY):
            turned = _angle(body.quaternion, self.attitude)
            turned = turned if turned > _TURN else 0.0
        if off <= self._jump and turned <= _TURN:
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
        elif turned > (_TURN if self.attitude is not None else min(_TURN + _TURN_RATE * elapsed, _MOST_TURN)):
            verdict = Verdict.FLIPPED
        else:
            self._other = None
            return Verdict.GOOD
        self._other, self._other_since, self._other_verdict = (time, body), time, verdict
        return verdict

    def _expected(self, time: float) -> Triple:
        """Where the last good poses led."""
        (first_time, first), (last_time, last) = self._good[0], self._good[-1]
        span = last_time - first_time
        ahead = min(time - last_time, _EXTRAPOLATE)
        share = ahead / span if span >= _HISTORY / 5 else 0.0
        x, y, z = (b + (b - a) * share for a, b in zip(first.position, last.position, strict=True))
        return x, y, z

    def _goes_on(self, time: float, body: TrackedBody) -> bool:
        """Whether a pose belongs to the other track."""
        assert self._other is not None
        other_time, other = self._other
        elapsed = time - other_time
        near = math.dist(body.position, other.position) <= self._jump + _SPEED * elapsed
        return near and _angle(body.quaternion, other.quaternion) <= min(_TURN + _TURN_RATE * elapsed, _MOST_TURN)

    def _believe_other(self) -> None:
        self._other = None
        self._good.clear()


def _same(a: TrackedBody, b: TrackedBody) -> bool:
    return a.position == b.position and a.quaternion == b.quaternion


def _angle(a: Quaternion, b: Quaternion) -> float:
    """rad between two attitudes."""
    aligned = abs(math.fsum(p * q for p, q in zip(a, b, strict=True)))
    return 2.0 * math.acos(min(1.0, aligned))
