"""The comparison of planners: the same paths for all, no flight faster than the bound, and failures counted."""

from dataclasses import replace

import numpy as np
import pytest

from studies.drawn_paths import LENGTH_ERROR, path_of_length, random_path
from studies.planners import STUDY, Answer, Settings, Trial, Workload, tables
from studies.runner.cases import run_study

SMALL = Settings(paths=2, planners=("expert", "learned", "convex", "minsnap"), boxes=("4.5x8x2",),
                 limits=("hardware",))  # fmt: skip


def run(settings):
    return run_study("planners", "studies.planners", STUDY, settings)


@pytest.fixture(scope="module")
def small():
    return run(SMALL)


def test_every_planner_meets_the_same_paths_and_the_same_bound(small):
    met = {name: [(t.seed, t.bound) for t in small.rows if t.planner == name] for name in SMALL.planners}
    assert all(each == met["expert"] for each in met.values())
    assert [seed for seed, _ in met["expert"]] == [20_000, 20_001]


def test_certified_flights_are_slower_than_the_bound_and_what_is_slowed_broke_a_limit(small):
    for trial in small.rows:
        assert trial.certified
        assert trial.certified_time > trial.bound
        if trial.planner in ("expert", "minsnap"):
            slowed = trial.certified_time > trial.planned_time * (1 + 1e-9)
            assert slowed == (trial.worst_usage > 1.0)


def test_proposals_are_refined_to_the_experts_flight_and_setpoints_are_rehearsed(small):
    flights = {row["planner"]: row for row in small.table("flight").rows}
    assert flights["expert"]["against_max"] == 0.0
    for name in ("learned", "convex"):
        assert flights[name]["against_max"] < 2e-3
    assert flights["minsnap"]["against_mean"] > 0.1
    assert flights["learned"]["flown"] == 2
    assert 0.0 < flights["learned"]["deviation_max"] < 0.1


def test_a_run_is_reproduced_by_its_seed_but_for_times(small):
    assert [t.certified_time for t in run(SMALL).rows] == [t.certified_time for t in small.rows]


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {"workload": Workload.LENGTHS, "lengths": (20.0, 40.0), "paths": 1},
        {"workload": Workload.DRAWN, "paths": 1, "planners": ("expert", "learned")},
        {"speeds": (0.5, 2.0), "paths": 1, "planners": ("expert",)},
    ],
)
def test_each_workload_has_its_groups(changes):
    settings = replace(SMALL, **changes)
    result = run(settings)
    groups = list(dict.fromkeys(row["group"] for row in result.table("time").rows))
    assert len(groups) == {Workload.LENGTHS: 2, Workload.DRAWN: 4, Workload.RANDOM: 2}[settings.workload]
    assert all(trial.certified for trial in result.rows)


@pytest.mark.slow
def test_hard_paths_are_answered():
    (answers,) = run(Settings(Workload.HARD, paths=1, first_seed=5)).tables
    *families, every = answers.rows
    assert len(families) == every["paths"] == 12
    assert every["certified"] + every["refused"] == 12
    assert every["failed"] == 0


def test_a_failing_planner_is_counted_with_its_reason():
    trials = [Trial("g", k, "p", 1.0, 60, Answer.REFUSED if k else Answer.FAILED, "gave up") for k in range(3)]
    time, flight = tables(SMALL, trials)
    assert flight.rows[0]["certified"] == 0
    assert np.isnan(flight.rows[0]["flight"])
    (answers,) = tables(replace(SMALL, workload=Workload.HARD), trials)
    assert (answers.rows[0]["refused"], answers.rows[0]["failed"]) == (2, 1)
    for each in (time, flight, answers):
        titles, cells = each.cells()
        assert all(len(row) == len(titles) for row in cells)


@pytest.mark.parametrize("length", [20.0, 200.0, 600.0])
def test_paths_come_in_the_length_that_was_asked_for(length):
    assert path_of_length(length, "10x10x10", 3).length == pytest.approx(length, rel=LENGTH_ERROR)


def test_random_paths_come_from_their_seed():
    np.testing.assert_array_equal(random_path(3, "10x10x10").coefficients, random_path(3, "10x10x10").coefficients)
