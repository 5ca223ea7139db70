"""Yaw of baselines that do not plan it."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from cfplan.geometry.path import Path
from cfplan.geometry.yaw import YawMode

LEVEL = 0.05
# |γ'| over the ground, 1 at nominal speed: below this the direction of flight is not followed


def yaw_along(path: Path, mode: YawMode, angle: float) -> Callable[[NDArray], NDArray]:
    """ψ(s), continuous: `angle` all along, or the horizontal direction of flight, held where there is hardly any."""
    if mode is not YawMode.TANGENT:
        return lambda s: np.full(np.shape(s), angle)
    grid = np.linspace(0.0, path.end, max(200, int(50 * path.end)))
    first = path(grid, 1)
    moving = np.hypot(first[:, 0], first[:, 1]) > LEVEL
    if not moving.any():
        return lambda s: np.full(np.shape(s), angle)
    yaw = np.unwrap(np.arctan2(first[moving, 1], first[moving, 0]))
    return lambda s: np.interp(s, grid[moving], yaw)
