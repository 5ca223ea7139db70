"""Poses of the vehicle, and the interface that every source of poses has."""

from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class Pose:
    """Where the vehicle was at one moment."""

    time: float  # s on the clock of time.monotonic(), when it was there (already less the source's latency)
    received: float  # s, when it reached this process
    position: tuple[float, float, float]  # m
    quaternion: tuple[float, float, float, float]  # body→world, x y z w


class PoseSource(Protocol):
    """Delivers poses as they come, each once. Opened in the process that uses it."""

    fault: str  # why no pose comes; "" while good ones come, or if the source does not know

    def open(self) -> None:
        """Start. Raises a CfplanError within 5 s if no pose can come."""

    def poses(self) -> list[Pose]:
        """Return the poses since the last call, oldest first; never waits."""

    def tell_attitude(self, attitude: tuple[float, float, float, float]) -> None:
        """Take the vehicle's own estimate of its attitude, now; it helps to judge the next pose."""

    def close(self) -> None:
        """Stop; may be called twice."""
