"""Faults of motion capture, each for a time and by a size, and their effect on what the cameras see."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar

from cfplan.flight.telemetry import Quaternion, Triple
from cfplan.simulation.timed_fault import TimedFault

Seen = tuple[Triple, Quaternion]  # position m, body→world x y z w


class FaultKind(StrEnum):
    """Kinds of faults."""

    OCCLUDE = "occlude"  # the body is not seen
    STALL = "stall"  # no packet comes; frames are still counted
    FREEZE = "freeze"  # new frames with the old pose
    REPEAT = "repeat"  # the same frame again and again
    JUMP = "jump"  # the pose is off by `size` m along x
    FLIP = "flip"  # the body is turned by `size` rad about its own z
    BREAK = "break"  # the pose is not a number
    SWAP = "swap"  # two bodies have each other's names
    DELAY = "delay"  # packets come `size` s later
    CLOSE = "close"  # connections are reset and new ones refused


@dataclass(frozen=True, slots=True)
class ViconFault(TimedFault):
    """One fault of motion capture; one of the settings starts with the server."""

    kind: FaultKind
    subject: str | None = None  # None: every body
    usual: ClassVar[Mapping[StrEnum, float]] = {FaultKind.JUMP: 1.0, FaultKind.FLIP: math.pi, FaultKind.DELAY: 0.2}


class Faults:
    """The faults of one server, applied to what the cameras see."""

    def __init__(self) -> None:
        self.all: list[tuple[float, float, ViconFault]] = []  # each with when it begins and ends, s
        self._held: dict[str, Seen] = {}

    def add(self, fault: ViconFault, now: float) -> None:
        """Add a fault; its start counts from now."""
        self.all.append((now + fault.start, now + fault.start + fault.duration, fault))

    def end(self, now: float) -> None:
        """Let all faults end, also those that have not begun."""
        self.all = [(start, min(end, now), fault) for start, end, fault in self.all]

    def acting(self, kind: FaultKind, time: float, subject: str | None = None) -> ViconFault | None:
        """Return a fault of this kind that acts on this body at this time; None if there is none."""
        for start, end, fault in self.all:
            if fault.kind is kind and start <= time < end and fault.subject in (None, subject):
                return fault
        return None

    def seen(self, time: float, truth: Mapping[str, Seen]) -> dict[str, Seen]:
        """Return the bodies as the cameras see them, from where they are; hidden ones are left out."""
        if not self.all:
            self._held |= truth
            return dict(truth)
        names = list(truth)
        if len(names) > 1 and self.acting(FaultKind.SWAP, time):
            truth = dict(truth) | {names[0]: truth[names[1]], names[1]: truth[names[0]]}
        shown: dict[str, Seen] = {}
        for name, (position, quaternion) in truth.items():
            if self.acting(FaultKind.OCCLUDE, time, name):
                continue
            if self.acting(FaultKind.FREEZE, time, name) and name in self._held:
                position, quaternion = self._held[name]
            else:
                self._held[name] = position, quaternion
            if jump := self.acting(FaultKind.JUMP, time, name):
                position = (position[0] + jump.strength, position[1], position[2])
            if flip := self.acting(FaultKind.FLIP, time, name):
                quaternion = _turned_about_z(quaternion, flip.strength)
            if self.acting(FaultKind.BREAK, time, name):
                position, quaternion = (math.nan,) * 3, (math.nan,) * 4
            shown[name] = position, quaternion
        return shown


def _turned_about_z(quaternion: Quaternion, angle: float) -> Quaternion:
    x, y, z, w = quaternion
    s, c = math.sin(angle / 2), math.cos(angle / 2)
    return x * c + y * s, y * c - x * s, z * c + w * s, w * c - z * s
