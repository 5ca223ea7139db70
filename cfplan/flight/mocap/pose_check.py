"""Check of a tracked body's poses, one by one: good, occluded, repeated, frozen, jumped, flipped, astray or broken.

A pose is compared with the extrapolation of the last good ones. A pose that jumps away and stays away is rejected for
longer than a landing takes: it may be another body, or a marker pattern that tracking fits upside down, and in the air
no pose is safer than a wrong one.

In flight a pose is also compared with the vehicle's own estimate. Its attitude tells a vehicle that turned while it was
hidden from a flipped marker pattern; after a gap, its position tells a vehicle that flew on from a jump.
"""

import math
from collections import Counter, deque
from enum import StrEnum
from typing import Protocol

from cfplan.flight.telemetry import Quaternion, Triple

_NORM_TOLERANCE = 0.01  # on the norm of a quaternion, which must be 1
_MAX_TURN_PER_FRAME = 0.5  # rad from one pose to the next, at any frame rate

# Against the track. A flipped marker pattern turns by 90° or 180°.
_TRACK_SPEED, _TRACK_TURN_RATE, _MAX_TRACK_TURN = 4.0, 12.0, 1.3  # m/s, rad/s; rad after any gap
_TRACK_ACCELERATION = 20.0  # m/s², largest acceleration since the last good pose; twice what a flight may reach
_ATTITUDE_TIMEOUT = 0.2  # s; after a longer gap a pose is compared with the estimated attitude
_HISTORY = 0.1  # s of good poses, from which the velocity is computed
_MAX_EXTRAPOLATION = 0.3  # s, largest extrapolation with that velocity
_SWITCH_AFTER = 30.0  # s for which another track must last to be accepted; no landing takes that long

# Against the vehicle: motion beyond its abilities, or a position far from its estimate.
_VEHICLE_SPEED, _VEHICLE_TURN_RATE = 6.0, 25.0  # m/s, rad/s
_MIN_GAP = 0.1  # s without a good pose, after which the next one must agree with the vehicle's estimate
_ESTIMATE_DRIFT = 0.5  # m/s², largest error of that estimate's acceleration meanwhile


class Placed(Protocol):
    """Anything with a position, m, and an attitude."""

    @property
    def position(self) -> Triple: ...

    @property
    def quaternion(self) -> Quaternion: ...


class Verdict(StrEnum):
    """Verdict on a pose; only a good one is used."""

    GOOD = "good"
    OCCLUDED = "occluded"
    REPEATED = "repeated"  # the same frame once more, or an older one
    FROZEN = "frozen"  # a new frame with the same pose
    JUMPED = "jumped"
    FLIPPED = "flipped"
    ASTRAY = "far from the estimate"
    BROKEN = "not a pose"  # not a number, or no rotation


