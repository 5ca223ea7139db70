"""Frames, bodies and scenes as every motion capture driver delivers them: plain data that goes through a pipe."""

import math
from dataclasses import dataclass
from typing import Protocol

from cfplan.flight.telemetry import Quaternion, Triple


@dataclass(frozen=True, slots=True)
class TrackedBody:
    """A body that was seen in a frame."""

    name: str
    position: Triple  # m
    quaternion: Quaternion  # body→world, x y z w; not a number if the system sent no rotation
    quality: float = math.nan  # 0 to 1, if the system reports it


@dataclass(frozen=True, slots=True)
class Frame:
    """One frame of the cameras."""

    received: float  # s on the flight's clock, when it reached this computer
    bodies: tuple[TrackedBody, ...]  # bodies that were seen
    hidden: tuple[str, ...] = ()  # known bodies that were not seen
    number: int | None = None  # in the system's own count, if it has one
    rate: float = math.nan  # Hz, if the system reports it
    latency: float = math.nan  # s from exposure to sending, if the system reports it


@dataclass(frozen=True, slots=True)
class Subject:
    """A body that the system knows, seen or not."""

    name: str
    segments: tuple[str, ...]  # names, the root first


@dataclass(frozen=True, slots=True)
class Scene:
    """All bodies that the system knows."""

    subjects: tuple[Subject, ...]


@dataclass(frozen=True, slots=True)
class DriverStage:
    """What the driver is about to do; if it hangs, this is its last message."""

    text: str


class Driver(Protocol):
    """A client of one kind of system. It may hang or die, so it runs in its own process."""

    def connect(self) -> None:
        """Find the system. Raises a CfplanError if it does not answer."""

    def wait(self) -> Frame:
        """Wait for the next frame and return it. Raises LinkError if the stream has ended."""

    def scene(self) -> Scene | None:
        """Return the bodies that the system knows, as of the last frame; None if it does not report them."""

    def close(self) -> None:
        """Disconnect; may be called twice, and before connecting."""
