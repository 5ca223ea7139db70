"""Segment times by multi-fidelity Bayesian optimisation, as MFBOTrajectory finds them.

G. Ryou, E. Tal, S. Karaman, "Multi-fidelity black-box optimization for time-optimal quadrotor maneuvers" (2021). A
motion through waypoints depends only on the times of its segments. Gaussian process classifiers learn which times can
be flown from two checks of different cost. Each step evaluates the check and the times with the largest expected gain
of time or, if no gain is likely, those where the classifiers are least certain.

As published: times are factors on the fastest uniform timing of each check, half of the cheap check's samples are
feasible, uniform timings initialise the expensive check, and so are acquisition, thresholds and budgets. The classifier
of the expensive check has the latent value of the cheap one as an additional input. Different from the publication:
scikit-learn fits hyperparameters, with Laplace's approximation and without inducing points (classifier.py beside this
file updates the fit); there are CANDIDATES in place of 16,384; the lower confidence bound is CONFIDENCE standard
deviations below the mean.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit
from scipy.stats import qmc

from cfplan.errors import InfeasibleError, InputError
from studies.paper.classifier import fit

Check = Callable[[NDArray], bool]  # whether a motion with these segment times, (S,) s, passes
MIN_FACTOR, MAX_FACTOR = 0.1, 1.9  # range of factors on the nominal times
SPREAD = 0.2  # standard deviation of the factors of cheap samples drawn around the nominal times, half of all
STEPS = 14  # of the bisection for the fastest uniform timing
CANDIDATES = 1024  # candidates of each step
SHAPED = 300  # samples of the cheap check to which its classifier's hyperparameters are fitted
NEAR, FAR = 0.01, 0.3  # standard deviations of candidates about the best factors, drawn between
CONFIDENCE = 1.0
SURE_LOW, SURE_HIGH = 0.1, 0.4  # least probability to pass, by the lower bound, for a gain to count
COST_LOW, COST_HIGH = 1.0, 10.0  # cost weights of the two checks in the search for the least certain times
_LATENT = 5.0  # bound of the latent value as an input: beyond it the cheap check is certain


@dataclass(frozen=True, slots=True)
class Budget:
    """The number of evaluations of the checks; the defaults are the published numbers."""

    low: int = 1000  # cheap samples before the first step
    high: int = 20  # expensive samples before the first step
    iterations: int = 50  # expensive evaluations by acquisition
    more_low: int = 50  # cheap evaluations by acquisition, at most


class OptimisedTimes(NamedTuple):
    """The fastest times that passed the expensive check."""

    times: NDArray  # (S,) s
    uniform: float  # s, total time of the fastest uniform timing that passed it
    asked_low: int
    asked_high: int


class _Samples:
    """The evaluations of one check: factors on its nominal times, and whether they passed."""

    def __init__(self, check: Check, nominal: NDArray) -> None:
        self.check, self.asked = check, 0
        self.nominal = nominal * _fastest_uniform(self._answer, nominal)
        self.factors: NDArray = np.empty((0, len(nominal)))
        self.passed: NDArray = np.empty(0, dtype=bool)

    def ask(self, factors: NDArray) -> bool:
        passed = self._answer(factors * self.nominal)
        self.factors = np.concatenate([self.factors, factors[None]])
        self.passed = np.append(self.passed, passed)
        return passed

    def _answer(self, times: NDArray) -> bool:
        self.asked += 1
        return bool(self.check(times))


def optimise_times(
    nominal: NDArray, low: Check, high: Check, *, budget: Budget | None = None, seed: int = 0
) -> OptimisedTimes:
    """Return the fastest times found. Uniform timings are multiples of `nominal`, (S,) s.

    Raises:
        InfeasibleError: no uniform timing passes a check.
        InputError: scikit-learn is not installed.
    """
    budget = budget or Budget()
    random = np.random.default_rng(seed)
    cheap, dear = _Samples(low, nominal), _Samples(high, nominal)
    uniform = float(dear.nominal.sum())
    _ask_both_kinds(cheap, budget.low, random)
    for step in range(budget.high // 2):  # uniform timings, slower and faster in turn
        for sign in (1.0, -1.0):
            dear.ask(
                np.full(len(nominal), 1.0 + sign * step * 2.0 * (MAX_FACTOR - 1.0) / budget.high - (sign < 0) * 0.05)
            )
    best = np.ones(len(nominal))
    some = random.permutation(len(cheap.passed))[:SHAPED]
    shaped = _fitted(cheap.factors[some], cheap.passed[some])
    cheap_model, chosen_low = fit(shaped.kernel_, cheap.factors, cheap.passed), 0
    for _ in range(budget.iterations):
        while True:
            dear_model = _fitted(_with_latent(cheap_model, dear.factors), dear.passed)
            fidelity, factors = _next(
                _about(best, random), best, dear.nominal, cheap_model, dear_model, chosen_low < budget.more_low
            )
            if fidelity is dear_model:
                break
            chosen_low += 1
            cheap.ask(factors)
            cheap_model = fit(shaped.kernel_, cheap.factors, cheap.passed, cheap_model)
        if dear.ask(factors) and factors @ dear.nominal < best @ dear.nominal:
            best = factors
    return OptimisedTimes(best * dear.nominal, uniform, cheap.asked, dear.asked)


def require_library() -> None:
    """Raise InputError if scikit-learn is not installed."""
    _classifier()


def _fastest_uniform(passes: Check, nominal: NDArray) -> float:
    """Return the least factor on all times that passes, by STEPS bisections; assumes that slower times pass too."""
    slow = next((factor for factor in 2.0 ** np.arange(-4, 8) if passes(factor * nominal)), None)
    if slow is None:
        raise InfeasibleError("no timing of this motion passes", hint="give other waypoints")
    fast = slow / 2.0
    for _ in range(STEPS):
        middle = (slow + fast) / 2.0
        slow, fast = (middle, fast) if passes(middle * nominal) else (slow, middle)
    return float(slow)


def _ask_both_kinds(samples: _Samples, count: int, random: np.random.Generator) -> None:
    """Evaluate samples until `count` are found, half of which pass; discard the surplus of the more common kind."""
    size, batch = samples.nominal.size, max(count // 10, 1)
    kept: dict[bool, list[NDArray]] = {True: [], False: []}
    for _ in range(100):
        even = MIN_FACTOR + (MAX_FACTOR - MIN_FACTOR) * qmc.LatinHypercube(size, rng=random).random(batch)
        about = np.clip(random.normal(1.0, SPREAD, (batch, size)), MIN_FACTOR, MAX_FACTOR)
        for factors in np.concatenate([even, about]):
            kept[samples._answer(factors * samples.nominal)].append(factors)
        if min(map(len, kept.values())) >= count // 2:
            break
    found = {passed: rows[: count // 2] for passed, rows in kept.items()}
    samples.factors = np.array(found[True] + found[False])
    samples.passed = np.array([True] * len(found[True]) + [False] * len(found[False]))


def _about(best: NDArray, random: np.random.Generator) -> NDArray:
    """Return candidates, (at most CANDIDATES, S), around the best factors, near and far."""
    spread = np.exp(random.uniform(np.log(NEAR), np.log(FAR), (CANDIDATES, 1)))
    drawn = best * (1.0 + spread * random.normal(size=(CANDIDATES, len(best))))
    return np.asarray(drawn[((drawn >= MIN_FACTOR) & (drawn <= MAX_FACTOR)).all(axis=1)])


def _next(
    candidates: NDArray, best: NDArray, nominal: NDArray, cheap: Any, dear: Any, may_ask_cheap: bool
) -> tuple[Any, NDArray]:
    """Return the model of the check to evaluate next, and the factors to evaluate it at."""
    gain = (best - candidates) @ nominal / nominal.sum()
    low_mean, low_deviation = _latent(cheap, candidates)
    high_mean, high_deviation = _latent(dear, _with_latent(cheap, candidates, low_mean))
    models = [(dear, high_mean, high_deviation, SURE_HIGH, COST_HIGH)]
    if may_ask_cheap:
        models.append((cheap, low_mean, low_deviation, SURE_LOW, COST_LOW))
    promised, certain = [], []
    for model, mean, deviation, sure, cost in models:
        probable = expit(mean - CONFIDENCE * deviation)
        value = np.where(probable > sure, gain * probable, -np.inf)
        promised.append((float(value.max()), model, candidates[int(value.argmax())]))
        doubt = -np.abs(mean) / (deviation**2 + 1e-9) * cost
        certain.append((float(doubt.max()), model, candidates[int(doubt.argmax())]))
    first = max(promised, key=lambda each: each[0])
    if first[0] <= 0.0:
        first = max(certain, key=lambda each: each[0])
    return first[1], first[2]


def _fitted(inputs: NDArray, passed: NDArray) -> Any:
    """Return a classifier of passing inputs with fitted hyperparameters."""
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel

    kernel = ConstantKernel(10.0, (0.1, 1e4)) * RBF(np.full(inputs.shape[1], 0.5), (0.02, 100.0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # at a bound: an input without influence
        return _classifier()(kernel, optimizer=_searched).fit(inputs, passed)


def _searched(objective: Any, start: NDArray, bounds: NDArray) -> tuple[NDArray, float]:
    """Minimise as scikit-learn does, but in a bounded number of steps."""
    from scipy.optimize import minimize

    found = minimize(objective, start, method="L-BFGS-B", jac=True, bounds=bounds, options={"maxiter": 15})
    return found.x, float(found.fun)


def _latent(model: Any, inputs: NDArray) -> tuple[NDArray, NDArray]:
    mean, variance = model.latent_mean_and_variance(inputs)
    return np.asarray(mean), np.sqrt(np.maximum(variance, 0.0))


def _with_latent(cheap: Any, factors: NDArray, mean: NDArray | None = None) -> NDArray:
    """Return the inputs of the expensive check's classifier: factors, and the mean latent value of the cheap one."""
    if mean is None:
        mean = _latent(cheap, factors)[0]
    return np.column_stack([factors, np.clip(mean, -_LATENT, _LATENT)])


def _classifier() -> Any:
    try:
        from sklearn.gaussian_process import GaussianProcessClassifier
    except ModuleNotFoundError as error:
        raise InputError(
            f"optimising times needs {error.name}", where="scikit-learn", hint="pip install 'cfplan[studies]'"
        ) from None
    return GaussianProcessClassifier
