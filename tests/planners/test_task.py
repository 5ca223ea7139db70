"""A planning task is sound where it exists; what its limits exclude is an answer with a reason."""

import math
from dataclasses import replace

import pytest

from cfplan.errors import InputError
from cfplan.geometry.min_snap import min_snap
from cfplan.planners.solution import Status
from cfplan.planners.task import PlanningTask
from cfplan.safety.limit_sets import LIMIT_SETS
from cfplan.vehicle.profile import BoundaryState

pytestmark = pytest.mark.unit
HARDWARE = LIMIT_SETS["hardware"]
PATH = min_snap([[0, 0, 1], [1.2, 0.6, 1.3], [2.2, -0.3, 1.0]])
TASK = PlanningTask(PATH, HARDWARE.airframe, HARDWARE.limits)


def test_numbers_that_are_not_finite_make_no_task():
    with pytest.raises(InputError, match="yaw angle"):
        replace(TASK, yaw_angle=math.inf)
    with pytest.raises(InputError, match="the start state is not finite"):
        replace(TASK, start=BoundaryState(1.0, math.nan, 0.0, 0.0, 0.0))


def test_a_task_that_can_be_planned_is_not_refused():
    assert TASK.refusal is None


def test_limits_that_exclude_hovering_are_refused_as_infeasible():
    refusal = replace(TASK, limits=replace(HARDWARE.limits, motor_thrust_max=0.05)).refusal
    assert refusal.status is Status.INFEASIBLE
    assert refusal.profile is None
    assert "motor_thrust_max" in refusal.reason


def test_a_boundary_state_beyond_the_limits_is_refused_by_its_name():
    refusal = replace(TASK, start=BoundaryState(-1.0, 0.0, 0.0, 0.0, 0.0)).refusal
    assert refusal.status is Status.BAD_BOUNDARY
    assert refusal.reason.startswith("start: h must be positive")


def test_a_path_of_more_pieces_needs_more_nodes():
    replace(TASK, nodes=12).check_nodes()
    with pytest.raises(InputError, match="11 nodes are too few for a path of 2 pieces"):
        replace(TASK, nodes=11).check_nodes()
    long = min_snap([[0.5 * k, 0.1 * (k % 2), 1] for k in range(9)])
    with pytest.raises(InputError, match="too few") as caught:
        replace(TASK, path=long, nodes=23).check_nodes()
    assert "at least 24" in caught.value.hint
