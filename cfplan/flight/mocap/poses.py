"""Poses of the vehicle, and the interface that every source of poses has."""

from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class Pose:
    """A measured pose of the vehicle."""

    time: float  # s on the flight's clock, when it was measured (the source's latency is subtracted)
    received: float  # s, when it reached this process
    position: tuple[float, float, float]  # m
    quaternion: tuple[float, float, float, float]  # body→world, x y z w
    number: int | None = None  # of its frame, where frames are counted


class PoseSource(Protocol):
    """Delivers each measured pose once; `PoseTracker` judges them. Opened in the process that uses it."""

    fault: str  # why there are no poses; "" while there are, or if the source does not know

    def open(self) -> None:
        """Start. Raises a CfplanError within 5 s if there can be no pose."""

    def poses(self) -> list[Pose]:
        """Return the poses since the last call, oldest first; never waits."""

    def close(self) -> None:
        """Stop; may be called twice."""
