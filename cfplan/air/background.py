"""Background checks in a thread, or in a separate process that does not compete for the interpreter's lock.

They run in a thread unless this process has started a process for them. If that process has died, the caller runs them.
"""

import contextlib
import multiprocessing
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from typing import Any, Protocol

Check = Callable[[], Any]  # a functools.partial, which can be pickled


class Pending(Protocol):
    """A check that is running or queued."""

    def result(self) -> Any:
        """Wait for the check; return its value or raise its error."""

    def exception(self) -> BaseException | None:
        """Wait for the check; return the error that it raised, if any."""


class BackgroundChecks(Protocol):
    """A thread or a process that runs checks."""

    def begin(self, *checks: Check) -> list[Pending]:
        """Queue checks, which run one after another behind those queued before."""


class ChecksByThread:
    """Runs checks in a thread of this process."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, "checks")

    def begin(self, *checks: Check) -> list[Pending]:
        return [self._pool.submit(check) for check in checks]


class ChecksByProcess:
    """Runs checks in a separate process, which ends when this one does, however it ends."""

    def __init__(self, prepare: Callable[[], None]):
        """Start the process, which first calls `prepare`."""
        context = multiprocessing.get_context("spawn")
        self._pipe, other = context.Pipe()
        context.Process(target=_serve, args=(other, prepare), name="checks", daemon=True).start()
        other.close()  # so that the pipe ends with the process
        self._last: _Answer | None = None

    def begin(self, *checks: Check) -> list[Pending]:
        if self._last is not None:
            self._last.exception()  # else each side might block until the other reads
        with contextlib.suppress(OSError):
            self._pipe.send(checks)
        answers: list[Pending] = []
        for check in checks:
            self._last = _Answer(self._pipe, check, self._last)
            answers.append(self._last)
        return answers


class _Answer:
    """The outcome of a check, read from the pipe after those of the checks before it."""

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
    """Run a check; return its value, or the error that it raised."""
    try:
        return check(), None
    except Exception as error:
        return None, error


def _serve(pipe: Connection, prepare: Callable[[], None]) -> None:
    """Run incoming checks until the other process has ended."""
    with contextlib.suppress(EOFError, OSError):
        prepare()
        while True:
            for check in pipe.recv():
                pipe.send(_done(check))


_checks: BackgroundChecks = ChecksByThread()


def background_checks() -> BackgroundChecks:
    """Return the thread or process that runs checks for this process."""
    return _checks


def do_checks_by(other: BackgroundChecks) -> None:
    """Run the checks of this process in another thread or process from now on."""
    global _checks
    _checks = other
