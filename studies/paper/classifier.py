"""A Gaussian process that classifies, by Laplace's approximation, and is refitted from where it is as samples come.

After C. E. Rasmussen, C. K. I. Williams, "Gaussian Processes for Machine Learning" (2006), algorithms 3.1 and 3.2. The
kernel is given. Newton's method finds the latent values at the samples, of which there is one best set. Each step
factors a matrix as large as there are samples, and from the values of the last fit far fewer are needed than from zero.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.special import expit

STEPS = 100  # of Newton's method, at most
ENOUGH = 1e-10  # gain of log marginal likelihood at which it ends
Kernel = Any  # of scikit-learn: callable on one or two sets of inputs, with `diag`


@dataclass(frozen=True, slots=True)
class Classifier:
    """What is known of which inputs pass: latent values, above 0 where passing is likely."""

    kernel: Kernel
    inputs: NDArray  # (N, D)
    passed: NDArray  # (N,) bool
    values: NDArray  # (N,) latent, at the samples
    slope: NDArray  # (N,) of the log likelihood there
    root: NDArray  # (N,) of its curvature
    factor: NDArray  # (N, N) lower Cholesky factor of 1 + root K root

    def latent_mean_and_variance(self, inputs: NDArray) -> tuple[NDArray, NDArray]:
        """Return mean and variance of the latent values at inputs, (M, D); named as scikit-learn's."""
        across = self.kernel(self.inputs, inputs)
        explained = solve_triangular(self.factor, self.root[:, None] * across, lower=True, check_finite=False)
        return across.T @ self.slope, self.kernel.diag(inputs) - np.einsum("ij,ij->j", explained, explained)


def fit(kernel: Kernel, inputs: NDArray, passed: NDArray, begun: Classifier | None = None) -> Classifier:
    """Return the classifier of these samples; `begun` is that of the first of them, from which the search starts."""
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
