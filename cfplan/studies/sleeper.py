"""A process that only sleeps until deadlines: how late it wakes is what the computer itself adds to any other."""

import contextlib
import gc
import math
import multiprocessing
import signal
import time
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from cfplan.flight.pace import Pace, go_first


class Sleeper:
    """A process that sleeps until deadlines, at the rate of the stream, while the block lasts."""

    def __init__(self, rate: float, *, first: bool):
        # rate in Hz; first by SCHED_FIFO
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_sleep, args=(theirs, rate, first), name="sleeper", daemon=True)
        self._process.start()
        theirs.close()
        self._woken = np.empty((0, 2))
        self._queued = np.empty((0, 2))

    def __enter__(self) -> "Sleeper":
        self._connection.recv()  # it sleeps by now
        return self

    def __exit__(self, *_: object) -> None:
        self._connection.send(None)
        self._woken, self._queued = (np.array(table).reshape(-1, 2) for table in self._connection.recv())
        self._process.join()

    def watch(self, process: int) -> None:
        """From now on note at each waking how long that process's first thread waited for a processor."""
        self._connection.send(process)

    def queued(self, begin: float, end: float) -> list[float]:
        """s that it waited, in each period between these times; empty where the system does not tell."""
        when = self._queued[:, 0]
        found: list[float] = np.diff(self._queued[(when >= begin) & (when <= end), 1]).tolist()
        return found

    def late(self, begin: float = -math.inf, end: float = math.inf) -> list[float]:
        """s by which each waking was late whose deadline lies between."""
        due = self._woken[:, 0]
        found: list[float] = self._woken[(due >= begin) & (due <= end), 1].tolist()
        return found


def _sleep(connection: Connection, rate: float, first: bool) -> None:
    """The sleeper's process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for whoever started this
    if first:
        go_first()
    woken: list[tuple[float, float]] = []
    queued: list[tuple[float, float]] = []
    watched: Path | None = None
    connection.send(None)
    pace = Pace(rate)
    gc.freeze()
    while True:
        due = pace.wait()
        woken.append((due, time.monotonic() - due))
        if watched is not None:
            with contextlib.suppress(OSError):  # it has ended
                queued.append((due, int(watched.read_text(encoding="ascii").split()[1]) / 1e9))
        if connection.poll():
            process = connection.recv()
            if process is None:
                break
            told = Path(f"/proc/{process}/task/{process}/schedstat")
            watched = told if told.is_file() else None
    connection.send((woken, queued))
