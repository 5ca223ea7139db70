"""What comes from a motion capture system, whichever it is: plain data that goes through a pipe."""

import math
from dataclasses import dataclass
from typing import Protocol

from cfplan.flight.telemetry import Quaternion, Triple


@dataclass(frozen=True, slots=True)
class TrackedBody:
    """A body that was seen in a frame."""

    name: str
    position: Triple  # m
    quaternion: Quaternion  # body→world, x y z w; not a number where the system sent no rotation
    quality: float = math.nan  # 0 to 1, where the system tells


@dataclass(frozen=True, slots=True)
class Frame:
    """One frame of the cameras."""

    received: float  # s on the clock of time.monotonic(), when it reached this computer
    bodies: tuple[TrackedBody, ...]  # those that were seen
    hidden: tuple[str, ...] = ()  # those that the system knows and did not see
    number: int | None = None  # of the system's own count, where it tells
    rate: float = math.nan  # Hz, where the system tells
    latency: float = math.nan  # s from the exposure to the system's sending, where it tells


@dataclass(frozen=True, slots=True)
class Subject:
    """A body that the system knows, seen or not."""

    name: str
    segments: tuple[str, ...]  # names, the root first


@dataclass(frozen=True, slots=True)
class Scene:
    """All that the system knows."""

    subjects: tuple[Subject, ...]


@dataclass(frozen=True, slots=True)
class Stage:
    """What the driver is about to do; where it hangs, this is the last that is heard of it."""

    text: str


class Driver(Protocol):
    """A client of one kind of system. May hang or die: it runs in a process of its own."""

    def connect(self) -> None:
        """Find the system. Raises a CfplanError where it is not there."""

    def wait(self) -> Frame:
        """The next frame, as soon as it is there. Raises LinkError where the stream has ended."""

    def scene(self) -> Scene | None:
        """What the system knows, as of the last frame; None where it does not tell."""

    def close(self) -> None:
        """End; may be called twice, and before connecting."""
