"""Chaining: windows of a fixed number of intervals, joined by boundary states, cover a path of any length.

Each window begins in the state in which the kept part of the one before ends. The expert chains its windows, of
variable length, likewise: see planners/expert/windows.py.
"""

from collections.abc import Iterator
from typing import NamedTuple

WINDOW = 64  # intervals of a window
KEPT_SHARE = 0.75  # of a window, where the path goes on: the rest looks further ahead than braking takes


class Window(NamedTuple):
    """The place of a window on a path's grid, and how much of it is kept."""

    first: int  # node at which it begins
    keep: int  # intervals that are kept; the next window begins there
    last: bool  # whether it ends where the path ends


def kept_intervals(window: int) -> int:
    """Return the intervals of a window that are kept where the path goes on."""
    return max(1, round(KEPT_SHARE * window))


def chain(nodes: int, window: int, keep: int) -> Iterator[Window]:
    """Yield the windows over `nodes` intervals, which are at least `window`.

    Each begins where the kept part of the one before ends. The last one ends where the path ends, so the one before it
    keeps less.
    """
    first = 0
    while first + window < nodes:
        following = min(first + keep, nodes - window)
        yield Window(first, following - first, False)
        first = following
    yield Window(first, window, True)
