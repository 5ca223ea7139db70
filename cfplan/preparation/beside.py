"""Work beside the caller: by a thread, or by a process, which the interpreter's lock does not hold up.

A thread does it unless this process has begun another for that. Where that has died, the work is done here.
"""

import contextlib
import ctypes
import multiprocessing
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from typing import Any, Protocol

Work = Callable[[], Any]  # as functools.partial makes it, which goes from process to process


class Pending(Protocol):
    """What is done beside."""

    def done(self) -> bool:
        """Return whether it is, without waiting."""

    def result(self) -> Any:
        """Wait for what it returns or raises."""

    def exception(self) -> BaseException | None:
        """Wait for what it raises."""


class Beside(Protocol):
    """Who does such work."""

    def begin(self, *works: Work) -> list[Pending]:
        """Begin to do one after another, once what was begun before is done."""

    def wake(self) -> None:
        """Get ready, as there will be work soon."""


class BesideByThread:
    """A thread of this process."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, "beside")

    def begin(self, *works: Work) -> list[Pending]:
        return [self._pool.submit(work) for work in works]

    def wake(self) -> None:
        pass  # a thread shares the caches of whoever asks


class BesideByProcess:
    """A process of its own; it ends with this one, whatever that dies of."""

    def __init__(self, prepare: Callable[[], None]):
        """Start it; there it calls `prepare` first."""
        context = multiprocessing.get_context("spawn")
        self._pipe, other = context.Pipe()
        process = context.Process(target=_serve, args=(other, prepare), name="beside", daemon=True)
        process.start()
        other.close()  # so that the pipe ends with the process
        self._elsewhere = _Elsewhere(process.pid)
        self._last: _Answer | None = None

    def begin(self, *works: Work) -> list[Pending]:
        if self._last is not None:
            self._last.exception()  # else both might wait until the other reads
        self._elsewhere.keep()
        with contextlib.suppress(OSError):
            self._pipe.send(works)
        answers: list[Pending] = []
        before = None
        for work in works:
            before = _Answer(self._pipe, work, before)
            answers.append(before)
        self._last = before
        return answers

    def wake(self) -> None:
        """Let it do once more, for nobody, what it did last: where it has slept that takes half as long again."""
        self._elsewhere.keep()
        with contextlib.suppress(OSError):
            self._pipe.send(())


class _Elsewhere:
    """Keeps a process off the processor that this thread runs on.

    The scheduler likes to wake a process where the one that called it runs, although that goes on. There they take
    turns of some ms each, and such work takes hardly longer.
    """

    def __init__(self, process_id: int | None):
        self._process_id = process_id
        self._all: set[int] = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set()
        self._off = -1

    def keep(self) -> None:
        """Let it run on any other processor, if there is one and the system lets one choose."""
        if len(self._all) < 2 or _libc is None or self._process_id is None:
            return
        here = _libc.sched_getcpu()
        if here != self._off:
            self._off = here
            with contextlib.suppress(OSError):  # it has ended
                os.sched_setaffinity(self._process_id, self._all - {here})


class _Answer:
    """What comes back of a piece of work, behind that of the one before."""

    def __init__(self, pipe: Connection, work: Work, before: "_Answer | None"):
        self._pipe, self._work, self._before = pipe, work, before
        self._outcome: tuple[Any, BaseException | None] | None = None

    def _received(self) -> tuple[Any, BaseException | None]:
        if self._outcome is None:
            if self._before is not None:
                self._before._received()
                self._before = None
            try:
                self._outcome = self._pipe.recv()
            except (EOFError, OSError):
                self._outcome = _done(self._work)
        return self._outcome

    def done(self) -> bool:
        if self._outcome is None and (self._before is None or self._before.done()):
            with contextlib.suppress(OSError):  # it has ended; what is left to do is done where it is asked for
                if self._pipe.poll():
                    self._received()
        return self._outcome is not None

    def result(self) -> Any:
        returned, raised = self._received()
        if raised is not None:
            raise raised
        return returned

    def exception(self) -> BaseException | None:
        return self._received()[1]


def _done(work: Work) -> tuple[Any, BaseException | None]:
    """Return what work returns, and what it raises."""
    try:
        return work(), None
    except Exception as error:
        return None, error


def _serve(pipe: Connection, prepare: Callable[[], None]) -> None:
    """Do what comes until the other process has ended."""
    with contextlib.suppress(EOFError, OSError):
        prepare()
        last: tuple[Work, ...] = ()
        while True:
            if works := pipe.recv():
                last = works
                for work in works:
                    pipe.send(_done(work))
            else:
                for work in last:
                    _done(work)


_libc = ctypes.CDLL(None) if hasattr(os, "sched_setaffinity") else None
_beside: Beside = BesideByThread()


def beside() -> Beside:
    """Return who does such work for this process."""
    return _beside


def work_beside(other: Beside) -> None:
    """Let another do such work for this process from now on."""
    global _beside
    _beside = other
