"""Fitting of polynomials: pieces of degree 7 that follow a reference's position, acceleration, jerk and snap.

Adjacent pieces share position, velocity, acceleration and jerk at their joint. These are the unknowns of a banded
least-squares problem; at both ends of the flight they are those of a hover. Knots are moved to where the fit is worst.

Compressed pieces have equal durations, so the shared values are integers: position p, and the differences d₁, d₂, d₃ of
the control points at the joint. With duration T, in steps of 1 mm,

    velocity = 7 d₁ / T      acceleration = 42 d₂ / T²      jerk = 210 d₃ / T³

so joints stay smooth in spite of rounding. The integers come from the nearest-plane method (Babai, "On Lovász' lattice
reduction and the nearest lattice point problem", 1986): they are rounded one by one, from the last to the first, and
each compensates for the rounding of those before.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky_banded, solve_banded

from cfplan.flight.on_board.memory_format import STEPS, ControlPoints
from cfplan.flight.on_board.pieces import COUNT, Pieces
from cfplan.flight.on_board.reference import PolynomialReference
from cfplan.geometry.polynomials import hermite

ENDS = 4  # values that adjacent pieces share: position and three derivatives
# Weight of an error in each derivative: 1 m/s² counts like 3 cm, 5 m/s³ and 50 m/s⁴; of yaw in rad likewise.
_WEIGHTS = {0: 30.0, 2: 1.0, 3: 0.2, 4: 0.02}
_YAW_WEIGHTS = {0: 30.0, 2: 1.0}
_POINTS = 16  # Gauss points per piece for the comparison
_ROUNDS = 3  # rounds of moving knots
_EVENNESS = 0.2  # power of a piece's error by which it attracts knots
_HERMITE = hermite(ENDS)
_BEZIER = np.array([1.0, 7.0, 42.0, 210.0])  # derivatives on [0, 1] per difference of control points


def even_knots(reference: PolynomialReference, count: int) -> NDArray:
    """Return the knots, (count + 1,) s, of pieces of equal duration."""
    return np.linspace(0.0, reference.duration, count + 1)


def drawn_knots(reference: PolynomialReference, count: int) -> NDArray:
    """Return the knots, (count + 1,) s, of pieces that are shorter where they fit worse."""
    knots = even_knots(reference, count)
    for _ in range(_ROUNDS):
        error = _Problem(reference, knots).errors()
        share = (error / max(float(error.mean()), 1e-12) + 0.05) ** _EVENNESS
        mass = np.concatenate([[0.0], np.cumsum(share)])
        knots = np.interp(np.linspace(0.0, mass[-1], count + 1), mass, knots)
    return knots


def fit_pieces(reference: PolynomialReference, knots: NDArray) -> Pieces:
    """Return pieces that end at the knots, (K + 1,) s."""
    problem = _Problem(reference, knots)
    return Pieces(problem.durations, problem.fitted())


def fit_control_points(reference: PolynomialReference, count: int) -> ControlPoints:
    """Return `count` equally long compressed pieces, the last with a rest behind the end of less than `count` ms."""
    milliseconds = int(np.ceil(1000.0 * reference.duration / count))
    problem = _Problem(reference, np.arange(count + 1) * milliseconds * 1e-3)
    p, d1, d2, d3 = problem.whole_numbers().transpose(1, 0, 2)  # (K + 1, 4 axes) each
    left, right = slice(None, -1), slice(1, None)
    points = np.stack(
        [
            p[left] + d1[left],
            p[left] + 2 * d1[left] + d2[left],
            p[left] + 3 * d1[left] + 3 * d2[left] + d3[left],
            p[right] - 3 * d1[right] + 3 * d2[right] - d3[right],
            p[right] - 2 * d1[right] + d2[right],
            p[right] - d1[right],
            p[right],
        ],
        axis=-1,
    )
    return ControlPoints(p[0], np.full(count, milliseconds), points)


class _Problem:
    """Least-squares problem for the shared values of pieces with these knots, (K + 1,) s."""

    def __init__(self, reference: PolynomialReference, knots: NDArray):
        self.durations = np.diff(knots)
        places, weights = np.polynomial.legendre.leggauss(_POINTS)
        self._places, self._weights = (places + 1.0) / 2.0, weights / 2.0
        times = (knots[:-1, None] + self.durations[:, None] * self._places).reshape(-1)
        targets = reference.at(times).reshape(len(self.durations), _POINTS, 5, 4)
        self._motion, self._yaw = targets[..., :3], targets[..., 3:]
        self._ends = reference.ends()

    def fitted(self) -> NDArray:
        """Return the coefficients of the pieces, (K, 4, 8)."""
        common = np.concatenate(
            [
                self._solve(self._motion, _WEIGHTS, self._ends[:, :3]),
                self._solve(self._yaw, _YAW_WEIGHTS, self._ends[:, 3:]),
            ],
            axis=2,
        )  # (K + 1, 4, 4)
        scale = self.durations[:, None, None] ** np.arange(ENDS)[:, None]
        both = np.concatenate([common[:-1] * scale, common[1:] * scale], axis=1)
        unit = np.einsum("pe,kea->kap", _HERMITE, both)
        return np.asarray(unit / self.durations[:, None, None] ** np.arange(COUNT))

    def errors(self) -> NDArray:
        """Return the weighted error of each piece's motion, (K,)."""
        fitted, out = self.fitted(), np.zeros(len(self.durations))
        for k, duration in enumerate(self.durations):
            for order, weight in _WEIGHTS.items():
                shift = _basis(self._places * duration, order) @ fitted[k, :3].T - self._motion[k, :, order]
                out[k] += duration * weight**2 * float(self._weights @ (shift**2).sum(axis=1))
        return np.sqrt(out)

    def whole_numbers(self) -> NDArray:
        """Return (K + 1, 4, 4): p, d₁, d₂, d₃ at each knot, by axis."""
        parts = []
        for targets, weights, axes in ((self._motion, _WEIGHTS, slice(0, 3)), (self._yaw, _YAW_WEIGHTS, slice(3, 4))):
            ends = np.round(self._ends[:, axes] / STEPS[axes])
            parts.append(self._solve(targets / STEPS[axes], weights, ends, integer=True))
        return np.concatenate(parts, axis=2)

    def _solve(self, targets: NDArray, weights: dict[int, float], ends: NDArray, integer: bool = False) -> NDArray:
        """Return the shared values, (K + 1, 4, D), for targets (K, _POINTS, 5, D), as integer differences of control
        points or as derivatives by time.
        """
        count, axes = len(self.durations), targets.shape[-1]
        size = ENDS * (count + 1)
        bands, right = np.zeros((2 * ENDS, size)), np.zeros((size, axes))  # upper bands, as LAPACK has them
        for k, duration in enumerate(self.durations):
            scale = np.tile(_BEZIER if integer else duration ** np.arange(ENDS), 2)
            block, first = np.zeros((2 * ENDS, 2 * ENDS)), ENDS * k
            for order, weight in weights.items():
                rows = _basis(self._places, order) @ _HERMITE * scale / duration**order
                weighted = rows.T * (weight**2 * duration * self._weights)
                block += weighted @ rows
                right[first : first + 2 * ENDS] += weighted @ targets[k, :, order]
            for row in range(2 * ENDS):
                bands[2 * ENDS - 1 - np.arange(2 * ENDS - row), first + row + np.arange(2 * ENDS - row)] += block[
                    row, row:
                ]
        out = np.zeros((size, axes))
        out[0], out[-ENDS] = ends  # the rest of both ends is 0
        if count > 1:
            out[ENDS:-ENDS] = _inner(bands, right, out, integer)
        return out.reshape(count + 1, ENDS, axes).astype(np.int64 if integer else float)


