"""The interior point method on problems whose answers others know."""

from dataclasses import replace

import casadi
import numpy as np
import pytest

from cfplan.planners.solver import barrier
from cfplan.planners.solver.barrier import bounds_of
from cfplan.planners.solver.interior_point import Linearisation, Search, Values, minimise


class Valley:
    """Rosenbrock's function of a chain, with x_k x_(k+1) and x_k between bounds."""

    rows = 2

    def __init__(self, size, lower, upper, least=-np.inf):
        self.size = size
        m = 2 * size
        low, high = np.full(m, -np.inf), np.full(m, np.inf)
        low[: size - 1], high[: size - 1] = lower, upper  # there is no last product
        low[size:] = least
        self.bounds = bounds_of(low, high)

    def cost(self, x):
        return sum(100 * (x[k + 1] - x[k] ** 2) ** 2 + (1 - x[k]) ** 2 for k in range(self.size - 1))

    def evaluate(self, v):
        return Values(self.cost(v), np.concatenate([v[:-1] * v[1:], [0.0], v]))

    def jacobian(self, x):
        rows = np.zeros((2 * self.size, self.size))
        k = np.arange(self.size - 1)
        rows[k, k], rows[k, k + 1] = x[1:], x[:-1]
        rows[self.size :] = np.eye(self.size)
        return rows

    def linearise(self, x, terms):
        sigma, multipliers = terms[:2]
        jacobian = self.jacobian(x)
        gradient = np.zeros(self.size)
        gradient[:-1] = -400 * x[:-1] * (x[1:] - x[:-1] ** 2) - 2 * (1 - x[:-1])
        gradient[1:] += 200 * (x[1:] - x[:-1] ** 2)
        whole = np.zeros((self.size, self.size))
        k = np.arange(self.size - 1)
        whole[k, k] = -400 * x[1:] + 1200 * x[:-1] ** 2 + 2
        whole[k + 1, k + 1] += 200
        whole[k + 1, k] = whole[k, k + 1] = -400 * x[:-1] + multipliers[: self.size - 1]
        whole += jacobian.T @ (sigma[:, None] * jacobian)
        matrix = np.stack([np.diag(whole), np.append(0.0, np.diag(whole, -1))], axis=1)
        return Linearisation(np.vstack([gradient, terms[1:] @ jacobian]), matrix, lambda dv: jacobian @ dv)


EXACTLY = Search(last_barrier=1e-9, gradient=1e-7, feasibility=1e-9, iterations=300)


@pytest.mark.parametrize(
    ("lower", "upper", "least"), [(-np.inf, np.inf, -np.inf), (-np.inf, 0.5, -np.inf), (0.1, 0.3, 0.2), (2.0, 9.0, 0.0)]
)
def test_it_ends_where_another_solver_does(lower, upper, least):
    start = np.linspace(0.5, 1.5, 8)
    ended = minimise(Valley(8, lower, upper, least), start, EXACTLY)
    assert ended.solved, ended.message
    x = casadi.SX.sym("x", 8)
    problem = {"x": x, "f": Valley(8, lower, upper).cost(x), "g": x[:-1] * x[1:]}
    options = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-10}}
    best = casadi.nlpsol("ipopt", "ipopt", problem, options)(x0=start, lbg=lower, ubg=upper, lbx=least)
    np.testing.assert_allclose(ended.v, np.array(best["x"]).ravel(), atol=2e-5)


def test_a_search_that_takes_whole_steps_at_their_word_saves_looking_and_ends_as_near():
    class Looks(Valley):
        count = 0

        def linearise(self, x, terms):
            self.count += 1
            return super().linearise(x, terms)

    start = np.linspace(0.5, 1.5, 8)
    near = Search(barrier=1e-3, last_barrier=1e-3, gradient=1e-3, feasibility=1e-3, iterations=300)
    first, second = Looks(8, -np.inf, 0.5), Looks(8, -np.inf, 0.5)
    looked = minimise(first, start, near)
    believed = minimise(second, start, replace(near, predicted_gradient_factor=1e-3))
    assert looked.solved
    assert believed.solved
    assert second.count < first.count
    np.testing.assert_allclose(believed.v, looked.v, atol=5e-3)


