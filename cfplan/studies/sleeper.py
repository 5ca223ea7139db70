"""A process that only sleeps until deadlines: how late it wakes is what the computer itself adds to any other."""

import gc
import math
import multiprocessing
import signal
import time
from multiprocessing.connection import Connection

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

    def __enter__(self) -> "Sleeper":
        self._connection.recv()  # it sleeps by now
        return self

    def __exit__(self, *_: object) -> None:
        self._connection.send(None)
        self._woken = np.array(self._connection.recv())
        self._process.join()

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
    connection.send(None)
    pace = Pace(rate)
    gc.freeze()
    while not connection.poll():
        due = pace.wait()
        woken.append((due, time.monotonic() - due))
    connection.send(woken)
