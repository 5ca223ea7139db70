"""The paper's Table 3: every planner on the same paths, with what the paper prints beside."""

import numpy as np
import pytest

from cfplan.errors import InputError
from cfplan.planners.expert.expert import plan_expert
from cfplan.planning.planners import PLANNERS, Finish
from cfplan.safety.certificate import certify
from cfplan.vehicle.timing import duration_of
from cfplan.vehicle.trajectory import Trajectory
from studies.paper.baselines import (
    ALLOCATION,
    BAYESIAN,
    CONVEX,
    DRAWN,
    MIN_SNAP,
    SHIPPED,
    baselines,
    random_course,
)
from studies.paper.printed import BASELINES
from studies.paper.trials import paper_task, profile_of, shipped_profile


@pytest.fixture(scope="module")
def quick():
    return baselines(paths=1, quick=True)


def test_every_planner_has_its_row_beside_the_papers(quick):
    rows = {row["planner"]: row for row in quick.table("baselines").rows}
    assert list(rows) == [
        "TOPPQuad", "expert", "LSTM", "LSTM-0.1", SHIPPED, ALLOCATION, BAYESIAN, CONVEX, MIN_SNAP,
    ]  # fmt: skip
    assert rows["TOPPQuad"]["paper_time"] == 5.687
    assert rows[ALLOCATION]["paper_failed"] == 0.28
    assert rows[BAYESIAN]["paper_seconds"] == 13609.913
    assert {name for name in rows if rows[name]["retraining"] is not None} == {"LSTM", "LSTM-0.1", ALLOCATION}


def test_all_but_those_that_allot_times_keep_to_the_path(quick):
    trials = {trial["planner"]: trial for trial in quick.table("trials").rows}
    length = random_course(60_000).path.length
    for name, trial in trials.items():
        if name not in (ALLOCATION, BAYESIAN):
            assert trial["length"] == pytest.approx(length), name
    assert trials[SHIPPED]["deviation"] < 0.05
    assert trials[SHIPPED]["violation"] == 0.0
    assert trials[MIN_SNAP]["travel_time"] > 1.2 * trials[SHIPPED]["travel_time"]
    assert trials[BAYESIAN]["travel_time"] <= 1.001 * trials[MIN_SNAP]["travel_time"]  # it begins with uniform timings
    assert trials[BAYESIAN]["deviation"] < 0.05
    assert trials["expert"]["travel_time"] == pytest.approx(trials[SHIPPED]["travel_time"], rel=0.005)


def test_what_ships_is_certified_at_the_optimum_as_the_policy_of_planning_has_it():
    path = random_course(60_000).path
    task, profile = paper_task(path), shipped_profile(path)
    assert PLANNERS["learned"].finished is Finish.REFINED
    assert certify(Trajectory(path, profile, task.airframe), task.limits).passed
    assert duration_of(profile) == pytest.approx(duration_of(profile_of(plan_expert, task)), rel=0.002)


def test_the_figure_has_waypoints_motions_and_boxes_about_the_path(quick):
    drawn = quick.table("drawn").rows
    assert [row["what"] for row in drawn] == ["waypoints", *DRAWN, "box", "box", "box"]
    course = random_course(60_000)
    np.testing.assert_allclose(drawn[0]["points"], course.waypoints, atol=1e-3)
    own = np.array(drawn[1]["points"])  # of the planner that ships: the path itself
    assert np.linalg.norm(own[:, None] - course.path(np.linspace(0, course.path.end, 2000)), axis=2).min(1).max() < 0.02
    for name, row in zip(DRAWN, drawn[1:], strict=False):
        ends = np.array(row["points"])[[0, -1]]
        np.testing.assert_allclose(ends, course.waypoints[[0, -1]], atol=2e-3, err_msg=name)


def test_what_the_paper_prints_is_consistent():
    for name, printed in BASELINES.items():
        if name != "AllocNet's kind":  # a mean of ratios is not the ratio of means; AllocNet's lengths vary the most
            assert printed.length / printed.travel_time == pytest.approx(printed.speed, rel=0.01), name


def test_no_path_is_refused():
    with pytest.raises(InputError, match="at least 1"):
        baselines(paths=0)