@pytest.mark.parametrize("size", [1, 15, 16, 17, 50])
def test_the_worst_of_all_slacks_counts_wherever_it_is(size):
    rng = np.random.default_rng(size)
    lower, upper = np.where(rng.random(size) < 0.3, -np.inf, -1.0), np.where(rng.random(size) < 0.3, np.inf, 1.0)
    bounds = bounds_of(lower, upper)
    for worst in range(size):
        g, along = rng.uniform(-0.9, 0.9, (2, size))
        state = np.stack([rng.uniform(-0.9, 0.9, size), *rng.uniform(0.1, 1.0, (2, size))])
        along[worst] *= 50.0
        s, low, high = state[0], state[1] * bounds[2], state[2] * bounds[3]
        state[1], state[2] = low, high
        active = np.isfinite(lower) | np.isfinite(upper)
        below, above = np.where(bounds[2], s - lower, 1.0), np.where(bounds[3], upper - s, 1.0)
        off = max((bounds[2] * abs(low * below - 0.01)).max(), (bounds[3] * abs(high * above - 0.01)).max())
        assert barrier.errors(g, bounds, state, 0.01) == pytest.approx(((active * abs(g - s)).max(), off))
        d = active * (g - s + along)
        dlow, dhigh = bounds[2] * ((0.01 - low * d) / below - low), bounds[3] * ((0.01 + high * d) / above - high)
        most = max((-bounds[2] * d / below).max(), (bounds[3] * d / above).max())
        dual = max((-dlow / (low + 1e-300)).max(), (-dhigh / (high + 1e-300)).max())
        step, _, share, share_dual = barrier.search_direction(g, along, bounds, state, 0.01, 0.99)
        assert share == pytest.approx(min(1.0, 0.99 / max(most, 1e-30)))
        assert share_dual == pytest.approx(min(1.0, 0.99 / max(dual, 1e-30)))
        np.testing.assert_allclose(step, [d, dlow, dhigh], rtol=1e-9, atol=1e-9)


def test_bounds_that_contradict_each_other_are_not_called_solved():
    ended = minimise(Valley(8, 4.0, 5.0, -np.inf), np.linspace(0.5, 1.5, 8), Search(iterations=3))
    assert not ended.solved
    ended = minimise(Valley(2, 4.0, 3.9, -np.inf), np.ones(2), Search())
    assert not ended.solved


def test_what_is_not_a_number_is_told():
    ended = minimise(Valley(8, 0.0, 1.0), np.full(8, np.nan), Search())
    assert not ended.solved
    assert "not a number" in ended.message


@pytest.mark.parametrize("steepness", [1e60, 1e70, 1e140])
def test_a_huge_gradient_ends_the_search_with_a_message(steepness):
    class Cliff(Valley):
        def evaluate(self, v):
            return Values(-steepness * float(v.sum()), np.zeros(2 * self.size))

        def linearise(self, x, terms):
            gradients = np.vstack([np.full(self.size, -steepness), np.zeros((3, self.size))])
            return Linearisation(gradients, np.tile([1.0, 0.0], (self.size, 1)), lambda dv: np.zeros(2 * self.size))

    ended = minimise(Cliff(8, -np.inf, np.inf), np.zeros(8), Search(iterations=5))
    assert not ended.solved
    assert ended.message


def test_a_search_goes_on_from_another_whose_bounds_were_wider_in_a_few_steps():
    start = np.linspace(0.5, 1.5, 8)
    near = Search(barrier=1e-3, last_barrier=1e-3, gradient=1e-3, feasibility=1e-3, iterations=300)
    wide, narrow = Valley(8, -np.inf, 0.5, 0.1), Valley(8, -np.inf, 0.49, 0.11)
    ended = minimise(wide, start, near)
    afresh, went_on = minimise(narrow, ended.v, near), minimise(narrow, ended.v, near, known=ended.multipliers)
    assert afresh.solved
    assert went_on.solved
    assert went_on.iterations < afresh.iterations
    np.testing.assert_allclose(went_on.v, afresh.v, atol=5e-3)
