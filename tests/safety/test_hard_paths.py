"""The certificate on hard paths: slowed until they pass, they keep every limit on a far finer grid."""

import numpy as np
import pytest
from certificate_oracle import SPACE, worst_values
from hard_paths import hard_paths

from cfplan.errors import InfeasibleError
from cfplan.safety.slowing import slow_until_certified
from cfplan.vehicle.trajectory import Trajectory

FAST = 9.0  # h of a profile that is too fast for every limit set
CASES = [case for case in hard_paths("plan") if case.values[0].yaw == "fixed"]


def has_plan(case) -> bool:
    return case.values[0].expect["plan"] in ("certified", "slowed")


def too_fast(case, make_profile) -> Trajectory:
    return Trajectory(case.path, make_profile(case.path.end, np.full(40, FAST)), case.airframe)


@pytest.mark.parametrize("case", [case for case in CASES if has_plan(case)])
def test_what_just_passes_keeps_every_limit_on_a_finer_grid(case, make_profile):
    slowed = slow_until_certified(too_fast(case, make_profile), case.limits)
    assert slowed.certificate.passed
    worst = worst_values(slowed.trajectory, SPACE, parts=3)
    assert worst["speed"] <= case.limits.speed
    assert worst["acceleration"] <= case.limits.acceleration
    assert worst["angular velocity"] <= case.limits.angular_velocity
    assert worst["angular acceleration"] <= case.limits.angular_acceleration
    assert worst["tilt"] <= case.limits.tilt
    assert worst["motor thrust, most"] <= case.limits.motor_thrust_max
    assert -worst["motor thrust, least"] >= case.limits.motor_thrust_min
    assert -worst["specific thrust, least"] >= case.limits.specific_thrust_min


@pytest.mark.parametrize("case", [case for case in CASES if case.values[0].expect.get("expert") == "infeasible"])
def test_limits_that_exclude_hovering_are_never_met(case, make_profile):
    with pytest.raises(InfeasibleError, match="hovering"):
        slow_until_certified(too_fast(case, make_profile), case.limits)
