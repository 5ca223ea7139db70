"""Poses for the pilot from a motion capture system."""

import math
from collections import Counter
from collections.abc import Callable

from cfplan.errors import CfplanError, InputError, LinkError
from cfplan.flight.clock import REAL_CLOCK, Clock
from cfplan.flight.mocap.clock import FrameClock
from cfplan.flight.mocap.feed import Feed
from cfplan.flight.mocap.frames import Frame, Scene
from cfplan.flight.mocap.pose_check import PoseCheck, Verdict
from cfplan.flight.mocap.poses import Pose
from cfplan.flight.mocap.uri import MocapUri, no_such_body, nothing_by_vrpn, parse_uri
from cfplan.safety.limits import PoseLimits

OPEN_TIMEOUT = 3.5  # s to see the first good poses
_FARTHEST = 30.0  # m from the origin; no lab is larger, but a lab in millimetres is
_LARGEST_TILT = math.radians(45)  # of a vehicle on the floor
_READ_PERIOD = 0.005  # s between polls
_MIN_GOOD_POSES = 5  # for the body to count as tracked


def pose_source(uri: str, limits: PoseLimits, *, open_within: float = OPEN_TIMEOUT) -> "MocapSource":
    """Return a source of the poses of the body that a URI names. Raises InputError if the URI is wrong."""
    return MocapSource(parse_uri(uri, subject_needed=True), limits, open_within=open_within)


