"""Windows, the fixed length of path that networks take, and chaining, by which they cover a path of any length."""

from collections.abc import Iterator
from typing import NamedTuple

WINDOW = 64
# intervals of a window
KEPT_SHARE = 0.75
# of a window, where the path goes on: what lies behind is further ahead than braking takes


class Window(NamedTuple):
    """Where a window lies on the grid of a path, and which of its nodes are kept."""

    first: int
    # node at which it begins
    keep: int
    # intervals of it that are kept; the next window begins there
    last: bool
    # ends where the path ends


def kept(window: int) -> int:
    """Intervals of a window that are kept where the path goes on."""
    return max(1, round(KEPT_SHARE * window))


def chain(nodes: int, window: int, keep: int) -> Iterator[Window]:
    """The windows over `nodes` intervals, at least `window`: each begins where the kept part of the one before ends.

    The last one ends where the path ends, so the one before it keeps less.
    """
    first = 0
    while first + window < nodes:
        following = min(first + keep, nodes - window)
        yield Window(first, following - first, False)
        first = following
    yield Window(first, window, True)
