"""Smooth a network's answers into the coefficients of a cubic B-spline.

Answers are joined to the three coefficients that are already known, or to a rest, and smoothed by the
least sum of squared changes and squared third differences of log √u. The weight of the second depends on how long an
interval takes, so that motion is smoothed over the same time on any grid. Where the path rests, four coefficients are
equal, so that h stays constant over the first or last interval (see planners/expert/expert.py).
"""

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from cfplan.machine_code import njit
from cfplan.vehicle.profile_spline import weights_at

MAX_STIFFNESS = 1e6  # weight of third differences against changes
_BAND = 3  # width of the normal equations


class Begin(IntEnum):
    """How a window begins."""

    REST = 0
    KNOWN = 1  # u₋₁, u₀, u₁ are settled
    FREE = 2


@njit(error_model="numpy")
def smoothed(rates: NDArray, settled: NDArray, begin: int, rest_end: bool, duration: float) -> NDArray:
    """Return (W+3,) log √u/Δs at nodes -1 … W+1 from answers, (W+1,), and the settled ones, (3,).

    They are smoothed over `duration`, in the unit of time of the rates.
    """
    count = len(rates) + 2
    first = 3 if begin == 0 else 0
    last = count - 4 if rest_end else count - 1
    held = 3 if begin == 1 else 0
    size = last - first + 1
    # Column k of the lower band holds the element k below the diagonal; variables are those from `first` to `last`.
    band, right = np.zeros((size, _BAND + 1)), np.zeros(size)
    for n in range(count):
        row = min(max(n, first), last) - first
        if 1 <= n < count - 1:
            band[row, 0] += 1.0
            right[row] += rates[n - 1]
    weights = (-1.0, 3.0, -3.0, 1.0)
    for n in range(count - 3):
        stiffness = min((duration * np.exp(rates[min(n, len(rates) - 1)])) ** 6, MAX_STIFFNESS)
        for i in range(4):
            row = min(max(n + i, first), last) - first
            for j in range(4):
                column = min(max(n + j, first), last) - first
                if column <= row:
                    band[column, row - column] += stiffness * weights[i] * weights[j]
    for n in range(held):  # known coefficients move to the right-hand side
        for k in range(1, _BAND + 1):
            if n + k >= held and n + k < size:
                right[n + k] -= band[n, k] * settled[n]
        band[n, 0] = 1.0
        for k in range(1, _BAND + 1):
            band[n, k] = 0.0
        right[n] = settled[n]
    _solve(band, right)
    out = np.empty(count)
    for n in range(count):
        out[n] = right[min(max(n, first), last) - first]
    return out


@njit(error_model="numpy")
def _solve(band: NDArray, right: NDArray) -> None:
    """Solve by Cholesky's method for a banded matrix, in place."""
    size = len(right)
    for n in range(size):
        pivot = np.sqrt(band[n, 0])
        for k in range(_BAND + 1):
            band[n, k] /= pivot
        for i in range(1, _BAND + 1):
            if n + i < size:
                for j in range(i, _BAND + 1):
                    band[n + i, j - i] -= band[n, i] * band[n, j]
    for n in range(size):
        right[n] /= band[n, 0]
        for k in range(1, min(_BAND + 1, size - n)):
            right[n + k] -= band[n, k] * right[n]
    for n in range(size - 1, -1, -1):
        for k in range(1, min(_BAND + 1, size - n)):
            right[n] -= band[n, k] * right[n + k]
        right[n] /= band[n, 0]


def travel_time(coefficients: NDArray, step: float) -> float:
    """Return the travel time, s, of a spline of h, by four-point Gauss quadrature on every interval."""
    places, shares = np.polynomial.legendre.leggauss(4)
    last = len(coefficients) - 3
    h = sum(w[:, None] * coefficients[k : last + k] for k, w in enumerate(weights_at((places + 1.0) / 2.0)))
    return float(step / 2.0 * (shares @ (1.0 / np.sqrt(h))).sum())