class MocapSource:
    """A PoseSource; goes to another process before it is opened.

    Poses carry the time at which they were measured. A lost stream is reconnected; meanwhile there are no poses.
    """

    def __init__(
        self,
        uri: MocapUri,
        limits: PoseLimits,
        *,
        open_within: float = OPEN_TIMEOUT,
        clock: Clock = REAL_CLOCK,
        make_feed: Callable[[MocapUri], Feed] = Feed,
    ):
        self._uri, self._limits, self._open_within = uri, limits, open_within
        self._clock, self._make_feed = clock, make_feed
        self._feed: Feed | None = None
        self._first: list[Pose] = []
        self._begin()

    def _begin(self) -> None:
        self._frame_clock = FrameClock(self._limits.latency)
        self._scene: Scene | None = None
        self.hidden = 0  # frames without the body
        self.fault = ""  # why there are no poses; "" while there are

    @property
    def sees_delays(self) -> bool:
        """Return whether delayed frames are recognised: some seconds after opening, if frames have numbers."""
        return self._frame_clock.sure

    @property
    def child_id(self) -> int | None:
        """Return the id of the driver's process; None if there is none."""
        return self._feed.child_id if self._feed is not None else None

    def open(self) -> None:
        """Connect, and check that the body is seen upright and in metres. Raises a CfplanError within 5 s otherwise."""
        self._begin()
        deadline, check = self._clock.now() + self._open_within, PoseCheck(self._limits.jump)
        self._feed = self._make_feed(self._uri)
        try:
            self._feed.start()
            while check.counts[Verdict.GOOD] < _MIN_GOOD_POSES:
                self._judge_new_poses(check)
                self._check_subject()
                failure = self._feed.failure()
                if failure is not None:
                    self._judge_new_poses(check)  # its last message says more
                    raise failure
                if self._clock.now() > deadline:
                    raise self._nothing_came(check)
                self._clock.sleep(_READ_PERIOD)
        except BaseException:
            self.close()
            raise
        self._feed.keep()

    def poses(self) -> list[Pose]:
        """Return the poses since the last call."""
        if self._feed is None:
            return []
        found, self._first = self._first, []
        try:
            return found + self._read()
        except CfplanError as error:  # a restarted child does not find its server: the next one will retry
            self.fault = error.what
            return found

    def close(self) -> None:
        """End the child."""
        if self._feed is not None:
            self._feed.close()
            self._feed = None
        self._first = []

    def _read(self) -> list[Pose]:
        assert self._feed is not None
        found, error = [], None
        for message in self._feed.messages():
            if isinstance(message, CfplanError):
                error = message
            elif isinstance(message, Scene):
                self._scene = message
            elif isinstance(message, Frame) and (pose := self._pose(message)) is not None:
                found.append(pose)
        if error is not None:
            raise error
        return found

    def _pose(self, frame: Frame) -> Pose | None:
        """Return the body's pose in a frame; None where it was not seen."""
        taken = self._frame_clock.taken(frame.received, frame.number, frame.rate, frame.latency)
        if not frame.bodies:
            self.fault, self.hidden = str(Verdict.OCCLUDED), self.hidden + 1
            return None
        self.fault, body = "", frame.bodies[0]
        return Pose(taken, frame.received, body.position, body.quaternion, frame.number)

    def _judge_new_poses(self, check: PoseCheck) -> None:
        """Read poses for the first call of `poses`, and check that they are upright and in metres."""
        for pose in self._read():
            self._first.append(pose)
            if check.judge(pose.time, pose, pose.number) is Verdict.GOOD:
                _check_looks(pose, str(self._uri))

    # Error messages.

    def _check_subject(self) -> None:
        """Raise InputError as soon as it is clear that this body will never be seen."""
        if self._scene is None:
            return
        subjects = {subject.name: subject for subject in self._scene.subjects}
        subject = subjects.get(self._uri.subject)
        if subject is None:
            raise no_such_body(self._uri, subjects.keys())
        if self._uri.system == "vicon-sdk" and subject.name not in subject.segments:
            raise InputError(
                f"the segment of {subject.name!r} is named {' and '.join(map(repr, subject.segments)) or 'nothing'}",
                where=str(self._uri),
                hint=f"Vicon's own client sees only a segment named as its body: rename it to {subject.name!r}, "
                "or use vicon://, which takes the root segment",
            )

    def _nothing_came(self, check: PoseCheck) -> CfplanError:
        assert self._feed is not None
        counts = check.counts + Counter({Verdict.OCCLUDED: self.hidden})
        total = counts.total()
        where = str(self._uri)
        if not total:
            return LinkError(
                f"no frame within {self._open_within:g} s ({self._feed.stage})",
                where=where,
                hint="is the system live and streaming, and is this computer in its network?",
            )
        worst, count = counts.most_common(1)[0]
        if self._uri.system == "vrpn" and worst is Verdict.OCCLUDED and count == total:
            return nothing_by_vrpn(self._uri, self._open_within)
        hints = {
            Verdict.OCCLUDED: "are its markers in view, and is its name right? `cfplan mocap` lists the bodies",
            Verdict.FROZEN: "is the system paused, or playing nothing?",
            Verdict.REPEATED: "is the system paused?",
            Verdict.BROKEN: "calibrate the body anew",
            Verdict.JUMPED: "are two bodies' markers alike, or do reflections look like markers?",
            Verdict.FLIPPED: "make the pattern of its markers less symmetric",
        }
        return InputError(
            f"no good pose of {self._uri.subject!r} within {self._open_within:g} s: {count} of {total} {worst}",
            where=where,
            hint=hints.get(worst, "too few frames: is the rate of the cameras right?"),
        )


def _check_looks(pose: Pose, where: str) -> None:
    """Raise InputError if poses are in millimetres or another axis is up."""
    farthest = max(map(abs, pose.position))
    if farthest > _FARTHEST:
        raise InputError(
            f"the body is {farthest:.0f} m from the origin: millimetres taken as metres?",
            where=where,
            hint="let the system send metres",
        )
    x, y = pose.quaternion[:2]
    upright = 1.0 - 2.0 * (x * x + y * y)  # z component of the body's z axis
    if upright < math.cos(_LARGEST_TILT):
        tilt = math.degrees(math.acos(max(-1.0, upright)))
        raise InputError(
            f"the body is tilted by {tilt:.0f}° before take-off: is y up instead of z?",
            where=where,
            hint="set the system to z up, and define the body anew with the vehicle level and pointing along x",
        )
