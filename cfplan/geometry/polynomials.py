"""Arithmetic on polynomials with coefficients in ascending powers, many at a time."""

from math import comb

import numpy as np
from numpy.typing import NDArray


def shifted(table: NDArray, offset: NDArray) -> NDArray:
    """Polynomials in x - offset[i] for polynomials in x: (M, D, 3) and (M,) to (M, D, 3)."""
    count = table.shape[1]
    binomials = np.array([[comb(k, j) if k >= j else 0 for k in range(count)] for j in range(count)], dtype=float)
    exponents = np.maximum(np.arange(count) - np.arange(count)[:, None], 0)
    return (binomials * offset[:, None, None] ** exponents) @ table


def padded(table: NDArray, count: int) -> NDArray:
    """The same polynomials with `count` coefficients each, (M, count, 3)."""
    return np.pad(table, ((0, 0), (0, count - table.shape[1]), (0, 0)))


def product(a: NDArray, b: NDArray, count: int) -> NDArray:
    """a·b to `count` coefficients; (..., D) each."""
    return np.convolve(a, b)[:count]


def composed(outer: NDArray, inner: NDArray, count: int) -> NDArray:
    """outer(inner(x)) to `count` coefficients: outer (D, 3), inner (E,), result (count, 3). By Horner."""
    inner = inner[:count]
    result = np.zeros((count, 3))
    for coefficient in outer[::-1]:
        for axis in range(3):
            result[:, axis] = product(result[:, axis], inner, count)
        result[0] += coefficient
    return result
