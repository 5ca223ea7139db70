"""Segment times by multi-fidelity Bayesian optimisation, as MFBOTrajectory finds them.

G. Ryou, E. Tal, S. Karaman, "Multi-fidelity black-box optimization for time-optimal quadrotor maneuvers" (2021). A
motion through waypoints depends on the times of its segments alone; which times can be flown is learned, by classifiers
that are Gaussian processes, from asking two checks of different cost. Each step asks the check and the times that
promise the largest gain of time, or where none does, those that the classifiers are least certain of.

What is theirs: times as factors on the fastest uniform timing of each check, half of the cheap check's samples feasible
and half not, uniform timings to begin the dear one, acquisition, thresholds and budgets. The classifier of the dear
check sees the latent value of the cheap one beside the factors. What differs: hyperparameters are fitted by
scikit-learn, with Laplace's approximation and without inducing points (classifier.py beside this file goes on from
there); there are CANDIDATES in place of 16,384; the lower confidence bound
is CONFIDENCE standard deviations below the mean.
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
LEAST, MOST = 0.1, 1.9  # factors on the nominal times that are considered
SPREAD = 0.2  # of the half of the cheap samples that are drawn about the nominal times
STEPS = 14  # of the bisection for the fastest uniform timing
CANDIDATES = 1024  # that each step chooses from
SHAPED = 300  # samples of the cheap check to which its classifier's hyperparameters are fitted
NEAR, FAR = 0.01, 0.3  # standard deviations of candidates about the best factors, drawn between
CONFIDENCE = 1.0
SURE_LOW, SURE_HIGH = 0.1, 0.4  # least probability to pass, by the lower bound, for a check to be asked for its gain
COST_LOW, COST_HIGH = 1.0, 10.0  # weights of the two checks where the least certain times are sought
_LATENT = 5.0  # at most, as an input: beyond it the cheap check is certain


@dataclass(frozen=True, slots=True)
class Budget:
    """How often the checks may be asked: the published numbers."""

    low: int = 1000  # cheap samples before the first step
    high: int = 20  # dear ones
    iterations: int = 50  # dear ones that are chosen
    more_low: int = 50  # cheap ones that are chosen


class OptimisedTimes(NamedTuple):
    """The fastest times that passed the dear check."""

    times: NDArray  # (S,) s
    uniform: float  # s in all, of the fastest uniform timing that passed it
    asked_low: int
    asked_high: int


class _Samples:
    """What one check was asked, in factors on its own nominal times, and what it answered."""

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
    """Return the fastest times found from `nominal`, (S,) s, whose ratios the uniform timings have.

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
            dear.ask(np.full(len(nominal), 1.0 + sign * step * 2.0 * (MOST - 1.0) / budget.high - (sign < 0) * 0.05))
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
    """Raise InputError where scikit-learn is not installed."""
    _classifier()


def _fastest_uniform(passes: Check, nominal: NDArray) -> float:
    """Return the least factor on all times that passes, to a part in 2^STEPS, if those that pass are the slow ones."""
    slow = next((factor for factor in 2.0 ** np.arange(-4, 8) if passes(factor * nominal)), None)
    if slow is None:
        raise InfeasibleError("no timing of this motion passes", hint="give other waypoints")
    fast = slow / 2.0
    for _ in range(STEPS):
        middle = (slow + fast) / 2.0
        slow, fast = (middle, fast) if passes(middle * nominal) else (slow, middle)
    return float(slow)


def _ask_both_kinds(samples: _Samples, count: int, random: np.random.Generator) -> None:
    """Ask until `count` answers are there, half of each kind; what is left of the commoner kind is let go."""
    size, batch = samples.nominal.size, max(count // 10, 1)
    kept: dict[bool, list[NDArray]] = {True: [], False: []}
    for _ in range(100):
        even = LEAST + (MOST - LEAST) * qmc.LatinHypercube(size, rng=random).random(batch)
        about = np.clip(random.normal(1.0, SPREAD, (batch, size)), LEAST, MOST)
        for factors in np.concatenate([even, about]):
            kept[samples._answer(factors * samples.nominal)].append(factors)
        if min(map(len, kept.values())) >= count // 2:
            break
    found = {passed: rows[: count // 2] for passed, rows in kept.items()}
    samples.factors = np.array(found[True] + found[False])
    samples.passed = np.array([True] * len(found[True]) + [False] * len(found[False]))


def _about(best: NDArray, random: np.random.Generator) -> NDArray:
    """Return candidates, (CANDIDATES, S), about the best factors, near and far."""
    spread = np.exp(random.uniform(np.log(NEAR), np.log(FAR), (CANDIDATES, 1)))
    drawn = best * (1.0 + spread * random.normal(size=(CANDIDATES, len(best))))
    return np.asarray(drawn[((drawn >= LEAST) & (drawn <= MOST)).all(axis=1)])


def _next(
    candidates: NDArray, best: NDArray, nominal: NDArray, cheap: Any, dear: Any, may_ask_cheap: bool
) -> tuple[Any, NDArray]:
    """Return the model of the check to ask next, and the factors to ask it about."""
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
    """Return a classifier of what passes, with its hyperparameters fitted."""
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel

    kernel = ConstantKernel(10.0, (0.1, 1e4)) * RBF(np.full(inputs.shape[1], 0.5), (0.02, 100.0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # of hyperparameters at their bounds: an input without say
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
    """Return what the dear check's classifier sees: the factors, and the mean latent value of the cheap one there."""
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
