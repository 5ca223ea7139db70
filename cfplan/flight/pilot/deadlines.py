"""Absolute deadlines at a fixed rate, and how late they were met."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from cfplan.flight.clock import REAL_CLOCK, Clock


@dataclass(frozen=True, slots=True)
class Lateness:
    """How long after their deadlines setpoints were handed to the link."""

    p50: float  # s
    p99: float  # s
    max: float  # s
    count: int
    skipped: int  # deadlines that passed without a setpoint

    @classmethod
    def of(cls, late: Sequence[float], skipped: int) -> "Lateness":
        values = np.array(late) if late else np.zeros(1)
        p50, p99 = np.percentile(values, [50, 99])
        return cls(float(p50), float(p99), float(values.max()), len(late), skipped)


class Deadlines:
    """Deadlines that do not drift: one that is met late does not move the next."""

    def __init__(self, rate: float, clock: Clock = REAL_CLOCK):
        self._period, self._now, self._sleep = 1.0 / rate, clock.now, clock.sleep
        self._first, self._count = clock.now(), 0
        self.skipped = 0

    @property
    def upcoming(self) -> float:
        """Return the next deadline that is still to come, s."""
        passed = math.floor((self._now() - self._first) / self._period)
        return self._first + (max(self._count, passed) + 1) * self._period

    def wait(self, meanwhile: Callable[[float], None] = lambda due: None) -> float:
        """Sleep until the next deadline that is still ahead; return its time, s.

        `meanwhile` is called first with that time, and should return by then.
        """
        self._count += 1
        due = self._first + self._count * self._period
        now = self._now()
        if now - due > self._period:
            missed = int((now - due) / self._period)
            self.skipped += missed
            self._count += missed
            due += missed * self._period
        if due > now:
            meanwhile(due)
            if (left := due - self._now()) > 0.0:
                self._sleep(left)
        return due