def _inner(bands: NDArray, right: NDArray, fixed: NDArray, integer: bool) -> NDArray:
    """Return the unknowns between the first and the last four, which are `fixed`."""
    size = len(right)
    pulled = right.copy()
    for shift in range(1, 2 * ENDS):
        column = np.arange(shift, size)
        value = bands[2 * ENDS - 1 - shift, shift:][:, None]
        pulled[column - shift] -= value * np.where((column >= size - ENDS)[:, None], fixed[column], 0.0)
        pulled[column] -= value * np.where((column - shift < ENDS)[:, None], fixed[column - shift], 0.0)
    width = min(2 * ENDS, size - 2 * ENDS)  # bands of the remaining unknowns
    bands, pulled = bands[2 * ENDS - width :, ENDS:-ENDS].copy(), pulled[ENDS:-ENDS]
    scale = 1.0 / np.sqrt(bands[-1])
    for shift in range(width):
        bands[width - 1 - shift, :shift] = 0.0
        bands[width - 1 - shift, shift:] *= scale[shift:] * scale[: len(scale) - shift]
    upper = cholesky_banded(bands)
    lower = np.zeros_like(upper)  # its transpose
    for shift in range(width):
        lower[shift, : len(scale) - shift] = upper[width - 1 - shift, shift:]
    halfway = solve_banded((width - 1, 0), lower, pulled * scale[:, None])
    exact = solve_banded((0, width - 1), upper, halfway) * scale[:, None]
    return _rounded(exact, upper / scale) if integer else exact


def _rounded(exact: NDArray, upper: NDArray) -> NDArray:
    """Return integers near `exact`, (N, D), in the metric of a banded upper triangle, by the nearest-plane method."""
    out, shift = np.zeros_like(exact), np.zeros_like(exact)
    last = len(upper) - 1
    for n in range(len(exact) - 1, -1, -1):
        behind = np.arange(n + 1, min(n + last, len(exact) - 1) + 1)
        pull = upper[last - (behind - n), behind] @ shift[behind] if len(behind) else 0.0
        out[n] = np.round(exact[n] - pull / upper[last, n])
        shift[n] = out[n] - exact[n]
    return out


def _basis(places: NDArray, order: int) -> NDArray:
    """Return (N, 8): the derivative of each power of a place."""
    power, factor = np.arange(COUNT), np.ones(COUNT)
    for k in range(order):
        factor = factor * np.maximum(power - k, 0)
    return np.asarray(factor * places[:, None] ** np.maximum(power - order, 0))
