"""Background checks, by a thread or by a process, which the interpreter's lock does not hold up.

A thread does them unless this process has started another for that. Where that has died, they are done here.
"""

import contextlib
import multiprocessing
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from typing import Any, Protocol

Check = Callable[[], Any]  # as functools.partial makes it, which goes from process to process


class Pending(Protocol):
    """A check that is being done."""

    def result(self) -> Any:
        """Wait for what it returns or raises."""

    def exception(self) -> BaseException | None:
        """Wait for what it raises."""


class BackgroundChecks(Protocol):
    """A thread or a process that does checks."""

    def begin(self, *checks: Check) -> list[Pending]:
        """Begin to do one after another, once those begun before are done."""


class ChecksByThread:
    """A thread of this process."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, "checks")

    def begin(self, *checks: Check) -> list[Pending]:
        return [self._pool.submit(check) for check in checks]


class ChecksByProcess:
    """A process of its own; it ends with this one, whatever that dies of."""

    def __init__(self, prepare: Callable[[], None]):
        """Start it; there it calls `prepare` first."""
        context = multiprocessing.get_context("spawn")
        self._pipe, other = context.Pipe()
        context.Process(target=_serve, args=(other, prepare), name="checks", daemon=True).start()
        other.close()  # so that the pipe ends with the process
        self._last: _Answer | None = None

    def begin(self, *checks: Check) -> list[Pending]:
        if self._last is not None:
            self._last.exception()  # else both might wait until the other reads
        with contextlib.suppress(OSError):
            self._pipe.send(checks)
        answers: list[Pending] = []
        for check in checks:
            self._last = _Answer(self._pipe, check, self._last)
            answers.append(self._last)
        return answers


class _Answer:
    """The outcome of a check, behind that of the one before."""

    def __init__(self, pipe: Connection, check: Check, before: "_Answer | None"):
        self._pipe, self._check, self._before = pipe, check, before
        self._outcome: tuple[Any, BaseException | None] | None = None

    def _received(self) -> tuple[Any, BaseException | None]:
        if self._outcome is None:
            if self._before is not None:
                self._before._received()
                self._before = None
            try:
                self._outcome = self._pipe.recv()
            except (EOFError, OSError):
                self._outcome = _done(self._check)
        return self._outcome

    def result(self) -> Any:
        returned, raised = self._received()
        if raised is not None:
            raise raised
        return returned

    def exception(self) -> BaseException | None:
        return self._received()[1]


def _done(check: Check) -> tuple[Any, BaseException | None]:
    """Return what a check returns, and what it raises."""
    try:
        return check(), None
    except Exception as error:
        return None, error


def _serve(pipe: Connection, prepare: Callable[[], None]) -> None:
    """Do the checks that come until the other process has ended."""
    with contextlib.suppress(EOFError, OSError):
        prepare()
        while True:
            for check in pipe.recv():
                pipe.send(_done(check))


_checks: BackgroundChecks = ChecksByThread()


def background_checks() -> BackgroundChecks:
    """Return what does checks for this process."""
    return _checks


def do_checks_by(other: BackgroundChecks) -> None:
    """Let another do the checks of this process from now on."""
    global _checks
    _checks = other
