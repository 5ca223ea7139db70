"""Banded Cholesky against LAPACK."""

import numpy as np
import pytest
from scipy.linalg import solveh_banded

from cfplan.geometry import banded


def system(width, right_sides=1):
    """A matrix as banded.py has it, as scipy has it, and right sides."""
    rng = np.random.default_rng(width)
    size = 30
    matrix = rng.normal(size=(size, width))
    matrix[:, 0] = 4.0 * width
    bands = np.zeros((width, size))
    for d in range(width):
        bands[d, : size - d] = matrix[d:, d]
    return matrix, bands, rng.normal(size=(size, right_sides))


@pytest.mark.parametrize("width", [1, 2, 5, 9])
def test_banded_matrices_are_factored_as_lapack_does(width):
    matrix, bands, right = system(width)
    bands[0] += 0.5
    expected = solveh_banded(bands, right[:, 0], lower=True)
    factor, definite = banded.factorise(matrix, 0.5)
    assert definite
    np.testing.assert_allclose(banded.solve(factor, right[:, 0].copy()), expected, rtol=1e-10)
    assert not banded.factorise(matrix, -4.0 * width)[1]


@pytest.mark.parametrize("scale", [1.0, 1e-15])
def test_definite_matrices_are_solved_for_several_right_sides_however_small_they_are(scale):
    matrix, bands, right = system(4, right_sides=3)
    expected = solveh_banded(scale * bands, right, lower=True)
    np.testing.assert_allclose(banded.solve_definite(scale * matrix, right), expected, rtol=1e-10)


def test_rows_and_columns_may_differ_by_many_decades():
    matrix, bands, right = system(4)
    scale = np.logspace(0, -12, len(matrix))
    rows = np.arange(len(matrix))
    for d in range(4):
        matrix[:, d] *= scale * scale[np.maximum(rows - d, 0)]
    expected = solveh_banded(bands, right, lower=True) / scale[:, None]
    np.testing.assert_allclose(banded.solve_definite(matrix, scale[:, None] * right), expected, rtol=1e-9)


def test_a_matrix_that_is_not_definite_is_not_solved():
    matrix, _, right = system(3)
    matrix[7, 0] = -1.0
    with pytest.raises(np.linalg.LinAlgError):
        banded.solve_definite(matrix, right)
