"""The clock of a flight: its time, and every way in which its parts wait; real, or stepped for tests and studies.

What flies, records or watches asks its clock for the time and waits by it, so that the same code runs by the computer's
clock and by a stepped one. Time on a `SteppedClock` stands still until somebody waits; then it jumps from one event to
the next. A flight on it takes as long as its arithmetic, ends the same on every run, and does not notice what else the
computer does.
"""

import select
import socket
import threading
import time
from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

BEGIN = 1000.0  # s, where a stepped clock starts
_LONGEST_DEAFNESS = 0.1  # s until a repeated act that waits for a socket notices that it was stopped
_SHORTEST_DELAY = 0.001  # s between repeated acts, on a stepped clock: time goes on between them
_STEP = 0.001  # s between looks at an event that the world may set, on a stepped clock
_LOOK_PERIOD = 0.01  # s between looks at the sockets that wake repeated acts, on a stepped clock


class Source(Protocol):
    """Something that can become readable."""

    def fileno(self) -> int: ...


AnySource = TypeVar("AnySource", bound=Source | int)
Act = Callable[[], float | None]


class Repeated(Protocol):
    """An act that is repeated until it is stopped."""

    def stop(self, patience: float | None = None) -> bool:
        """Repeat it no more; wait for the last one, at most for `patience`, s; return whether it has ended."""


class Clock(Protocol):
    """Time, in s, and waiting."""

    def now(self) -> float:
        """Return the time, s, on a scale that never goes back; only differences mean anything."""

    def sleep(self, duration: float, /) -> None:
        """Let `duration`, s, pass."""

    def wait(self, event: threading.Event, patience: float) -> bool:
        """Wait until the event is set, at most for `patience`, s; return whether it is."""

    def readable(self, sources: Sequence[AnySource], patience: float) -> list[AnySource]:
        """Wait until one of the sources is readable, at most for `patience`, s; return those that are."""

    def repeat(
        self,
        act: Act,
        *,
        name: str,
        last: Callable[[], None] = lambda: None,
        wake: socket.socket | None = None,
    ) -> Repeated:
        """Call `act` beside everything else: now, then whenever the s have passed that it returned, until it is None.

        It is called sooner if `wake` becomes readable. `last` is called once, at the end. `name` is for those who look
        at threads.
        """


def monotonic() -> float:
    """Return the time, s, by the computer's oscillator alone, where the system offers that.

    time.monotonic() follows the corrections of NTP, by up to 8 %, during which all that arrives would seem late.
    """
    return time.clock_gettime(time.CLOCK_MONOTONIC_RAW) if hasattr(time, "CLOCK_MONOTONIC_RAW") else time.monotonic()


class RealClock:
    """The computer's own: `now` is monotonic(), and what is repeated has a thread."""

    now = staticmethod(monotonic)
    sleep = staticmethod(time.sleep)

    def wait(self, event: threading.Event, patience: float) -> bool:
        return event.wait(patience)

    def readable(self, sources: Sequence[AnySource], patience: float) -> list[AnySource]:
        return select.select(sources, [], [], max(patience, 0.0))[0]

    def repeat(
        self,
        act: Act,
        *,
        name: str,
        last: Callable[[], None] = lambda: None,
        wake: socket.socket | None = None,
    ) -> Repeated:
        return _InThread(act, name, last, wake)


REAL_CLOCK = RealClock()


class _InThread:
    """Repeats an act in a thread."""

    def __init__(self, act: Act, name: str, last: Callable[[], None], wake: socket.socket | None):
        self._act, self._last, self._wake = act, last, wake
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._ending.is_set() and (delay := self._act()) is not None:
            if self._wake is None:
                self._ending.wait(delay)
            else:
                select.select([self._wake], [], [], min(max(delay, 0.0), _LONGEST_DEAFNESS))
        self._last()

    def stop(self, patience: float | None = None) -> bool:
        self._ending.set()
        self._thread.join(patience)
        return not self._thread.is_alive()


class SteppedClock:
    """A clock for one thread, on which time passes only while that thread waits.

    `pass_time` lets a world go on until a time, s, and moves the clock with `reach`; without one there is only time.
    """

    def __init__(self, begin: float = BEGIN, pass_time: Callable[[float], None] | None = None):
        self._now = begin
        self._pass_time = pass_time or self.reach
        self._events: list[tuple[float, Callable[[], None]]] = []
        self._stalled = 0.0

    def now(self) -> float:
        return self._now

    def reach(self, time: float) -> None:
        """Move on to `time`, s; a time that has passed changes nothing."""
        if time > self._now:
            self._now = time

    def sleep(self, duration: float, /) -> None:
        """Let `duration`, s, pass, and more of it if the computer stands still."""
        self._run_until(self._now + max(duration, 0.0))
        while self._stalled:
            stalled, self._stalled = self._stalled, 0.0
            self._run_until(self._now + stalled)

    def stall(self, duration: float) -> None:
        """Let the computer stand still for `duration`, s, from the next sleep on."""
        self._stalled += duration

    def wait(self, event: threading.Event, patience: float) -> bool:
        end = self._now + patience
        while not event.is_set() and self._now < end:
            self.sleep(min([end, self._now + _STEP, *(time for time, _ in self._events[:1])]) - self._now)
        return event.is_set()

    def readable(self, sources: Sequence[AnySource], patience: float) -> list[AnySource]:
        end = self._now + patience
        while not (found := select.select(sources, [], [], 0)[0]) and self._now < end:
            self.sleep(min(_LOOK_PERIOD, end - self._now))
        return found

    def at(self, time: float, act: Callable[[], None]) -> None:
        """Call `act` at a time, s; what it raises comes out of the wait in which that time comes."""
        self._events.append((time, act))
        self._events.sort(key=lambda event: event[0])

    def repeat(
        self,
        act: Act,
        *,
        name: str,
        last: Callable[[], None] = lambda: None,
        wake: socket.socket | None = None,
    ) -> Repeated:
        return _OnSteps(self, act, last, wake)

    def _run_until(self, end: float) -> None:
        while self._events and self._events[0][0] <= end:
            time, act = self._events.pop(0)
            self._pass_time(time)
            act()
        self._pass_time(end)


class _OnSteps:
    """Repeats an act at its times on a stepped clock."""

    def __init__(self, clock: SteppedClock, act: Act, last: Callable[[], None], wake: socket.socket | None):
        self._clock, self._act, self._last, self._wake = clock, act, last, wake
        self._due, self._ended = clock.now(), False
        self._look()

    def _look(self) -> None:
        if self._ended:
            return
        now = self._clock.now()
        if now >= self._due or (self._wake is not None and select.select([self._wake], [], [], 0)[0]):
            delay = self._act()
            if delay is None:
                self.stop()
                return
            self._due = now + max(delay, _SHORTEST_DELAY)
        self._clock.at(self._due if self._wake is None else min(self._due, now + _LOOK_PERIOD), self._look)

    def stop(self, patience: float | None = None) -> bool:
        if not self._ended:
            self._ended = True
            self._last()
        return True
