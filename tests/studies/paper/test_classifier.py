"""The classifier of Bayesian optimisation, against scikit-learn's, which has no warm start."""

import numpy as np
import pytest
from sklearn.gaussian_process import GaussianProcessClassifier
from sklearn.gaussian_process.kernels import RBF, ConstantKernel

from studies.paper.classifier import fit

KERNEL = ConstantKernel(30.0) * RBF([0.4, 0.9])


@pytest.fixture
def samples():
    random = np.random.default_rng(3)
    inputs = random.uniform(0.0, 2.0, (120, 2))
    return inputs, inputs.sum(axis=1) + random.normal(0.0, 0.2, 120) > 2.0


def test_it_knows_what_scikit_learn_knows(samples):
    inputs, passed = samples
    asked = np.random.default_rng(4).uniform(0.0, 2.0, (50, 2))
    theirs = GaussianProcessClassifier(KERNEL, optimizer=None).fit(inputs, passed).latent_mean_and_variance(asked)
    for ours, other in zip(fit(KERNEL, inputs, passed).latent_mean_and_variance(asked), theirs, strict=True):
        np.testing.assert_allclose(ours, other, rtol=1e-6, atol=1e-6)


def test_more_samples_lead_from_where_it_is_to_the_same(samples):
    inputs, passed = samples
    asked = np.random.default_rng(5).uniform(0.0, 2.0, (50, 2))
    begun = fit(KERNEL, inputs[:100], passed[:100])
    grown, anew = fit(KERNEL, inputs, passed, begun), fit(KERNEL, inputs, passed)
    for one, other in zip(grown.latent_mean_and_variance(asked), anew.latent_mean_and_variance(asked), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5)
