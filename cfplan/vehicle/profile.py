"""How fast a path is flown, and which way the vehicle points: h(s) = (ds/dt)² and yaw ψ(s)."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class BoundaryState:
    """Where one segment hands over to the next."""

    h: float
    dh: float
    ddh: float
    yaw: float
    dyaw: float


class ProfileSample(NamedTuple):
    """h with three derivatives and yaw with two, by s; arrays of one shape."""

    h: NDArray
    dh: NDArray
    ddh: NDArray
    dddh: NDArray
    yaw: NDArray
    dyaw: NDArray
    ddyaw: NDArray


@dataclass(frozen=True, slots=True)
class SpeedProfile:
    """On a grid uniform in s: h a cubic and yaw a parabola in each interval, so C² and C¹ over the whole.

    The jumps of h''' and ψ'' at the grid points are jumps of angular acceleration: check both sides.
    """

    s: NDArray
    # (N+1,) from 0 to the path's end
    h: NDArray
    # (N+1,) 1, positive
    dh: NDArray
    # (N+1,)
    ddh: NDArray
    # (N+1,)
    dddh: NDArray
    # (N,) constant in each interval
    yaw: NDArray
    # (N+1,) rad, not wrapped
    dyaw: NDArray
    # (N+1,)
    ddyaw: NDArray
    # (N,) constant in each interval

    def interval(self, s: NDArray) -> NDArray:
        """Index of the interval in which s lies; a grid point belongs to the interval on its right."""
        return np.clip(np.searchsorted(self.s, s, side="right") - 1, 0, len(self.s) - 2)

    def at(self, s: NDArray, interval: NDArray | None = None) -> ProfileSample:
        """The profile at s, by the polynomials of `interval` where given (for the left side of a grid point)."""
        s = np.asarray(s, dtype=float)
        i = self.interval(s) if interval is None else interval
        x = s - self.s[i]
        jerk, turn = self.dddh[i], self.ddyaw[i]
        return ProfileSample(
            h=self.h[i] + x * (self.dh[i] + x * (self.ddh[i] / 2 + x * jerk / 6)),
            dh=self.dh[i] + x * (self.ddh[i] + x * jerk / 2),
            ddh=self.ddh[i] + x * jerk,
            dddh=jerk,
            yaw=self.yaw[i] + x * (self.dyaw[i] + x * turn / 2),
            dyaw=self.dyaw[i] + x * turn,
            ddyaw=turn,
        )

    def table(self) -> NDArray:
        """(N+1, 8), for compiled code: s, h with three derivatives, yaw with two; what has N values ends in 0."""
        return _table(self.s, self.h, self.dh, self.ddh, self.dddh, self.yaw, self.dyaw, self.ddyaw)

    def boundary(self, node: int) -> BoundaryState:
        """The state at a grid point."""
        return BoundaryState(*(float(values[node]) for values in (self.h, self.dh, self.ddh, self.yaw, self.dyaw)))

    def slowed(self, share: float) -> "SpeedProfile":
        """The same flight at `share` of its speed: h scaled by share², yaw unchanged along the path."""
        factor = share * share
        return SpeedProfile(
            self.s, self.h * factor, self.dh * factor, self.ddh * factor, self.dddh * factor,
            self.yaw, self.dyaw, self.ddyaw,
        )  # fmt: skip


@njit(cache=True)
def _table(
    s: NDArray, h: NDArray, dh: NDArray, ddh: NDArray, dddh: NDArray, yaw: NDArray, dyaw: NDArray, ddyaw: NDArray
) -> NDArray:
    rows = np.zeros((len(s), 8))
    for n in range(len(s)):
        rows[n, 0], rows[n, 1], rows[n, 2], rows[n, 3] = s[n], h[n], dh[n], ddh[n]
        rows[n, 5], rows[n, 6] = yaw[n], dyaw[n]
    for n in range(len(s) - 1):
        rows[n, 4], rows[n, 7] = dddh[n], ddyaw[n]
    return rows
