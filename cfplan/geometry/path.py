"""The path γ(s): where to fly, with no timing."""

import math
from dataclasses import dataclass, field

import numpy as np
from numba.extending import register_jitable
from numpy.typing import ArrayLike, NDArray

from cfplan.errors import InputError
from cfplan.geometry.polynomials import padded, shifted
from cfplan.machine_code import njit
from cfplan.numbers import coordinates

MAX_ORDER = 5
STANDSTILL = 0.01  # |γ'|, which is 1 at the nominal 1 m/s: where an inner minimum falls below this, the path stops
_SAMPLES = 32  # per piece, where a path is searched for stops
_BATCH = 256  # points evaluated together: they and their derivatives fit into the processor's cache
_GAUSS_NODES, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(24)


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """A curve γ(s) for s in [0, end], piecewise polynomial; at least C⁴ if this package made it.

    s is nominal time, s, at about 1 m/s. At a rest end γ' = γ'' = γ''' = 0 exactly. For that the last piece is expanded
    about its right end and every other about its left end, so a path with two rest ends needs two pieces. Outside
    [0, end] the path stays at its ends.
    """

    breaks: NDArray  # (M+1,) ascending from 0
    coefficients: NDArray  # (M, D, 3) m, ascending powers of s - breaks[i]; of s - breaks[-1] in the last piece
    origins: NDArray = field(init=False, repr=False)  # (M,) the s about which each piece is expanded
    _tables: list[NDArray | None] = field(init=False, repr=False)  # see _table(); None where nobody has asked yet
    _length: float = field(init=False, repr=False, default=math.nan)  # m, once it was asked for

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
                hint="its points are too many, too close or too far apart to be numbers; give others",
            )
        if breaks[0] != 0.0 or (np.diff(breaks) <= 0.0).any():
            raise InputError("breaks of a path must ascend from 0", where="path", hint="give each piece a length")
        origins = breaks[:-1].copy()
        origins[-1] = breaks[-1]
        with np.errstate(over="ignore"):
            steepest = np.abs(table).max() * float(table.shape[1]) ** MAX_ORDER
        if not np.isfinite(steepest):
            raise InputError(
                "coefficients of a path are too large to have derivatives", where="path", hint="give them in metres"
            )
        for array in (breaks, origins, table):
            array.setflags(write=False)
        tables = [table, *[None] * MAX_ORDER]
        for name, value in (("breaks", breaks), ("coefficients", table), ("origins", origins), ("_tables", tables)):
            object.__setattr__(self, name, value)

    def _table(self, order: int) -> NDArray:
        """Return (M, D - order, 3), the coefficients of a derivative."""
        if (table := self._tables[order]) is None:
            before = self._table(order - 1)
            powers = np.arange(1, before.shape[1])
            table = before[:, 1:] * powers[:, None] if len(powers) else np.zeros((len(before), 1, 3))
            table.setflags(write=False)
            self._tables[order] = table
        return table

    @property
    def end(self) -> float:
        """Return the last s."""
        return float(self.breaks[-1])

    def __repr__(self) -> str:
        return f"<Path of {self.length:.1f} m in {len(self.coefficients)} pieces>"

    @property
    def length(self) -> float:
        """Return the arc length, m, measured when it is first asked for."""
        if math.isnan(self._length):
            object.__setattr__(self, "_length", float(self.piece_lengths().sum()))
        return self._length

    def piece_lengths(self) -> NDArray:
        """Return the arc length of each piece, (M,) m, by Gauss-Legendre quadrature of |γ'|."""
        half = np.diff(self.breaks) / 2
        nodes = (self.breaks[:-1] + half)[:, None] + half[:, None] * _GAUSS_NODES
        return half * (np.linalg.norm(self(nodes, 1), axis=-1) @ _GAUSS_WEIGHTS)

    def __call__(self, s: ArrayLike, order: int = 0) -> NDArray:
        """Return the derivative of order 0 to 5 with respect to s, of shape s.shape + (3,)."""
        if not 0 <= order <= MAX_ORDER:
            raise ValueError(f"a path has derivatives of order 0 to {MAX_ORDER}, not {order}")
        s = np.array(s, dtype=float)
        return _values(self.breaks, self.origins, self._table(order), s.ravel()).reshape(*s.shape, 3)

    def derivatives(self, s: NDArray) -> NDArray:
        """Return γ and its first four derivatives at s, (N,), in one pass, (5, 3, N)."""
        out = np.empty((5, 3, len(s)))
        _trace(self.breaks, self.origins, self.coefficients, np.asarray(s, dtype=float), out)
        return out

    def part(self, low: float, high: float) -> "Path":
        """Return the path from s = low to s = high, in two pieces or more so that rest ends stay exact."""
        high = min(high, float(self.breaks[-1]))  # it may exceed the end by a rounding error
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
        before[-1] = shifted(before[-1:], self.breaks[-2:-1] - self.breaks[-1])[0]  # the last piece no more
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

        # |γ'| falls to 0 at a rest end as well; a stop inside the path lies between two faster places
        dips = 1 + np.flatnonzero((speed[1:-1] <= speed[:-2]) & (speed[1:-1] <= speed[2:]))
        slowest = self._slowest(s[dips - 1], s[dips + 1])
        stops = slowest[np.linalg.norm(self(slowest, 1), axis=-1) < STANDSTILL]
        if len(stops):
            self._refuse("the path stops between its ends (a cusp or a reversal)", float(stops[0]), where)

    def _slowest(self, low: NDArray, high: NDArray) -> NDArray:
        """Return the s of the least |γ'| in each interval [low, high], by golden-section search."""
        return _slowest_within(self.breaks, self.origins, self._table(1), low, high)

    def _refuse(self, what: str, s: float, where: str) -> None:
        raise InputError(
            f"{what} at s = {s:.3f} of {self.end:.3f}, position {coordinates(self(s), '.3f')} m",
            where=where,
            hint="move a waypoint sideways so that the path turns in a curve, or split the flight in two",
        )


