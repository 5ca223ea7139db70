"""The evaluator of polynomials in pieces against numpy's, and the search for the piece."""

import numpy as np
import pytest

from cfplan.geometry.polynomials import derivatives_on, intervals_of


@pytest.mark.parametrize("degree", [0, 2, 7, 9, 15])
@pytest.mark.parametrize("axes", [1, 4])
def test_values_and_derivatives_are_those_of_numpy(degree, axes):
    random = np.random.default_rng(degree)
    origins, table = random.normal(size=5), random.normal(size=(5, degree + 1, axes))
    piece = np.sort(random.integers(0, 5, 500))
    x = origins[piece] + random.uniform(-1.0, 1.0, 500)
    found = derivatives_on(origins, table, x, piece)
    assert found.shape == (5, axes, 500)
    for order in range(5):
        for axis in range(axes):
            derived = [np.polynomial.Polynomial(table[k, :, axis]).deriv(order) for k in range(5)]
            expected = [derived[k](at - origins[k]) for k, at in zip(piece, x, strict=True)]
            np.testing.assert_allclose(found[order, axis], expected, rtol=1e-9, atol=1e-9)


def test_an_edge_belongs_to_the_interval_on_its_right_and_the_outermost_hold_what_lies_beyond():
    edges = np.array([0.0, 0.5, 0.75, 2.0])
    values = np.array([-1.0, 0.0, 0.4, 0.5, 0.6, 0.75, 2.0, 9.0, 0.1, np.nextafter(0.5, 0.0)])
    np.testing.assert_array_equal(intervals_of(edges, values), [0, 0, 0, 1, 1, 2, 2, 2, 0, 0])
