"""The policy: a table in which every planner has a line, and no line ends without a planner that hardly ever fails."""

import pytest

from cfplan.planning.planners import AUTO, PLANNERS
from cfplan.planning.policy import POLICIES, Found, nothing_finished

pytestmark = pytest.mark.unit


def test_every_planner_and_auto_have_a_policy():
    assert set(POLICIES) == {AUTO, *PLANNERS}


@pytest.mark.parametrize("name", PLANNERS)
def test_a_planner_that_is_asked_for_is_asked_first_and_always(name):
    (step,) = POLICIES[name]
    assert step.planners[0] == name
    assert step.when(None, ()).due


@pytest.mark.parametrize("policy", POLICIES)
def test_policies_name_known_planners_once_each_and_end_with_a_robust_one(policy):
    asked = [planner for step in POLICIES[policy] for planner in step.planners]
    assert len(set(asked)) == len(asked)
    assert set(asked) <= set(PLANNERS)
    assert asked[-1] in ("convex", "minsnap")


def test_auto_goes_on_where_nothing_but_a_profile_that_is_only_slowed_was_found():
    class Repaired:
        speed_factor, failed = 1.0, ""

    assert nothing_finished(None, [Found(Repaired, "minsnap", 100, ())]).due
    assert not nothing_finished(None, [Found(Repaired, "expert", 100, ())]).due
    assert nothing_finished(None, [Found(Repaired, "learned", 100, (), grid=0.5)]).due
