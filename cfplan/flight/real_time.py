"""Real-time scheduling: give a thread priority, and keep its pages in memory."""

import contextlib
import ctypes
import os
import platform
import struct
import sys
import threading

STREAM_PRIORITY = 20  # of SCHED_FIFO, for the thread that sends setpoints
# MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT of mlockall(2): every page, now and later, once it is used
_LOCK_ALL_IN_USE = 1 | 2 | 4
_SHORTEST_SLICE = 100_000  # ns, the shortest that Linux grants
# numbers of the system call, for which older C libraries have no name
_SCHED_SETATTR = {"x86_64": 314, "aarch64": 274, "riscv64": 274}
# struct sched_attr: size, policy, flags, nice, priority, runtime, deadline, period
_SCHED_ATTR = struct.Struct("=IIQiIQQQ")


def uses_fifo_scheduling() -> bool:
    """Return whether the calling thread is scheduled ahead of ordinary ones."""
    return hasattr(os, "SCHED_FIFO") and os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO


def use_fifo_scheduling(priority: int = STREAM_PRIORITY, thread: int = 0) -> bool:
    """Schedule a thread of this process, by default the calling one, ahead of ordinary ones; return if permitted."""
    try:
        os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority))
    except (OSError, AttributeError):  # not permitted; not on this system
        return False
    return True


def shorten_time_slice(thread: int = 0) -> bool:
    """Shorten the time slice of a thread of this process, so that it waits less; return if granted.

    Unlike `use_fifo_scheduling` this needs no permission. Linux has per-thread time slices from 6.12 on; older kernels
    accept the call and ignore it.
    """
    number = _SCHED_SETATTR.get(platform.machine()) if sys.platform.startswith("linux") else None
    if number is None:
        return False
    nice = os.getpriority(os.PRIO_PROCESS, thread)
    wanted = _SCHED_ATTR.pack(_SCHED_ATTR.size, os.SCHED_OTHER, 0, nice, 0, _SHORTEST_SLICE, 0, 0)
    return int(ctypes.CDLL(None).syscall(number, thread, wanted, 0)) == 0


def use_ordinary_scheduling(process: int) -> None:
    """Schedule a process as an ordinary one, whatever it inherited."""
    with contextlib.suppress(OSError, AttributeError):  # it has ended; not on this system
        os.sched_setscheduler(process, os.SCHED_OTHER, os.sched_param(0))


def may_use_fifo_scheduling() -> bool:
    """Return whether `use_fifo_scheduling` is permitted; tried in a thread that ends at once."""
    permitted: list[bool] = []
    thread = threading.Thread(target=lambda: permitted.append(use_fifo_scheduling()))
    thread.start()
    thread.join()
    return permitted[0]


def lock_memory() -> bool:
    """Keep the pages that this process uses in memory; return if permitted.

    Otherwise a system that trims its caches may drop code that runs once a second, and reading it back takes
    milliseconds.
    """
    if not sys.platform.startswith("linux"):
        return False
    import resource

    # With a limit that is not reached yet, an allocation in flight might fail instead.
    unlimited = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY
    if not unlimited and os.geteuid() != 0:
        return False
    return int(ctypes.CDLL(None).mlockall(_LOCK_ALL_IN_USE)) == 0
