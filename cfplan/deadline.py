"""Deadline: the moment by which planning answers with what it has.

Code that works in rounds asks between two rounds whether the deadline has passed; until then it changes nothing. By
default a deadline counts the time that a user waits, not processor time, and stops counting while code is compiled.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from cfplan.machine_code import time_without_compiling


@dataclass(frozen=True, slots=True)
class Deadline:
    """A moment on a clock."""

    at: float = math.inf  # s on the clock
    now: Callable[[], float] = time_without_compiling  # the clock; that of tests counts how often it was asked

    @staticmethod
    def after(seconds: float, now: Callable[[], float] = time_without_compiling) -> "Deadline":
        """Return the deadline that many seconds from now; it never passes if they are infinite."""
        return Deadline(now() + seconds, now) if seconds < math.inf else NEVER

    @property
    def passed(self) -> bool:
        """Return whether it has passed."""
        return self.at < math.inf and self.now() >= self.at

    @property
    def left(self) -> float:
        """Return how many seconds are left, at least 0."""
        return max(self.at - self.now(), 0.0) if self.at < math.inf else math.inf

    def earlier(self, seconds: float) -> "Deadline":
        """Return the deadline that lies as many seconds before it."""
        return replace(self, at=self.at - seconds)


NEVER = Deadline()