Derivatives = tuple[float, float, float, float, float]  # γ to γ'''' of one axis, over the factorials of their orders


@register_jitable(forceinline=True, fastmath={"contract"})
def horner_step(x: float, coefficient: float, p: Derivatives) -> Derivatives:
    """Take one step of Horner's scheme, for a polynomial and its first four derivatives over their factorials."""
    return x * p[0] + coefficient, x * p[1] + p[0], x * p[2] + p[1], x * p[3] + p[2], x * p[4] + p[3]


def _located(breaks: NDArray, origins: NDArray, s: NDArray) -> tuple[NDArray, NDArray]:
    """Return the piece that holds each s, (N,), and how far from its origin s lies."""
    s = np.clip(s, 0.0, breaks[-1])
    piece = np.clip(np.searchsorted(breaks, s, side="right") - 1, 0, len(origins) - 1)
    return piece, s - origins[piece]


_GOLDEN = (math.sqrt(5) - 1) / 2
_GOLDEN_STEPS = 45


@njit
def _slowest_within(breaks: NDArray, origins: NDArray, table: NDArray, low: NDArray, high: NDArray) -> NDArray:
    """Return the s, (N,), of the least |γ'| between `low` and `high`; `table`, (M, D, 3), is that of γ'."""
    out = np.empty(len(low))
    for n in range(len(low)):
        a, b = low[n], high[n]
        for _ in range(_GOLDEN_STEPS):
            left, right = b - _GOLDEN * (b - a), a + _GOLDEN * (b - a)
            if _squared_speed(breaks, origins, table, left) < _squared_speed(breaks, origins, table, right):
                b = right
            else:
                a = left
        out[n] = (a + b) / 2
    return out


