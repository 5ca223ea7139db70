"""The interior point method on problems whose answers others know."""

import casadi
import numpy as np
import pytest
from scipy.linalg import solveh_banded

from cfplan.expert import banded
from cfplan.expert.interior_point import Search, minimise
from cfplan.expert.slacks import bounds_of


class Valley:
    """Rosenbrock's function of a chain, with x_k x_(k+1) and x_k between bounds."""

    rows = 2

    def __init__(self, size, lower, upper, least=-np.inf):
        self.size = size
        m = 2 * size
        low, high = np.full(m, -np.inf), np.full(m, np.inf)
        low[: size - 1], high[: size - 1] = lower, upper  # the last product is of nobody
        low[size:] = least
        self.bounds = bounds_of(low, high)
        self.g, self.multipliers, self.stiffness = np.zeros(m), np.zeros(m), np.zeros(m)
        self.gradient, self.matrix = np.zeros(size), np.zeros((size, 2))

    def cost(self, x):
        return sum(100 * (x[k + 1] - x[k] ** 2) ** 2 + (1 - x[k]) ** 2 for k in range(self.size - 1))

    def values(self, v):
        self.v = v.copy()
        self.g[:] = np.concatenate([v[:-1] * v[1:], [0.0], v])
        return self.cost(v)

    def jacobian(self):
        x, rows = self.v, np.zeros((2 * self.size, self.size))
        k = np.arange(self.size - 1)
        rows[k, k], rows[k, k + 1] = x[1:], x[:-1]
        rows[self.size :] = np.eye(self.size)
        return rows

    def expand(self):
        x = self.v
        self.gradient[:] = 0.0
        self.gradient[:-1] = -400 * x[:-1] * (x[1:] - x[:-1] ** 2) - 2 * (1 - x[:-1])
        self.gradient[1:] += 200 * (x[1:] - x[:-1] ** 2)
        whole = np.zeros((self.size, self.size))
        k = np.arange(self.size - 1)
        whole[k, k] = -400 * x[1:] + 1200 * x[:-1] ** 2 + 2
        whole[k + 1, k + 1] += 200
        whole[k + 1, k] = whole[k, k + 1] = -400 * x[:-1] + self.multipliers[: self.size - 1]
        whole += self.jacobian().T @ (self.stiffness[:, None] * self.jacobian())
        self.matrix[:, 0], self.matrix[1:, 1] = np.diag(whole), np.diag(whole, -1)

    def transposed(self, w):
        return self.jacobian().T @ w

    def along(self, dv):
        return self.jacobian() @ dv


EXACTLY = Search(last_barrier=1e-9, gradient=1e-7, feasibility=1e-9, iterations=300)


@pytest.mark.parametrize(
    ("lower", "upper", "least"), [(-np.inf, np.inf, -np.inf), (-np.inf, 0.5, -np.inf), (0.1, 0.3, 0.2), (2.0, 9.0, 0.0)]
)
def test_it_ends_where_another_solver_does(lower, upper, least):
    start = np.linspace(0.5, 1.5, 8)
    ended = minimise(Valley(8, lower, upper, least), start, EXACTLY)
    assert ended.solved, ended.words
    x = casadi.SX.sym("x", 8)
    problem = {"x": x, "f": Valley(8, lower, upper).cost(x), "g": x[:-1] * x[1:]}
    options = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-10}}
    best = casadi.nlpsol("ipopt", "ipopt", problem, options)(x0=start, lbg=lower, ubg=upper, lbx=least)
    np.testing.assert_allclose(ended.v, np.array(best["x"]).ravel(), atol=2e-5)


def test_bounds_that_contradict_each_other_are_not_called_solved():
    ended = minimise(Valley(8, 4.0, 5.0, -np.inf), np.linspace(0.5, 1.5, 8), Search(iterations=3))
    assert not ended.solved
    ended = minimise(Valley(2, 4.0, 3.9, -np.inf), np.ones(2), Search())
    assert not ended.solved


def test_what_is_not_a_number_is_told():
    ended = minimise(Valley(8, 0.0, 1.0), np.full(8, np.nan), Search())
    assert not ended.solved
    assert "not a number" in ended.words


@pytest.mark.parametrize("width", [1, 2, 5, 9])
def test_banded_matrices_are_factored_as_lapack_does(width):
    rng = np.random.default_rng(width)
    size = 30
    matrix = rng.normal(size=(size, width))
    matrix[:, 0] = 4.0 * width
    x = rng.normal(size=size)
    bands = np.zeros((width, size))
    for d in range(width):
        bands[d, : size - d] = matrix[d:, d]
    bands[0] += 0.5
    expected = solveh_banded(bands, x, lower=True)
    factor = np.empty_like(matrix)
    assert banded.factorise(matrix, 0.5, factor)
    banded.solve(factor, x)
    np.testing.assert_allclose(x, expected, rtol=1e-10)
    assert not banded.factorise(matrix, -4.0 * width, factor)
