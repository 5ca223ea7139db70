"""How far ahead of the clock to plan, by how long plans took lately."""

from collections import deque

import numpy as np

from cfplan.preparation.air_planner import SLACK

LEARNED_FROM = 15  # plans, by which one knows how long the next may take
IN_TIME = 0.6  # share of them for which what is taken to be needed was enough: one that comes late is planned again


class Lead:
    """How far ahead to plan: most plans, not all, are to be in time."""

    def __init__(self, first: float):
        """Begin with what a plan is taken to need before any was made, s."""
        self._took: deque[tuple[float, float]] = deque([(first, 0.0)], maxlen=LEARNED_FROM)
        self._checks: deque[float] = deque([0.0], maxlen=LEARNED_FROM)

    def note(self, seconds: float, left_out: float = 0.0, *, only: bool = False) -> None:
        """Learn how long a plan took, s; with `only`, forget what was known before.

        `left_out`, s, is by how much later it began than where it was planned from.
        """
        if only:
            self._took.clear()
        self._took.append((seconds, left_out))

    def note_checks(self, seconds: float) -> None:
        """Learn how long it took from a plan to its proposal, s."""
        self._checks.append(seconds)

    @property
    def checking(self) -> float:
        """Return how long it takes from a plan to its proposal, s."""
        return float(np.median(self._checks))

    def ahead(self, in_time: float = IN_TIME) -> float:
        """Return what the next plan is taken to need, s, with its way to the pilot: so much that this share has it."""
        return float(np.quantile([took - left_out for took, left_out in self._took], in_time)) + SLACK
