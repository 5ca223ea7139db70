"""The expert on hard paths: certified, or honest about what it cannot do."""

import pytest
from hard_paths import hard_paths

from cfplan.errors import InputError
from cfplan.planners.expert.expert import plan_expert
from cfplan.planners.solution import Status
from cfplan.safety.certificate import certify
from cfplan.vehicle.trajectory import Trajectory

STATUSES = {status.name.lower() for status in Status}


@pytest.mark.parametrize("case", hard_paths("expert"))
def test_the_expert_answers_as_expected(case):
    expected = case.expect["expert"]
    if expected in ("certified", "solved"):
        solution = plan_expert(case.task)
        assert solution.status is Status.SOLVED, solution.reason
        certificate = certify(Trajectory(case.path, solution.profile, case.airframe), case.limits)
        assert certificate.passed == (expected == "certified")
        assert certificate.worst.share < 1.01
    elif expected in STATUSES:
        solution = plan_expert(case.task)
        assert solution.status.name.lower() == expected
        assert solution.profile is None
        assert solution.reason
    else:
        with pytest.raises(InputError, match=expected):
            plan_expert(case.task)
