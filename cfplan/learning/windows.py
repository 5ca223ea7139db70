"""Windows: a path of any length as overlapping windows of as many intervals each, all answered at once.

Near its ends a window does not see what its answers depend on: there they count less, and where windows overlap the
answers pass over from the one to the other.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

WINDOW = 64  # intervals of a window
OVERLAP_SHARE = 0.375  # of a window, that the next one has too, at least
UNSEEN_SHARE = 0.25  # of that overlap, next to a window's end, where its answers do not count
_LEAST = 1e-6  # weight, so that some window counts everywhere


def window_starts(nodes: int, window: int) -> NDArray:
    """Return the first nodes of the windows, (B,), over `nodes` intervals, which are at least `window`."""
    most = window - round(OVERLAP_SHARE * window)
    count = 1 + -(-(nodes - window) // most)
    return np.round(np.linspace(0, nodes - window, count)).astype(np.int64)


def shares(starts: NDArray, window: int) -> NDArray:
    """Return (B, W+1): how much each window's answers count at its nodes; at every node they add up to 1."""
    overlap = OVERLAP_SHARE * window
    rise = (np.arange(window + 1) / overlap - UNSEEN_SHARE) / (1.0 - 2.0 * UNSEEN_SHARE)
    rise = np.clip(rise, _LEAST, 1.0)
    out = np.ones((len(starts), window + 1))
    out[1:] *= rise
    out[:-1] *= rise[::-1]
    total = overlapped(starts, out)
    return out / total[starts[:, None] + np.arange(window + 1)]


@lru_cache(maxsize=16)
def windows_over(nodes: int, window: int) -> tuple[NDArray, NDArray]:
    """Return window_starts() of so many intervals, (B,), and the windows' shares(), (B, W+1)."""
    starts = window_starts(nodes, window)
    counts = shares(starts, window)
    for array in (starts, counts):
        array.setflags(write=False)
    return starts, counts


def overlapped(starts: NDArray, values: NDArray) -> NDArray:
    """Return (N+1,): the sum of the windows' values, (B, W+1), at every node."""
    window = values.shape[1] - 1
    places = starts[:, None] + np.arange(window + 1)
    return np.bincount(places.ravel(), weights=values.ravel(), minlength=int(starts[-1]) + window + 1)
