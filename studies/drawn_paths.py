"""Random min-snap paths by seed, in named boxes whose lower corner is the origin."""

import numpy as np

from cfplan.errors import InputError
from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.path import Path
from cfplan.geometry.random_paths import random_waypoints
from cfplan.safety.limit_sets import BOXES

WAYPOINTS = (3, 6)  # fewest and most waypoints of a random path
LENGTH_ERROR = 0.05  # relative
_ATTEMPTS = 1000


def random_path(seed: int, box: str, waypoints: tuple[int, int] = WAYPOINTS) -> Path:
    """Return the random path of a seed in one of the named boxes."""
    return min_snap(random_waypoints(seed, np.stack([np.zeros(3), np.array(BOXES[box])]), waypoints))


def path_of_length(length: float, box: str, seed: int) -> Path:
    """Return a random path in the box whose length, m, is within LENGTH_ERROR of `length`. Raises InputError."""
    size = np.array(BOXES[box])
    corners = np.stack([np.zeros(3), size])
    most = 3 + int(np.ceil(length / (0.3 * size.max())))
    for attempt in range(_ATTEMPTS):
        points = random_waypoints(np.random.SeedSequence([seed, attempt]), corners, (most, most))
        # A min-snap path is a little longer than its legs; count legs first, then measure.
        count = 3
        path = min_snap(points[:count])
        while path.length < (1 - LENGTH_ERROR) * length and count < most:
            count = min(count + max(1, int((length - path.length) / size.max())), most)
            path = min_snap(points[:count])
        if abs(path.length - length) <= LENGTH_ERROR * length:
            return path
    raise InputError(
        f"no random path of {length:g} m was found in the box {box}",
        where="length",
        hint="choose a longer path, or a smaller box",
    )
