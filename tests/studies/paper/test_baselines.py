"""The paper's Table 3: every planner on the same paths, beside the paper's numbers."""

import numpy as np
import pytest

from cfplan.planners.expert.expert import plan_expert
from cfplan.planning.planners import PLANNERS, Finish
from cfplan.safety.certificate import certify
from cfplan.vehicle.timing import duration_of
from cfplan.vehicle.trajectory import Trajectory
from studies.paper.baselines import (
    ALLOCATION,
    BAYESIAN,
    CHOSEN,
    CONVEX,
    DRAWN,
    MIN_SNAP,
    SHIPPED,
    STUDY,
    Settings,
    random_course,
)
from studies.paper.printed import BASELINES
from studies.paper.trials import paper_task, profile_of, shipped_profile
from studies.runner.cases import run_study


@pytest.fixture(scope="module")
def quick():
    return run_study("baselines", "studies.paper.baselines", STUDY, Settings(paths=1, quick=True))


def test_every_planner_has_its_row_beside_the_papers(quick):
    rows = {row["planner"]: row for row in quick.table("baselines").rows}
    assert list(rows) == [
        "TOPPQuad", "expert", "LSTM", "LSTM-0.1", SHIPPED, CHOSEN, ALLOCATION, BAYESIAN, CONVEX, MIN_SNAP,
    ]  # fmt: skip
    assert rows["TOPPQuad"]["paper_time"] == 5.687
    assert rows[ALLOCATION]["paper_failed"] == 0.28
    assert rows[BAYESIAN]["paper_seconds"] == 13609.913
    assert {name for name in rows if rows[name]["retraining"] is not None} == {"LSTM", "LSTM-0.1", ALLOCATION}


def test_all_but_those_that_choose_times_or_paths_keep_to_the_path(quick):
    trials = {trial.planner: trial for trial in quick.rows}
    length = random_course(60_000).path.length
    for name, trial in trials.items():
        if name not in (ALLOCATION, BAYESIAN, CHOSEN):
            assert trial.length == pytest.approx(length), name
    assert trials[CHOSEN].travel_time < trials[SHIPPED].travel_time
    assert trials[CHOSEN].deviation < 0.05
    assert trials[SHIPPED].deviation < 0.05
    assert trials[SHIPPED].violation == 0.0
    assert trials[MIN_SNAP].travel_time > 1.2 * trials[SHIPPED].travel_time
    assert trials[BAYESIAN].travel_time <= 1.001 * trials[MIN_SNAP].travel_time  # the search begins with uniform ones
    assert trials[BAYESIAN].deviation < 0.05
    assert trials["expert"].travel_time == pytest.approx(trials[SHIPPED].travel_time, rel=0.005)


def test_what_ships_is_certified_at_the_optimum_as_the_policy_of_planning_has_it():
    path = random_course(60_000).path
    task, profile = paper_task(path), shipped_profile(path)
    assert PLANNERS["learned"].finished is Finish.REFINED
    assert certify(Trajectory(path, profile, task.airframe), task.limits).passed
    assert duration_of(profile) == pytest.approx(duration_of(profile_of(plan_expert, task)), rel=0.002)


def test_the_motions_that_the_figure_draws_are_kept_from_the_first_waypoint_to_the_last(quick):
    drawn = {trial.planner: np.array(trial.points) for trial in quick.rows if trial.points}
    assert set(drawn) == set(DRAWN)
    course = random_course(60_000)
    own = drawn[SHIPPED]  # the path itself
    assert np.linalg.norm(own[:, None] - course.path(np.linspace(0, course.path.end, 2000)), axis=2).min(1).max() < 0.02
    for name, points in drawn.items():
        np.testing.assert_allclose(points[[0, -1]], course.waypoints[[0, -1]], atol=2e-3, err_msg=name)


def test_what_the_paper_prints_is_consistent():
    for name, printed in BASELINES.items():
        if name != "AllocNet's kind":  # a mean of ratios is not the ratio of means; AllocNet's lengths vary the most
            assert printed.length / printed.time == pytest.approx(printed.speed, rel=0.01), name
