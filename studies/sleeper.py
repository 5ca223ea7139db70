"""Measure wake-up latency with a process that only sleeps until deadlines: the latency that any program sees."""

import contextlib
import gc
import math
import multiprocessing
import signal
from itertools import pairwise
from multiprocessing.connection import Connection
from pathlib import Path

from cfplan.flight.clock import monotonic
from cfplan.flight.pilot.deadlines import Deadlines
from cfplan.flight.real_time import shorten_time_slice, use_fifo_scheduling

_WATCH, _LATE, _QUEUED, _END = "watch", "late", "queued", None


class Sleeper:
    """A context manager that runs a process which sleeps until deadlines, with the priority of the stream's thread."""

    def __init__(self, rate: float, *, first: bool):
        """Start the process. `rate` is in Hz; `first`: use SCHED_FIFO."""
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_sleep, args=(theirs, rate, first), name="sleeper", daemon=True)
        self._process.start()
        theirs.close()

    def __enter__(self) -> "Sleeper":
        self._connection.recv()  # wait until it sleeps
        return self

    def __exit__(self, *_: object) -> None:
        self._connection.send(_END)
        self._process.join()
        self._connection.close()

    def watch(self, process: int) -> None:
        """Begin to record, at each wake-up, how long the main thread of a process waited for a processor."""
        self._connection.send((_WATCH, process))

    def late(self, begin: float = -math.inf, end: float = math.inf) -> list[float]:
        """Return the wake-up latency, s, of every deadline in [begin, end], by the flight's clock."""
        return [late for _, late in self._ask(_LATE, begin, end)]

    def queued(self, begin: float, end: float) -> list[float]:
        """Return the waiting time, s, of the watched thread in each period of [begin, end]; empty if unknown."""
        totals = [total for _, total in self._ask(_QUEUED, begin, end)]
        return [later - earlier for earlier, later in pairwise(totals)]

    def _ask(self, what: str, begin: float, end: float) -> list[tuple[float, float]]:
        self._connection.send((what, begin, end))
        answer: list[tuple[float, float]] = self._connection.recv()
        return answer


def _sleep(connection: Connection, rate: float, first: bool) -> None:
    """Run the sleeper's process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent process
    if not (first and use_fifo_scheduling()):
        shorten_time_slice()
    noted: dict[str, list[tuple[float, float]]] = {_LATE: [], _QUEUED: []}
    watched: Path | None = None
    connection.send(None)
    deadlines = Deadlines(rate)
    gc.freeze()
    while True:
        due = deadlines.wait()
        noted[_LATE].append((due, monotonic() - due))
        if watched is not None:
            with contextlib.suppress(OSError):  # the process has ended
                noted[_QUEUED].append((due, int(watched.read_text(encoding="ascii").split()[1]) / 1e9))
        if not connection.poll():
            continue
        match connection.recv():
            case (_, process):
                schedstat = Path(f"/proc/{process}/task/{process}/schedstat")
                watched = schedstat if schedstat.is_file() else None
            case (what, begin, end):
                connection.send([note for note in noted[what] if begin <= note[0] <= end])
            case _:
                return
