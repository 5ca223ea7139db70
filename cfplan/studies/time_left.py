"""How long a run has still to go, from how long its steps took until now."""

from collections.abc import Callable
from dataclasses import dataclass, field
from time import monotonic


@dataclass(slots=True)
class TimeLeft:
    """Is told after each step how many are done of how many; a phase of the run begins where the number of all changes.

    What was done at the beginning of a phase, as a run before has left it, does not count.
    """

    clock: Callable[[], float] = monotonic  # s
    _total: int = field(default=-1, init=False)
    _done: int = field(default=0, init=False)
    _first: int = field(default=0, init=False)  # done when the phase began
    _begun: float = field(default=0.0, init=False)
    _last: float = field(default=0.0, init=False)

    def step(self, done: int, total: int) -> None:
        """Count the steps that are done."""
        now = self.clock()
        if total != self._total or done < self._done:
            self._total, self._first, self._begun = total, done, now
        self._done, self._last = done, now

    @property
    def seconds(self) -> float | None:
        """Return the time that the rest of the phase takes at its pace so far; None before its first step."""
        steps = self._done - self._first
        if steps <= 0:
            return None
        a_step = (self._last - self._begun) / steps
        return max(a_step * (self._total - self._done) - (self.clock() - self._last), 0.0)


def duration_text(seconds: float) -> str:
    """Return it as people say it: 12 s, 4 min, 3 h 20 min."""
    if seconds < 100.0:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60.0)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60} min"
