"""The speed profile of a path, h(s) = (ds/dt)² with yaw ψ(s), and the boundary state where two segments meet."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.geometry.polynomials import intervals_of
from cfplan.machine_code import njit
from cfplan.vehicle.rotations import Scalar

# Compiled into the loop that calls it; without fast arithmetic, so that all callers get the same to the last bit.
_within_the_loop = register_jitable(forceinline=True, fastmath=False)


@dataclass(frozen=True, slots=True)
class BoundaryState:
    """The profile where one segment hands over to the next."""

    h: float
    dh: float
    ddh: float
    yaw: float  # rad
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
    """A profile on a grid uniform in s: h is a cubic and yaw a parabola in each interval, so C² and C¹ over the whole.

    The jumps of h''' and ψ'' at the grid points are jumps of angular acceleration: check both sides.
    """

    s: NDArray  # (N+1,) from 0 to the path's end
    h: NDArray  # (N+1,) positive
    dh: NDArray  # (N+1,)
    ddh: NDArray  # (N+1,)
    dddh: NDArray  # (N,) constant in each interval
    yaw: NDArray  # (N+1,) rad, not wrapped
    dyaw: NDArray  # (N+1,)
    ddyaw: NDArray  # (N,) constant in each interval

    def interval(self, s: NDArray) -> NDArray:
        """Return the index of the interval in which s lies; a grid point belongs to the interval on its right."""
        s = np.asarray(s, dtype=float)
        return intervals_of(self.s, s.ravel()).reshape(s.shape)

    def at(self, s: NDArray, interval: NDArray | None = None) -> ProfileSample:
        """Return the profile at s, by the polynomials of `interval` where given (for the left of a grid point)."""
        s = np.asarray(s, dtype=float)
        i = self.interval(s) if interval is None else interval
        x = s - self.s[i]
        return ProfileSample(
            *h_within(x, self.h[i], self.dh[i], self.ddh[i], self.dddh[i]),
            *yaw_within(x, self.yaw[i], self.dyaw[i], self.ddyaw[i]),
        )

    def table(self) -> NDArray:
        """Return (N+1, 8) for compiled code: s, h with three derivatives, yaw with two; N values are followed by 0."""
        return _table(self.s, self.h, self.dh, self.ddh, self.dddh, self.yaw, self.dyaw, self.ddyaw)

    def boundary(self, node: int) -> BoundaryState:
        """Return the state at a grid point."""
        return BoundaryState(*(float(values[node]) for values in (self.h, self.dh, self.ddh, self.yaw, self.dyaw)))

    def slowed(self, speed_factor: float) -> "SpeedProfile":
        """Return the same flight at speed_factor times its speed: h by its square, yaw unchanged along the path."""
        factor = speed_factor * speed_factor
        return SpeedProfile(
            self.s, self.h * factor, self.dh * factor, self.ddh * factor, self.dddh * factor,
            self.yaw, self.dyaw, self.ddyaw,
        )  # fmt: skip


@_within_the_loop
def h_within(x: Scalar, h: Scalar, dh: Scalar, ddh: Scalar, dddh: Scalar) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """Return h with three derivatives at x from the grid point where it has the values given."""
    return h + x * (dh + x * (ddh / 2 + x * dddh / 6)), dh + x * (ddh + x * dddh / 2), ddh + x * dddh, dddh


@_within_the_loop
def yaw_within(x: Scalar, yaw: Scalar, dyaw: Scalar, ddyaw: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """Return yaw with two derivatives at x from the grid point where it has the values given."""
    return yaw + x * (dyaw + x * ddyaw / 2), dyaw + x * ddyaw, ddyaw


@njit
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
