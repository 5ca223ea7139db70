"""Windows: cover a path of any length with overlapping windows of equal size, all answered at once.

Near its ends a window does not see all that its answers depend on: they have less weight there, and where windows
overlap the answers blend from one to the next.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

WINDOW = 64  # intervals of a window
OVERLAP_FRACTION = 0.375  # of a window, that the next one covers too, at least
UNSEEN_FRACTION = 0.25  # of that overlap, next to a window's end, where its answers have no weight
_MIN_WEIGHT = 1e-6  # so that every node has an answer


def window_starts(nodes: int, window: int) -> NDArray:
    """Return the first nodes of the windows, (B,), over `nodes` intervals, which are at least `window`."""
    most = window - round(OVERLAP_FRACTION * window)
    count = 1 + -(-(nodes - window) // most)
    return np.round(np.linspace(0, nodes - window, count)).astype(np.int64)


def window_weights(starts: NDArray, window: int) -> NDArray:
    """Return the weight of each window's answers at its nodes, (B, W+1); at every node they add up to 1."""
    overlap = OVERLAP_FRACTION * window
    rise = (np.arange(window + 1) / overlap - UNSEEN_FRACTION) / (1.0 - 2.0 * UNSEEN_FRACTION)
    rise = np.clip(rise, _MIN_WEIGHT, 1.0)
    out = np.ones((len(starts), window + 1))
    out[1:] *= rise
    out[:-1] *= rise[::-1]
    total = overlapped(starts, out)
    return out / total[starts[:, None] + np.arange(window + 1)]


@lru_cache(maxsize=16)
def windows_over(nodes: int, window: int) -> tuple[NDArray, NDArray]:
    """Return window_starts() over `nodes` intervals, (B,), and the window_weights(), (B, W+1)."""
    starts = window_starts(nodes, window)
    weights = window_weights(starts, window)
    for array in (starts, weights):
        array.setflags(write=False)
    return starts, weights


def overlapped(starts: NDArray, values: NDArray) -> NDArray:
    """Return (N+1,): the sum of the windows' values, (B, W+1), at every node."""
    window = values.shape[1] - 1
    places = starts[:, None] + np.arange(window + 1)
    return np.bincount(places.ravel(), weights=values.ravel(), minlength=int(starts[-1]) + window + 1)
