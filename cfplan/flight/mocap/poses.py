"""One face for every source of poses."""

from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class Pose:
    """Where the vehicle was."""

    time: float  # s on the clock of time.monotonic(), when it was there (already less the source's latency)
    received: float  # s, when it reached this process
    position: tuple[float, float, float]  # m
    quaternion: tuple[float, float, float, float]  # body→world, x y z w


class PoseSource(Protocol):
    """Gives poses as they come; never the same one twice. Opened in the process that uses it."""

    fault: str  # why none comes; "" while good ones do, or where it cannot tell

    def open(self) -> None:
        """Begin. Raises a CfplanError within 5 s where nothing can come."""

    def poses(self) -> list[Pose]:
        """All that came since the last call, oldest first; empty when there is none. Never blocks."""

    def tell_attitude(self, attitude: tuple[float, float, float, float]) -> None:
        """What the vehicle believes its attitude to be, now; helps to judge the next pose."""

    def close(self) -> None:
        """End; may be called twice."""
