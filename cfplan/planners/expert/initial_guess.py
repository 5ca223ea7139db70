"""Where the search for a speed profile starts: slow enough everywhere, and smooth."""

import numpy as np
from numpy.typing import NDArray

from cfplan.geometry.path import Path
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.airframe import GRAVITY, Airframe

SHARE = 0.7
# of each limit that the guess uses
WIDTH = 2.0
# intervals over which it is smoothed


def guess_spline(path: Path, airframe: Airframe, limits: PlanLimits, nodes: int, ceiling: float) -> NDArray:
    """(N+3,) coefficients of a cubic B-spline on the grid: h where it is taken to change slowly.

    With h' = 0 each limit alone gives a bound on h: |v|² = h|γ'|², |a| = h|γ''|, and with the thrust axis about
    vertical |ω| = h^1.5 |γ'''|/g and |α| = h²|γ''''|/g.
    """
    s = np.clip(np.arange(-1, nodes + 2) * (path.end / nodes), 0.0, path.end)
    first, second, third, fourth = np.maximum(np.linalg.norm(path.derivatives(s)[1:], axis=1), 1e-9)
    up = limits.motor_thrust_max - airframe.hover_thrust
    down = airframe.hover_thrust - limits.motor_thrust_min
    acceleration = min(limits.acceleration, GRAVITY * np.tan(min(limits.tilt, 1.0)), 4 * up / airframe.mass)
    turning = 2 * min(up, down) * airframe.arm / max(airframe.inertia[:2])
    h = np.minimum.reduce([
        np.full(len(s), 0.3 * ceiling),
        SHARE * limits.speed**2 / first**2,
        SHARE * acceleration / second,
        (0.7 * SHARE * limits.angular_velocity * GRAVITY / third) ** (2 / 3),
        (0.7 * SHARE * turning * GRAVITY / fourth) ** 0.5,
    ])  # fmt: skip
    from scipy.ndimage import gaussian_filter1d, minimum_filter1d  # slow to import

    logarithm = minimum_filter1d(np.log(h), int(2 * WIDTH) + 1, mode="nearest")
    return np.exp(gaussian_filter1d(logarithm, WIDTH, mode="nearest"))
