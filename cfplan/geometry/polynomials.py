"""Polynomial arithmetic on many pieces at a time, coefficients in ascending powers."""

from functools import lru_cache
from math import comb, factorial

import numpy as np
from numpy.typing import NDArray

_SAMPLES = 17  # along a piece, to find its largest derivatives


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
