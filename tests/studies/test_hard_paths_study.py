"""The study of hard paths: families by seeds, each planned within its budget, compared with the expert."""

from contextlib import suppress

import numpy as np
import pytest

from cfplan.errors import InputError
from cfplan.safety.limit_sets import LIMIT_SETS
from studies import hard_paths as study
from studies.adversarial_paths import FACTORS, FAMILIES, SCALED, adversarial_path
from studies.hard_paths import CERTIFIED, hard_paths
from studies.runner.machine import process_memory

USUAL = LIMIT_SETS["hardware"].limits


@pytest.mark.parametrize("seed", range(2 * len(FAMILIES)))
def test_a_seed_draws_a_path_of_its_family_or_one_that_is_refused_in_words(seed):
    drawn, again = adversarial_path(seed, USUAL), adversarial_path(seed, USUAL)
    assert drawn.family == list(FAMILIES)[seed % len(FAMILIES)]
    assert (drawn.points == again.points).all()
    assert drawn.limits == again.limits
    for name in SCALED:
        assert FACTORS[0] <= getattr(drawn.limits, name) / getattr(USUAL, name) <= FACTORS[1]
    with suppress(InputError):  # a cusp
        assert np.isfinite(drawn.path.length)


def test_paths_are_planned_within_their_budgets_and_compared(request):
    inherited = process_memory("VmRSS")  # paths are planned in branches of this process
    result = hard_paths(request.config.rootpath / "safety.yaml", paths=2, first_seed=8, compare_every=1)
    plans = [study.HardPlan(**row) for row in result.table("plans").rows]
    assert [plan.family for plan in plans] == ["vertical, tangent yaw", "2 cm"]
    for plan in plans:
        assert plan.status == CERTIFIED
        assert 0.0 < plan.seconds < plan.budget
        assert 10.0 < plan.memory < study.GOAL_MEGABYTES + inherited
        assert plan.flight / plan.expert_flight < 1.0 + study.GOAL_EXCESS
    assert [row["family"] for row in result.table("families").rows] == [*(plan.family for plan in plans), "all"]
