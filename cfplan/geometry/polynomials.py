"""Polynomial arithmetic on many pieces at a time, coefficients in ascending powers."""

from functools import lru_cache
from math import comb, factorial

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.machine_code import njit

ORDERS = 5  # a value and four derivatives
_SAMPLES = 17  # along a piece, to find its largest derivatives
_LANES = 64  # points processed together
_FACTORIALS = (1.0, 1.0, 2.0, 6.0, 24.0)
_Derivatives = tuple[float, float, float, float, float]


@njit
def intervals_of(edges: NDArray, values: NDArray) -> NDArray:
    """Return the interval of ascending edges, (M+1,), in which each value, (N,), lies; fast for sorted values.

    An edge belongs to the interval on its right; values beyond the ends belong to the first and the last interval.
    """
    found, k = np.empty(len(values), np.int64), 0
    for n in range(len(values)):
        if not edges[k] <= values[n] < edges[k + 1]:
            k = np.searchsorted(edges[1:-1], values[n], side="right")
        found[n] = k
    return found


@njit(fastmath={"contract"}, nogil=True)
def derivatives_on(origins: NDArray, table: NDArray, x: NDArray, piece: NDArray) -> NDArray:
    """Return polynomials, (M, D, A), and four derivatives, (5, A, N), at x, (N,), by that of a piece for each, (N,).

    Piece i is in powers of x - origins[i]. Up to _LANES consecutive points of one piece are processed together, in rows
    of an array whose size the compiler knows, so that it vectorises.
    """
    axes, begin = table.shape[2], 0
    out, rows = np.empty((ORDERS, axes, len(x))), np.empty((ORDERS + 1, _LANES))
    while begin < len(x):
        k, count = piece[begin], 1
        while count < _LANES and begin + count < len(x) and piece[begin + count] == k:
            count += 1
        for n in range(count):
            rows[ORDERS, n] = x[begin + n] - origins[k]
        for axis in range(axes):
            _horner(rows, table[k, :, axis], min(count, _LANES))
            for order in range(ORDERS):
                to = out[order, axis, begin : begin + count]
                for n in range(len(to)):
                    to[n] = _FACTORIALS[order] * rows[order, n]
        begin += count
    return out


@register_jitable(forceinline=True, fastmath={"contract"})
def _horner(rows: NDArray, coefficients: NDArray, count: int) -> None:
    """Write a polynomial and four derivatives over the factorials of their orders; x are in the last of the rows."""
    for order in range(ORDERS):
        for n in range(count):
            rows[order, n] = 0.0
    for k in range((len(coefficients) - 1) // 4 * 4, -1, -4):  # four coefficients at a time, for less memory traffic
        a, b = coefficients[k], _or_zero(coefficients, k + 1)
        c, d = _or_zero(coefficients, k + 2), _or_zero(coefficients, k + 3)
        for n in range(count):
            x, p = rows[ORDERS, n], (rows[0, n], rows[1, n], rows[2, n], rows[3, n], rows[4, n])
            p = _step(x, a, _step(x, b, _step(x, c, _step(x, d, p))))
            rows[0, n], rows[1, n], rows[2, n], rows[3, n], rows[4, n] = p


@register_jitable(forceinline=True, fastmath={"contract"})
def _step(x: float, coefficient: float, p: _Derivatives) -> _Derivatives:
    return x * p[0] + coefficient, x * p[1] + p[0], x * p[2] + p[1], x * p[3] + p[2], x * p[4] + p[3]


@register_jitable(forceinline=True)
def _or_zero(coefficients: NDArray, power: int) -> float:
    return coefficients[power] if power < len(coefficients) else 0.0


def shifted(table: NDArray, offset: NDArray) -> NDArray:
    """Return the same polynomials (M, D, 3), each in powers of x - offset[i], with offset (M,)."""
    binomials, exponents = _shift(table.shape[1])
    return (binomials * offset[:, None, None] ** exponents) @ table


@lru_cache(maxsize=16)
def _shift(count: int) -> tuple[NDArray, NDArray]:
    """Return the binomials, and the exponents of the offset, (count, count) each, by which polynomials are shifted."""
    binomials = np.array([[comb(k, j) if k >= j else 0 for k in range(count)] for j in range(count)], dtype=float)
    return binomials, np.maximum(np.arange(count) - np.arange(count)[:, None], 0)


def reversed_pieces(durations: NDArray, table: NDArray) -> tuple[NDArray, NDArray]:
    """Return the same curve flown backwards, each piece about its new left end."""
    signs = (-1.0) ** np.arange(table.shape[1])
    return durations[::-1], (shifted(table, durations) * signs[:, None])[::-1]


def end_values(durations: NDArray, table: NDArray, orders: int = 5) -> tuple[NDArray, NDArray]:
    """Return the derivatives of each piece at its left and at its right end, (M, orders, 3) each."""
    table = padded(table, max(orders, table.shape[1]))
    factorials = np.array([factorial(k) for k in range(orders)], dtype=float)[:, None]
    return table[:, :orders] * factorials, shifted(table, durations)[:, :orders] * factorials


def largest_values(durations: NDArray, table: NDArray) -> NDArray:
    """Return the largest norm along each piece of its position and first four derivatives, (M, 5), sampled."""
    samples = [end_values(durations * part, table)[1] for part in np.linspace(0.0, 1.0, _SAMPLES)]
    return np.asarray(np.linalg.norm(samples, axis=-1).max(axis=0))


def padded(table: NDArray, count: int) -> NDArray:
    """Return the same polynomials with `count` coefficients each, (M, count, 3)."""
    wider = np.zeros((len(table), count, 3))
    wider[:, : table.shape[1]] = table
    return wider


def composed(outer: NDArray, inner: NDArray, count: int) -> NDArray:
    """Return the first `count` coefficients of outer(inner(x)) by Horner's rule: outer (D, 3), inner (E,)."""
    inner = inner[:count]
    result = np.zeros((count, 3))
    for coefficient in outer[::-1]:
        for axis in range(3):
            result[:, axis] = np.convolve(result[:, axis], inner)[:count]
        result[0] += coefficient
    return result


def hermite(orders: int) -> NDArray:
    """Return the Hermite matrix: the first `orders` derivatives at 0, then at 1, to coefficients on [0, 1]."""
    rows = np.zeros((2 * orders, 2 * orders))
    for order in range(orders):
        for power in range(order, 2 * orders):
            rows[orders + order, power] = factorial(power) / factorial(power - order)
        rows[order, order] = factorial(order)
    return np.linalg.inv(rows)
