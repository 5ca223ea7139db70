"""Banded Cholesky factors, solutions and products of symmetric matrices.

A matrix is a (size, width) array whose entry [r, d] is the matrix's (r, r - d).
"""

import math

from cfplan.machine_code import njit

REGULARISED, REGULARISED_MOST = 1e-4, 1e14
# added to a diagonal where it must, at first and at most


@njit(error_model="numpy", fastmath={"contract"})
def factorise(matrix, added, factor):
    """The Cholesky factor of the matrix plus `added` on its diagonal, into `factor`; False where there is none.

    Its diagonal is kept inverted. A row that nothing touches counts as that of the unit matrix.
    """
    size, width = matrix.shape
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
        if not value > 1e-12:
            return False
        factor[r, 0] = 1.0 / math.sqrt(value)
    return True


@njit(error_model="numpy", fastmath={"contract"})
def solve(factor, x):
    """Solve for the right side x, in place."""
    size, width = factor.shape
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


@njit(error_model="numpy")
def solve_regularised(matrix, regularised, factor, x):
    """Solve for the right side x, in place, with as much added to the diagonal as makes the matrix positive definite.

    Gives what was added; `regularised` is what that was the last time. Where nothing helps x becomes NaN.
    """
    added = 0.0
    while not factorise(matrix, added, factor):
        added = 8.0 * added if added > 0.0 else max(REGULARISED, regularised / 3.0)
        if added > REGULARISED_MOST:
            x[:] = math.nan
            return added
    solve(factor, x)
    return added
