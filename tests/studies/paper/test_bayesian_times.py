"""Segment times by Bayesian optimisation: they pass the expensive check, and come close to a known optimum."""

import sys

import numpy as np
import pytest

from cfplan.errors import InfeasibleError, InputError
from studies.paper.bayesian_times import Budget, optimise_times, require_library

NOMINAL = np.array([2.0, 4.0])
SMALL = Budget(low=80, high=10, iterations=15, more_low=10)


def slower_than(least):
    """Return a check that passes times of at least `least` on each segment, which is therefore the optimum."""
    return lambda times: bool((times >= least).all())


def test_times_near_the_optimum_are_found_where_uniform_ones_are_far_from_it():
    least = np.array([2.0, 2.0])  # the fastest uniform timing is (2, 4)
    found = optimise_times(NOMINAL, slower_than(least), slower_than(least), budget=SMALL)
    assert found.uniform == pytest.approx(6.0, rel=1e-3)
    assert (found.times >= least).all()
    assert found.times.sum() < 4.6


def test_only_what_the_dear_check_passes_counts_where_the_cheap_one_is_too_kind():
    cheap, dear = slower_than(np.array([0.7, 0.7])), slower_than(np.array([1.5, 1.0]))
    found = optimise_times(NOMINAL, cheap, dear, budget=SMALL)
    assert dear(found.times)
    assert found.times.sum() < 0.9 * found.uniform


def test_checks_are_asked_within_the_budget_and_as_often_as_is_said():
    asked = {"low": 0, "high": 0}

    def counted(name, check):
        def ask(times):
            asked[name] += 1
            return check(times)

        return ask

    least = np.array([1.0, 1.0])
    found = optimise_times(
        NOMINAL, counted("low", slower_than(least)), counted("high", slower_than(least)), budget=SMALL
    )
    assert (found.asked_low, found.asked_high) == (asked["low"], asked["high"])
    assert found.asked_high <= SMALL.high + SMALL.iterations + 26  # the others find the fastest uniform timing


def test_the_same_seed_finds_the_same_times():
    least = np.array([1.5, 1.0])
    first, second = (optimise_times(NOMINAL, slower_than(least), slower_than(least), budget=SMALL) for _ in range(2))
    np.testing.assert_array_equal(first.times, second.times)


def test_a_motion_that_no_timing_can_fly_is_refused():
    with pytest.raises(InfeasibleError, match="no timing"):
        optimise_times(NOMINAL, lambda times: True, lambda times: False, budget=SMALL)


def test_a_missing_library_is_named_with_what_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "sklearn.gaussian_process", None)
    with pytest.raises(InputError) as caught:
        require_library()
    assert "cfplan[studies]" in caught.value.hint
