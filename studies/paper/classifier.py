"""A Gaussian process classifier by Laplace's approximation, with a warm start when samples are added.

After C. E. Rasmussen, C. K. I. Williams, "Gaussian Processes for Machine Learning" (2006), algorithms 3.1 and 3.2. The
kernel is given. Newton's method finds the latent values at the samples, a convex problem. Each step factors an N×N
matrix for N samples, and starting at the values of the last fit takes far fewer steps than starting at zero.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.special import expit

STEPS = 100  # of Newton's method, at most
ENOUGH = 1e-10  # gain of log marginal likelihood below which Newton's method ends
Kernel = Any  # scikit-learn's: callable on one or two sets of inputs, with `diag`


@dataclass(frozen=True, slots=True)
class Classifier:
    """A fitted classifier: a latent value above 0 predicts that an input passes."""

    kernel: Kernel
    inputs: NDArray  # (N, D)
    passed: NDArray  # (N,) bool
    values: NDArray  # (N,) latent values at the samples
    slope: NDArray  # (N,) gradient of the log likelihood there
    root: NDArray  # (N,) square root of its negative curvature
    factor: NDArray  # (N, N) lower Cholesky factor of 1 + root K root

    def latent_mean_and_variance(self, inputs: NDArray) -> tuple[NDArray, NDArray]:
        """Return mean and variance, (M,) each, of the latent values at inputs, (M, D); the name is scikit-learn's."""
        across = self.kernel(self.inputs, inputs)
        explained = solve_triangular(self.factor, self.root[:, None] * across, lower=True, check_finite=False)
        return across.T @ self.slope, self.kernel.diag(inputs) - np.einsum("ij,ij->j", explained, explained)


def fit(kernel: Kernel, inputs: NDArray, passed: NDArray, begun: Classifier | None = None) -> Classifier:
    """Return the classifier of these samples; `begun`, a fit of the first of them, is the starting point."""
    values = np.zeros(len(inputs))
    if begun is not None:
        known = len(begun.inputs)
        values[:known] = begun.values
        values[known:] = begun.kernel(begun.inputs, inputs[known:]).T @ begun.slope
    covariance, last = kernel(inputs), -np.inf
    for _ in range(STEPS):
        probable = expit(values)
        curvature = probable * (1.0 - probable)
        root = np.sqrt(curvature)
        factor, lower = cho_factor(_one_plus(root[:, None] * covariance * root), lower=True, check_finite=False)
        right = curvature * values + passed - probable
        weights = right - root * cho_solve((factor, lower), root * (covariance @ right), check_finite=False)
        values = covariance @ weights
        likelihood = -np.logaddexp(0.0, np.where(passed, -values, values)).sum()
        marginal = likelihood - weights @ values / 2.0 - np.log(np.diag(factor)).sum()
        if marginal - last < ENOUGH:
            break
        last = marginal
    return Classifier(kernel, inputs, passed, values, passed - probable, root, factor)


def _one_plus(matrix: NDArray) -> NDArray:
    matrix.flat[:: len(matrix) + 1] += 1.0
    return matrix
