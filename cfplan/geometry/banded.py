"""Banded Cholesky factors, solutions and products of symmetric matrices.

A matrix is a (size, width) array whose entry [r, d] is the matrix's (r, r - d).
"""

import math

import numpy as np
from numpy.typing import NDArray

from cfplan.machine_code import njit

REGULARISED, REGULARISED_MOST = 1e-4, 1e14  # added to a diagonal if necessary, first and largest value
_LEAST_PIVOT = 1e-12  # of matrices whose diagonal is about 1


@njit(error_model="numpy", fastmath={"contract"})
def factorise(matrix, added, least=_LEAST_PIVOT):
    """Return the Cholesky factor of the matrix plus `added` on its diagonal, and whether all pivots exceed `least`.

    The diagonal of the factor is inverted. A row of zeros is treated as that of the unit matrix.
    """
    size, width = matrix.shape
    factor = np.empty((size, width))
    for r in range(size):
        reach = min(width - 1, r)
        for d in range(reach, 0, -1):
            value = matrix[r, d]
            for e in range(d + 1, reach + 1):  # the columns to the left that both rows reach
                value -= factor[r, e] * factor[r - d, e - d]
            factor[r, d] = value * factor[r - d, 0]
        value = matrix[r, 0]
        if value == 0.0:
            value = 1.0
        for e in range(1, reach + 1):
            value -= factor[r, e] * factor[r, e]
        value += added
        if not value > least:
            return factor, False
        factor[r, 0] = 1.0 / math.sqrt(value)
    return factor, True


@njit(error_model="numpy", fastmath={"contract"})
def solve(factor, right):
    """Return the solution for a right side, (size,)."""
    size, width = factor.shape
    x = right.copy()
    for r in range(size):
        value = x[r]
        for d in range(1, min(width - 1, r) + 1):
            value -= factor[r, d] * x[r - d]
        x[r] = value * factor[r, 0]
    for r in range(size - 1, -1, -1):
        value = x[r] * factor[r, 0]
        x[r] = value
        for d in range(1, min(width - 1, r) + 1):
            x[r - d] -= factor[r, d] * value
    return x


@njit(error_model="numpy")
def solve_regularised(matrix, right, regularised):
    """Solve with a diagonal term that makes the matrix positive definite; return (solution, term).

    `regularised` is the term of the last time. If none helps, the solution is NaN.
    """
    added = 0.0
    factor, definite = factorise(matrix, added)
    while not definite:
        added = 8.0 * added if added > 0.0 else max(REGULARISED, regularised / 3.0)
        if added > REGULARISED_MOST:
            return np.full(len(right), math.nan), added
        factor, definite = factorise(matrix, added)
    return solve(factor, right), added


def solve_definite(matrix: NDArray, right: NDArray) -> NDArray:
    """Return the solution for right sides, (size, K), of a positive definite matrix, (size, width).

    Rows and columns may differ by many decades, as they are first scaled to a diagonal of ones.

    Raises LinAlgError unless the scaled matrix is positive definite beyond rounding.
    """
    diagonal = matrix[:, 0]
    if not diagonal.min() > 0.0:
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    scale = 1.0 / np.sqrt(diagonal)
    scaled = scale[:, None] * matrix
    for d in range(matrix.shape[1]):
        scaled[d:, d] *= scale[: len(scale) - d]
    solution, definite = solve_columns(scaled, scale[:, None] * right)
    if not definite:
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    return np.asarray(scale[:, None] * solution)


@njit(error_model="numpy")
def solve_columns(matrix, right):
    """Return the solution for right sides, (size, K), and whether the matrix is positive definite beyond rounding."""
    factor, definite = factorise(matrix, 0.0, _LEAST_PIVOT * matrix[:, 0].max())
    solution = np.empty_like(right)
    for k in range(right.shape[1]):
        column = solve(factor, right[:, k].copy())
        for row in range(len(column)):
            solution[row, k] = column[row]
    return solution, definite