@register_jitable
def _squared_speed(breaks: NDArray, origins: NDArray, table: NDArray, s: float) -> float:
    """Return |γ'|² at s."""
    s = min(max(s, 0.0), breaks[-1])
    piece = _piece_at(breaks, s)
    x, total = s - origins[piece], 0.0
    for axis in range(3):
        value = 0.0
        for k in range(table.shape[1] - 1, -1, -1):
            value = value * x + table[piece, k, axis]
        total += value * value
    return total


@njit(fastmath={"contract"})
def _trace(breaks: NDArray, origins: NDArray, coefficients: NDArray, s: NDArray, out: NDArray) -> None:
    """Write γ and four derivatives at s into `out`, consecutive points of one piece together, up to _BATCH of them."""
    place, x = np.empty(len(s)), np.empty(_BATCH)
    for n in range(len(s)):
        place[n] = min(max(s[n], 0.0), breaks[-1])
    begin, piece, last = 0, 0, len(origins) - 1
    while begin < len(place):
        if place[begin] < breaks[piece]:
            piece = 0
        while piece < last and place[begin] >= breaks[piece + 1]:
            piece += 1
        end, room = begin + 1, min(begin + _BATCH, len(place))
        while end < room and breaks[piece] <= place[end] and (piece == last or place[end] < breaks[piece + 1]):
            end += 1
        for n in range(end - begin):
            x[n] = place[begin + n] - origins[piece]
        for axis in range(3):
            p, d1, d2 = out[0, axis, begin:end], out[1, axis, begin:end], out[2, axis, begin:end]
            d3, d4 = out[3, axis, begin:end], out[4, axis, begin:end]
            for n in range(end - begin):
                p[n], d1[n], d2[n], d3[n], d4[n] = 0.0, 0.0, 0.0, 0.0, 0.0
            for power in range(coefficients.shape[1] - 1, -1, -1):
                term = coefficients[piece, power, axis]
                for n in range(end - begin):
                    p[n], d1[n], d2[n], d3[n], d4[n] = horner_step(x[n], term, (p[n], d1[n], d2[n], d3[n], d4[n]))
            for n in range(end - begin):
                d2[n], d3[n], d4[n] = 2.0 * d2[n], 6.0 * d3[n], 24.0 * d4[n]
        begin = end


@register_jitable
def _piece_at(breaks: NDArray, s: float) -> int:
    """Return the piece that holds s by bisection; a break belongs to the piece on its right."""
    piece, above = 0, len(breaks) - 1
    while above - piece > 1:
        middle = (piece + above) // 2
        if breaks[middle] <= s:
            piece = middle
        else:
            above = middle
    return piece


@njit
def _values(breaks: NDArray, origins: NDArray, table: NDArray, places: NDArray) -> NDArray:
    """Return piecewise polynomials at each s, (N,), as (N, 3)."""
    out = np.empty((len(places), 3))
    last = len(origins) - 1
    piece = 0
    for n in range(len(places)):
        s = places[n]
        s = 0.0 if s < 0.0 else breaks[-1] if s > breaks[-1] else s
        if not (breaks[piece] <= s and (s < breaks[piece + 1] or piece == last)):
            # Points mostly come in order: the next piece is tried first.
            after = piece + 1
            if after <= last and breaks[after] <= s and (after == last or s < breaks[after + 1]):
                piece = after
            else:
                piece = _piece_at(breaks, s)
        terms, x = table[piece], s - origins[piece]
        a, b, c = terms[-1, 0], terms[-1, 1], terms[-1, 2]
        for power in range(len(terms) - 2, -1, -1):
            a, b, c = terms[power, 0] + x * a, terms[power, 1] + x * b, terms[power, 2] + x * c
        out[n, 0], out[n, 1], out[n, 2] = a, b, c
    return out


def rotation_about_z(yaw: float) -> NDArray:
    """Return the (3, 3) rotation by `yaw`, rad, about z."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
