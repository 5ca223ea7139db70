"""Poses of the vehicle, and the interface that every source of poses has."""

from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class Pose:
    """Where the vehicle was seen at one moment."""

    time: float  # s on the clock of time.monotonic(), when it was there (already less the source's latency)
    received: float  # s, when it reached this process
    position: tuple[float, float, float]  # m
    quaternion: tuple[float, float, float, float]  # body→world, x y z w
    number: int | None = None  # of its frame, where frames are counted


class PoseSource(Protocol):
    """Delivers poses as they are seen, each once; `PoseTracker` judges them. Opened in the process that uses it."""

    fault: str  # why no pose comes; "" while poses come, or if the source does not know

    def open(self) -> None:
        """Start. Raises a CfplanError within 5 s if no pose can come."""

    def poses(self) -> list[Pose]:
        """Return the poses since the last call, oldest first; never waits."""

    def close(self) -> None:
        """Stop; may be called twice."""