class PoseCheck:
    """Judges the poses of one body, in the order of their time.

    `jump`: largest distance, m, of a good pose from the extrapolated position.
    """

    def __init__(self, jump: float):
        self._jump = jump
        self._track: deque[tuple[float, Placed]] = deque()
        self._confirmed: tuple[float, Placed] | None = None  # the last pose that the vehicle can have reached
        self._seen: Placed | None = None
        self._number: int | None = None
        self._other: tuple[float, Placed] | None = None
        self._other_since = 0.0
        self._other_verdict = Verdict.JUMPED
        self.counts: Counter[Verdict] = Counter()
        self.attitude: Quaternion | None = None  # the vehicle's own estimate, in flight

    def judge(
        self, time: float, body: Placed | None, number: int | None = None, believed: Triple | None = None
    ) -> Verdict:
        """Return the verdict on a pose; `body` is None if it was not seen, `number` the frame's if frames are numbered.

        `believed`, m, is the vehicle's estimate of its position at `time`, s; None if there is none.
        """
        verdict = self._against_frame(time, body, number)
        self._number = number
        if body is not None and verdict is not Verdict.BROKEN:
            self._seen = body
        if verdict is Verdict.GOOD and body is not None:
            self._track.append((time, body))
            while time - self._track[0][0] > _HISTORY:
                self._track.popleft()
            verdict = self._against_vehicle(time, body, believed)
        self.counts[verdict] += 1
        return verdict

    def _against_frame(self, time: float, body: Placed | None, number: int | None) -> Verdict:
        if number is not None and number == self._number:
            return Verdict.REPEATED
        if body is None or not any(body.position):  # some systems send a hidden body as all zeros
            return Verdict.OCCLUDED
        if not (all(map(math.isfinite, (time, *body.position))) and _is_rotation(body.quaternion)):
            return Verdict.BROKEN
        if self._seen is not None and (body.position, body.quaternion) == (self._seen.position, self._seen.quaternion):
            return Verdict.FROZEN  # identical to the last bit, which no measurement is
        if not self._track:
            return Verdict.GOOD
        if time <= self._track[-1][0]:
            return Verdict.REPEATED
        return self._against_track(time, body)

    def _against_track(self, time: float, body: Placed) -> Verdict:
        last_time, last = self._track[-1]
        elapsed = time - last_time
        distance = math.dist(body.position, self._expected(time))
        turn = _angle_between(body.quaternion, last.quaternion)
        if self.attitude is not None and (turn > _MAX_TURN_PER_FRAME or elapsed > _ATTITUDE_TIMEOUT):
            turn = _angle_between(body.quaternion, self.attitude)
            turn = turn if turn > _MAX_TURN_PER_FRAME else 0.0
        if distance <= self._jump and turn <= _MAX_TURN_PER_FRAME:
            self._other = None
            return Verdict.GOOD
        if self._other is not None and self._continues(*self._other, time, body):
            self._other = time, body
            if time - self._other_since < _SWITCH_AFTER:
                return self._other_verdict
            self._other = None
            self._track.clear()
            return Verdict.GOOD
        if distance > self._jump + _TRACK_ACCELERATION / 2 * elapsed**2:
            verdict = Verdict.JUMPED
        elif turn > (_MAX_TURN_PER_FRAME if self.attitude is not None else _max_turn(elapsed)):
            verdict = Verdict.FLIPPED
        else:
            self._other = None
            return Verdict.GOOD
        self._other, self._other_since, self._other_verdict = (time, body), time, verdict
        return verdict

    def _expected(self, time: float) -> Triple:
        """Return the position, m, extrapolated from the last good poses."""
        (first_time, first), (last_time, last) = self._track[0], self._track[-1]
        span = last_time - first_time
        ahead = min(time - last_time, _MAX_EXTRAPOLATION)
        ratio = ahead / span if span >= _HISTORY / 5 else 0.0
        x, y, z = (b + (b - a) * ratio for a, b in zip(first.position, last.position, strict=True))
        return x, y, z

    def _continues(self, other_time: float, other: Placed, time: float, body: Placed) -> bool:
        """Return whether a pose continues another track."""
        elapsed = time - other_time
        near = math.dist(body.position, other.position) <= self._jump + _TRACK_SPEED * elapsed
        return near and _angle_between(body.quaternion, other.quaternion) <= _max_turn(elapsed)

    def _against_vehicle(self, time: float, body: Placed, believed: Triple | None) -> Verdict:
        """Return whether the vehicle can have come here since the last confirmed pose."""
        if self._confirmed is not None:
            last_time, last = self._confirmed
            elapsed = time - last_time
            if math.dist(body.position, last.position) > self._jump + _VEHICLE_SPEED * elapsed:
                return Verdict.JUMPED
            if _angle_between(body.quaternion, last.quaternion) > _MAX_TURN_PER_FRAME + _VEHICLE_TURN_RATE * elapsed:
                return Verdict.FLIPPED
            if believed is not None and elapsed >= _MIN_GAP:
                distance = math.dist(body.position, believed)
                if distance > self._jump + _ESTIMATE_DRIFT / 2.0 * elapsed**2:
                    return Verdict.ASTRAY
        self._confirmed = time, body
        return Verdict.GOOD


def _is_rotation(quaternion: Quaternion) -> bool:
    """Return whether a quaternion has unit norm; one that is not a number has none."""
    return abs(math.hypot(*quaternion) - 1.0) <= _NORM_TOLERANCE


def _angle_between(first: Quaternion, second: Quaternion) -> float:
    """Return the angle, rad, between two attitudes; the sign of a quaternion means nothing."""
    (x, y, z, w), (a, b, c, d) = first, second
    aligned = abs(math.fsum((x * a, y * b, z * c, w * d)))
    return 2.0 * math.acos(min(1.0, aligned))


def _max_turn(elapsed: float) -> float:
    """Return the largest turn, rad, of a track after `elapsed`, s."""
    return min(_MAX_TURN_PER_FRAME + _TRACK_TURN_RATE * elapsed, _MAX_TRACK_TURN)
