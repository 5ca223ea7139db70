"""Survey of a motion capture system: its stream, its bodies, and whether they are good enough to fly with."""

import math
import statistics
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

from cfplan.errors import CfplanError, LinkError
from cfplan.flight.clock import REAL_CLOCK, Clock
from cfplan.flight.mocap.clock import FrameClock
from cfplan.flight.mocap.feed import Feed
from cfplan.flight.mocap.frames import Frame, Scene, TrackedBody
from cfplan.flight.mocap.pose_check import PoseCheck, Verdict
from cfplan.flight.mocap.uri import MocapUri, no_such_body, nothing_by_vrpn
from cfplan.flight.telemetry import Triple
from cfplan.vehicle.rotations import tilt_of, yaw_of

FIRST_FRAME_TIMEOUT = 3.5  # s
_JUMP = 0.15  # m
_DROPOUT = 1.5  # periods between frames, beyond which a frame counts as missing
_READ_PERIOD = 0.005  # s
_SHOW_PERIOD = 0.25  # s


@dataclass(frozen=True, slots=True)
class BodyReport:
    """One body over the time of the survey."""

    name: str
    segments: tuple[str, ...]  # the root first; empty if the system does not report them
    counts: dict[str, int]  # frames by verdict
    position: Triple | None  # m, the last
    yaw: float  # rad, the last
    tilt: float  # rad, the last
    quality: float  # the last; NaN if the system does not report it

    @property
    def seen(self) -> float:
        """Return the fraction of frames in which the body was seen."""
        total = sum(self.counts.values())
        return 1.0 - self.counts.get(Verdict.OCCLUDED, 0) / total if total else 0.0

    @property
    def remark(self) -> str:
        """Return a warning about the body; "" if there is none."""
        if self.segments and self.name not in self.segments:
            return f"its segment is named {self.segments[0]!r}: Vicon's own client (vicon-sdk://) will not see it"
        if self.counts.get(Verdict.GOOD, 0) == 0:
            return "never seen" if self.position is None else "no good pose"
        if self.tilt > math.radians(45):
            return "not level: is y up instead of z?"
        if self.position is not None and max(map(abs, self.position)) > 30.0:
            return "far away: millimetres taken as metres?"
        return ""


@dataclass(frozen=True, slots=True)
class Survey:
    """The stream, and each body in it."""

    seconds: float
    frames: int
    rate: float  # Hz, measured
    announced_rate: float  # Hz, as the system reports it, else NaN
    jitter: float  # s, standard deviation of the time between frames
    longest_gap: float  # s between frames
    dropouts: int  # missing frames, by their numbers if there are any, else by the gaps
    latency: float  # s from exposure to sending, as the system reports it, else NaN
    delay: float
    """s, 99th percentile of the delay above the shortest one; NaN without frame numbers, or too early."""
    bodies: tuple[BodyReport, ...]


class Surveyor:
    """Gathers frames for a survey."""

    def __init__(self) -> None:
        self._received: list[float] = []
        self._delays: list[float] = []
        self._missing = 0
        self._last: Frame | None = None
        self._clock = FrameClock(0.0)
        self._checks: dict[str, PoseCheck] = {}
        self._bodies: dict[str, TrackedBody] = {}
        self.scene: Scene | None = None

    @property
    def frames(self) -> int:
        """Return the number of frames."""
        return len(self._received)

    def add(self, frame: Frame) -> None:
        """Add a frame."""
        last, self._last = self._last, frame
        self._received.append(frame.received)
        taken = self._clock.taken(frame.received, frame.number, frame.rate)
        if self._clock.sure:
            self._delays.append(frame.received - taken)
        if last is not None and last.number is not None and frame.number is not None:
            self._missing += max(0, frame.number - last.number - 1)
        seen = {body.name: body for body in frame.bodies}
        self._bodies |= seen
        for name in [*seen, *frame.hidden]:
            self._checks.setdefault(name, PoseCheck(_JUMP)).judge(taken, seen.get(name), frame.number)

    def report(self) -> Survey:
        """Return the survey so far."""
        gaps = [b - a for a, b in zip(self._received, self._received[1:], strict=False)]
        span = self._received[-1] - self._received[0] if gaps else 0.0
        last = self._last
        numbered = last is not None and last.number is not None
        period = statistics.median(gaps) if gaps else math.inf
        delays = sorted(self._delays)
        return Survey(
            seconds=span,
            frames=len(self._received),
            rate=len(gaps) / span if span > 0 else 0.0,
            announced_rate=last.rate if last else math.nan,
            jitter=statistics.pstdev(gaps) if gaps else 0.0,
            longest_gap=max(gaps, default=0.0),
            dropouts=self._missing
            if numbered
            else sum(round(gap / period) - 1 for gap in gaps if gap > _DROPOUT * period),
            latency=last.latency if last else math.nan,
            delay=delays[int(0.99 * len(delays))] if delays else math.nan,
            bodies=tuple(self._body(name) for name in self._names()),
        )

    def _names(self) -> list[str]:
        known = [subject.name for subject in self.scene.subjects] if self.scene else []
        return known + sorted(self._checks.keys() - set(known))

    def _body(self, name: str) -> BodyReport:
        subjects = self.scene.subjects if self.scene else ()
        segments = next((subject.segments for subject in subjects if subject.name == name), ())
        counts: Counter[Verdict] = self._checks[name].counts if name in self._checks else Counter()
        body = self._bodies.get(name)
        quaternion = body.quaternion if body else (math.nan,) * 4
        return BodyReport(
            name=name,
            segments=segments,
            counts={str(verdict): count for verdict, count in counts.items()},
            position=body.position if body else None,
            yaw=float(yaw_of(quaternion)),
            tilt=float(tilt_of(quaternion)),
            quality=body.quality if body else math.nan,
        )


def survey(
    uri: MocapUri,
    seconds: float,
    show: Callable[[Survey], None] = lambda _: None,
    *,
    clock: Clock = REAL_CLOCK,
    make_feed: Callable[[MocapUri], Feed] = Feed,
) -> Survey:
    """Return a survey of `seconds` of a system's stream; `show` gets the survey so far a few times a second.

    Raises a CfplanError if no frame comes, or if the URI names an unknown body.
    """
    surveyor, shown = Surveyor(), 0.0
    with make_feed(replace(uri, subject="")) as feed:
        feed.start()
        end = clock.now() + FIRST_FRAME_TIMEOUT
        while clock.now() < end:
            for message in feed.messages():
                if isinstance(message, CfplanError):
                    raise message
                if isinstance(message, Scene):
                    surveyor.scene = message
                    _check_subject(uri, {subject.name for subject in message.subjects})
                elif isinstance(message, Frame):
                    if not surveyor.frames:
                        end = clock.now() + seconds
                    surveyor.add(message)
            if failure := feed.failure():
                raise failure
            if surveyor.frames and clock.now() - shown > _SHOW_PERIOD:
                shown = clock.now()
                show(surveyor.report())
            clock.sleep(_READ_PERIOD)
        if not surveyor.frames:
            hint = "is the system live and streaming?"
            raise LinkError(f"no frame within {FIRST_FRAME_TIMEOUT:g} s ({feed.stage})", where=str(uri), hint=hint)
    found = surveyor.report()
    if uri.system == "vrpn" and not found.bodies:
        raise nothing_by_vrpn(uri, found.seconds)
    _check_subject(uri, {body.name for body in found.bodies})
    return found


def _check_subject(uri: MocapUri, there: set[str]) -> None:
    if uri.subject and uri.subject not in there:
        raise no_such_body(uri, there)
