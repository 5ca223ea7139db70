"""Deadlines at a fixed rate that do not drift, and how well they were met."""

import contextlib
import ctypes
import math
import os
import platform
import struct
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

STREAM_PRIORITY = 20  # of SCHED_FIFO, for the thread that sends setpoints
_LOCK_ALL_IN_USE = 1 | 2 | 4
# MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT of mlockall(2): every page, now and later, once it is used
_SHORT_SLICE = 100_000  # ns, the shortest that Linux grants
_SCHED_SETATTR = {"x86_64": 314, "aarch64": 274, "riscv64": 274}
# numbers of the system call, which has no name in older C libraries
_SCHED_ATTR = struct.Struct("=IIQiIQQQ")
# struct sched_attr: size, policy, flags, nice, priority, runtime, deadline, period


@dataclass(frozen=True, slots=True)
class Lateness:
    """How long after their deadlines setpoints were handed to the link."""

    p50: float
    # s
    p99: float
    # s
    max: float
    # s
    count: int
    skipped: int
    # deadlines that passed altogether; the clock chose a later setpoint instead

    @classmethod
    def of(cls, late: Sequence[float], skipped: int) -> "Lateness":
        values = np.array(late) if late else np.zeros(1)
        p50, p99 = np.percentile(values, [50, 99])
        return cls(float(p50), float(p99), float(values.max()), len(late), skipped)


class Pace:
    """Absolute deadlines: the next one is where it was always going to be, however late this one was."""

    def __init__(
        self,
        rate: float,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ):
        self._period, self._clock, self._sleep = 1.0 / rate, clock, sleep
        self._first, self._count = clock(), 0
        self.skipped = 0

    @property
    def upcoming(self) -> float:
        """s, the next deadline that is still to come."""
        passed = math.floor((self._clock() - self._first) / self._period)
        return self._first + (max(self._count, passed) + 1) * self._period

    def wait(self) -> float:
        """Sleep until the next deadline that is still to come; its time."""
        self._count += 1
        due = self._first + self._count * self._period
        now = self._clock()
        if now - due > self._period:
            missed = int((now - due) / self._period)
            self.skipped += missed
            self._count += missed
            due += missed * self._period
        if due > now:
            self._sleep(due - now)
        return due


def sleep_lateness(rate: float, duration: float) -> Lateness:
    """How late this computer wakes a process that sleeps until deadlines, now."""
    pace, late = Pace(rate), []
    for _ in range(int(duration * rate)):
        due = pace.wait()
        late.append(time.monotonic() - due)
    return Lateness.of(late, pace.skipped)


def goes_first() -> bool:
    """Whether the calling thread is scheduled ahead of ordinary ones."""
    return hasattr(os, "SCHED_FIFO") and os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO


def go_first(priority: int = STREAM_PRIORITY, thread: int = 0) -> bool:
    """Have a thread of this process, the calling one, scheduled ahead of ordinary ones; whether that is permitted."""
    try:
        os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority))
    except (OSError, AttributeError):  # not permitted; not on this system
        return False
    return True


def wake_promptly(thread: int = 0) -> bool:
    """Have a thread of this process wait less for the processor, for shorter turns on it; whether that was granted.

    Needs no permission, unlike `go_first`. Linux from 6.12 on knows turns of one's own; an older one grants this and
    does nothing.
    """
    number = _SCHED_SETATTR.get(platform.machine()) if sys.platform.startswith("linux") else None
    if number is None:
        return False
    nice = os.getpriority(os.PRIO_PROCESS, thread)
    wanted = _SCHED_ATTR.pack(_SCHED_ATTR.size, os.SCHED_OTHER, 0, nice, 0, _SHORT_SLICE, 0, 0)
    return int(ctypes.CDLL(None).syscall(number, thread, wanted, 0)) == 0


def go_with_all(process: int) -> None:
    """Have a process scheduled as ordinary ones are, whatever it inherited."""
    with contextlib.suppress(OSError, AttributeError):  # it has ended; not on this system
        os.sched_setscheduler(process, os.SCHED_OTHER, os.sched_param(0))


def may_go_first() -> bool:
    """Whether that would be permitted; tried in a thread that ends at once."""
    permitted: list[bool] = []
    thread = threading.Thread(target=lambda: permitted.append(go_first()))
    thread.start()
    thread.join()
    return permitted[0]


def stay_in_memory() -> bool:
    """Keep the pages that this process uses from being taken away and read again; whether that is permitted.

    Of code that runs once a second they are taken where a system trims its caches, and reading them back takes
    milliseconds.
    """
    if not sys.platform.startswith("linux"):
        return False
    import resource

    # Under a limit that is not reached yet, some allocation in flight would be refused instead.
    unlimited = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY
    if not unlimited and os.geteuid() != 0:
        return False
    return int(ctypes.CDLL(None).mlockall(_LOCK_ALL_IN_USE)) == 0
