"""plan() on hard paths: a certified flight, or an error that says why there is none."""

from dataclasses import replace

import pytest
from hard_paths import hard_paths

from cfplan.errors import InfeasibleError
from cfplan.planning.plan import plan
from cfplan.safety.space import Space

SLOWED = 0.999  # by less, a plan hangs on the last digits of what the network proposes
HALL = Space(low=(-200.0, -200.0, -200.0), high=(200.0, 200.0, 200.0), margin=0.1)


def plan_of(case, limits):
    """The automatic plan for these limits, with room and battery enough for every path."""
    endless = replace(limits.battery, endurance=1e6)
    limits = replace(limits, plan=case.limits, airframe=case.airframe, space=HALL, battery=endless)
    return plan(case.path, case.airframe, limits, yaw=case.yaw)


@pytest.mark.parametrize("case", hard_paths("plan"))
def test_the_plan_is_as_expected(case, limits):
    expected = case.expect["plan"]
    if expected in ("certified", "slowed"):
        made = plan_of(case, limits)
        assert made.certificate.passed
        assert (made.repair_speed_factor < SLOWED) == (expected == "slowed")
    else:
        with pytest.raises(InfeasibleError, match=expected):
            plan_of(case, limits)
