"""The path γ(s): where to fly, with no timing."""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cfplan.errors import InputError
from cfplan.geometry.polynomials import ORDERS, derivatives_on, intervals_of, padded, shifted
from cfplan.machine_code import njit
from cfplan.numbers import coordinates

STANDSTILL = 0.01  # |γ'|, which is 1 at the nominal 1 m/s: an inner minimum below this is a stop
_SAMPLES = 32  # per piece, for finding stops
_ZOOMS = 6  # each to an interval a fifteenth as long
_GAUSS_NODES, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(24)


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """A curve γ(s) for s in [0, end], piecewise polynomial; at least C⁴ if this package made it.

    s is nominal time, s, at about 1 m/s. At a rest end γ' = γ'' = γ''' = 0 exactly. For this the last piece is expanded
    about its right end and every other about its left end, so a path with two rest ends needs two pieces. Outside
    [0, end] the path is constant.
    """

    breaks: NDArray  # (M+1,) ascending from 0
    coefficients: NDArray  # (M, D, 3) m, ascending powers of s - breaks[i]; of s - breaks[-1] in the last piece
    origins: NDArray = field(init=False, repr=False)  # (M,) the s about which each piece is expanded
    _length: float = field(init=False, repr=False, default=math.nan)  # m, cached

    def __post_init__(self) -> None:
        breaks = np.array(self.breaks, dtype=float)
        table = np.array(self.coefficients, dtype=float, order="C")
        if breaks.ndim != 1 or table.ndim != 3 or table.shape[::2] != (len(breaks) - 1, 3) or not table.shape[1]:
            raise InputError(
                f"breaks {breaks.shape} and coefficients {table.shape} do not make a path",
                where="path",
                hint="M pieces have M + 1 breaks and coefficients of shape (M, D, 3)",
            )
        if not (np.isfinite(breaks).all() and np.isfinite(table).all()):
            raise InputError(
                "breaks or coefficients of a path are not finite numbers",
                where="path",
                hint="there are too many points, or they are too close or too far apart",
            )
        if breaks[0] != 0.0 or (np.diff(breaks) <= 0.0).any():
            raise InputError("breaks of a path must ascend from 0", where="path", hint="give each piece a length")
        origins = breaks[:-1].copy()
        origins[-1] = breaks[-1]
        with np.errstate(over="ignore"):
            steepest = np.abs(table).max() * float(table.shape[1]) ** ORDERS
        if not np.isfinite(steepest):
            raise InputError(
                "coefficients of a path are too large to have derivatives", where="path", hint="give them in metres"
            )
        for array in (breaks, origins, table):
            array.setflags(write=False)
        for name, value in (("breaks", breaks), ("coefficients", table), ("origins", origins)):
            object.__setattr__(self, name, value)

    @property
    def end(self) -> float:
        """Return the last s."""
        return float(self.breaks[-1])

    def __repr__(self) -> str:
        return f"<Path of {self.length:.1f} m in {len(self.coefficients)} pieces>"

    @property
    def length(self) -> float:
        """Return the arc length, m, computed once."""
        if math.isnan(self._length):
            object.__setattr__(self, "_length", float(self.piece_lengths().sum()))
        return self._length

    def piece_lengths(self) -> NDArray:
        """Return the arc length of each piece, (M,) m, by Gauss-Legendre quadrature of |γ'|."""
        half = np.diff(self.breaks) / 2
        nodes = (self.breaks[:-1] + half)[:, None] + half[:, None] * _GAUSS_NODES
        return half * (np.linalg.norm(self(nodes, 1), axis=-1) @ _GAUSS_WEIGHTS)

    def __call__(self, s: ArrayLike, order: int = 0) -> NDArray:
        """Return the derivative of order 0 to 4 with respect to s, of shape s.shape + (3,)."""
        if not 0 <= order < ORDERS:
            raise ValueError(f"a path has derivatives of order 0 to {ORDERS - 1}, not {order}")
        s = np.array(s, dtype=float)
        return np.ascontiguousarray(self.derivatives(s.ravel())[order].T).reshape(*s.shape, 3)

    def derivatives(self, s: NDArray) -> NDArray:
        """Return γ and its first four derivatives at s, (N,), as (5, 3, N)."""
        return curve_at(self.breaks, self.coefficients, np.asarray(s, dtype=float))

    def part(self, low: float, high: float) -> "Path":
        """Return the path from s = low to s = high, in two pieces or more so that rest ends stay exact."""
        high = min(high, float(self.breaks[-1]))  # it may exceed the end by rounding
        first = int(np.searchsorted(self.breaks, low, side="right")) - 1
        last = int(np.searchsorted(self.breaks, high, side="left"))
        piece = np.arange(first, last)
        inner = self.breaks[first + 1 : last]
        if not len(inner):
            piece, inner = np.repeat(piece, 2), np.array([(low + high) / 2])
        breaks = np.concatenate([[low], inner, [high]])
        origins = np.append(breaks[:-2], high)
        return Path(breaks - low, shifted(self.coefficients[piece], origins - self.origins[piece]))

    def followed_by(self, other: "Path") -> "Path":
        """Return this path and then another, in the same unit of s, that begins with the derivatives of its end."""
        count = max(self.coefficients.shape[1], other.coefficients.shape[1])
        before, after = padded(self.coefficients, count), padded(other.coefficients, count)
        before[-1] = shifted(before[-1:], self.breaks[-2:-1] - self.breaks[-1])[0]  # no longer the last piece
        return Path(np.append(self.breaks, self.end + other.breaks[1:]), np.concatenate([before, after]))

    def placed(self, offset: ArrayLike, yaw: float = 0.0) -> "Path":
        """Return this path turned by `yaw`, rad, about the world's z axis, then moved by `offset`, (3,) m."""
        table = self.coefficients @ rotation_about_z(yaw).T
        table[:, 0] += np.asarray(offset, dtype=float)
        return Path(self.breaks, table)

    def check(self, where: str = "") -> None:
        """Refuse a path that stops between its ends: a cusp, a reversal, a piece without length.

        Raises:
            InputError: it stops; the message names s and the position.
        """
        s = (self.breaks[:-1, None] + np.diff(self.breaks)[:, None] * np.arange(_SAMPLES) / _SAMPLES).ravel()
        s = np.append(s, self.end)
        speed = np.linalg.norm(self(s, 1), axis=-1)

        still = speed[:-1].reshape(-1, _SAMPLES).max(axis=1) < 1e-6
        if still.any():
            self._refuse("a piece has no length", float(self.breaks[int(np.argmax(still))]), where)

        # |γ'| falls to 0 at rest ends too; an inner stop lies between two faster places
        dips = 1 + np.flatnonzero((speed[1:-1] <= speed[:-2]) & (speed[1:-1] <= speed[2:]))
        slowest = self._slowest(s[dips - 1], s[dips + 1])
        stops = slowest[np.linalg.norm(self(slowest, 1), axis=-1) < STANDSTILL]
        if len(stops):
            self._refuse("the path stops between its ends (a cusp or a reversal)", float(stops[0]), where)

    def _slowest(self, low: NDArray, high: NDArray) -> NDArray:
        """Return the s of the least |γ'| in each interval [low, high]."""
        every = np.arange(len(low))
        for _ in range(_ZOOMS):
            s = np.linspace(low, high, _SAMPLES)
            least = np.argmin(np.linalg.norm(self(s, 1), axis=-1), axis=0)
            low, high = s[np.maximum(least - 1, 0), every], s[np.minimum(least + 1, _SAMPLES - 1), every]
        return np.asarray((low + high) / 2)

    def _refuse(self, what: str, s: float, where: str) -> None:
        raise InputError(
            f"{what} at s = {s:.3f} of {self.end:.3f}, position {coordinates(self(s), '.3f')} m",
            where=where,
            hint="move a waypoint sideways so that the path turns in a curve, or split the flight in two",
        )


@njit
def curve_at(breaks: NDArray, coefficients: NDArray, s: NDArray) -> NDArray:
    """Return γ and its first four derivatives, (5, 3, N), at s, (N,), of a path with these breaks and coefficients."""
    s, origins = np.minimum(np.maximum(s, 0.0), breaks[-1]), breaks[:-1].copy()
    origins[-1] = breaks[-1]
    return derivatives_on(origins, coefficients, s, intervals_of(breaks, s))


def rotation_about_z(yaw: float) -> NDArray:
    """Return the (3, 3) rotation by `yaw`, rad, about z."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
