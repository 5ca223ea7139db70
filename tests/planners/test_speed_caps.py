"""Every planner keeps speed caps: what it answers, once repaired, is certified against them and loses no more time."""

from dataclasses import replace

import numpy as np
import pytest

from cfplan.errors import InputError
from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.yaw import YawMode
from cfplan.planners.baselines.convex import plan_convex
from cfplan.planners.baselines.min_snap import plan_min_snap
from cfplan.planners.baselines.toppquad import plan_toppquad
from cfplan.planners.expert.expert import plan_expert, refine
from cfplan.planners.expert.tuning import WindowSize
from cfplan.planners.solution import Status
from cfplan.planners.task import PlanningTask
from cfplan.safety.certificate import CAPPED_SPEED, certify
from cfplan.safety.limit_sets import LIMIT_SETS
from cfplan.safety.speed_caps import SpeedCaps
from cfplan.vehicle.profile import BoundaryState
from cfplan.vehicle.trajectory import Trajectory

HARDWARE = LIMIT_SETS["hardware"]
PATH = min_snap([[-2, -1, 0.8], [0, 1.5, 1.3], [1.5, -1.5, 0.9], [2, 1, 1.2]])
TASK = PlanningTask(PATH, HARDWARE.airframe, HARDWARE.limits)
# A dip to 0.7 m/s about a third of the way.
GRID = np.linspace(0.0, PATH.end, 81)
DIP = SpeedCaps.of(GRID, 2.0 - 1.3 * np.exp(-(((GRID - PATH.end / 3) / 0.6) ** 2)))
CAPPED = replace(TASK, speed_caps=DIP)


def flown(task, solution) -> Trajectory:
    assert solution.status is Status.SOLVED, solution.reason
    return Trajectory(task.path, solution.profile, task.airframe)


def share(trajectory, caps=DIP) -> float:
    return certify(trajectory, HARDWARE.limits, caps=caps).margins[-1].share


@pytest.mark.parametrize("yaw", YawMode)
def test_the_expert_uses_a_cap_to_the_full_and_loses_time_only_there(yaw):
    free = flown(TASK, plan_expert(replace(TASK, yaw=yaw)))
    capped = flown(CAPPED, plan_expert(replace(CAPPED, yaw=yaw)))
    certificate = certify(capped, HARDWARE.limits, caps=DIP)
    assert certificate.passed
    assert certificate.margins[-1].name == CAPPED_SPEED
    assert certificate.margins[-1].share > 0.99
    away = np.array([0.9, 1.0]) * PATH.end  # far behind the dip both fly alike
    assert np.diff(capped.time_at(away)) == pytest.approx(np.diff(free.time_at(away)), rel=2e-3)
    assert capped.duration > free.duration + 0.1


@pytest.mark.parametrize("cap", [0.8, 1.3])
def test_one_cap_all_along_is_as_a_lower_limit_on_speed(cap):
    lower = replace(TASK, limits=replace(HARDWARE.limits, speed=cap))
    capped = replace(TASK, speed_caps=SpeedCaps((0.0,), (cap,)))
    assert flown(capped, plan_expert(capped)).duration == pytest.approx(
        flown(lower, plan_expert(lower)).duration, rel=2e-3
    )


def test_a_path_planned_by_windows_keeps_its_caps_across_joints():
    long = min_snap([[1.8 * np.cos(k), 3.5 * np.sin(0.7 * k), 1.0 + 0.4 * np.sin(k / 2)] for k in range(20)])
    s = np.linspace(0.0, long.end, 401)  # the grid
    caps = SpeedCaps.of(s, 1.2 + 0.6 * np.sin(3.0 * s))
    task = PlanningTask(long, HARDWARE.airframe, HARDWARE.limits, nodes=400, speed_caps=caps)
    solution = plan_expert(task, window=WindowSize(kept=96, ahead=24))
    assert len(solution.joints) > 2
    assert certify(flown(task, solution), HARDWARE.limits, caps=caps).passed
    refined = refine(task, solution.profile.slowed(0.9), window=WindowSize(kept=96, ahead=24))
    assert certify(flown(task, refined), HARDWARE.limits, caps=caps).passed


def test_refining_from_the_profile_without_caps_ends_as_planning_with_them():
    free = plan_expert(TASK).profile
    assert share(flown(TASK, plan_expert(TASK))) > 1.5  # it knew nothing of them
    refined = flown(CAPPED, refine(CAPPED, free))
    assert certify(refined, HARDWARE.limits, caps=DIP).passed
    assert refined.duration == pytest.approx(flown(CAPPED, plan_expert(CAPPED)).duration, rel=5e-3)


@pytest.mark.parametrize(
    ("planner", "over"),
    [(plan_convex, 0.1), (plan_toppquad, 0.15), (plan_min_snap, 0.0)],
    ids=["convex", "toppquad", "minsnap"],
)
def test_baselines_keep_caps_as_nearly_as_they_keep_limits(planner, over):
    task = replace(CAPPED, nodes=60)
    assert share(flown(task, planner(replace(task, speed_caps=None)))) > 1.2 + over
    assert share(flown(task, planner(task))) <= 1.0 + over


def test_caps_off_the_path_make_no_task():
    for s in ((-0.1, 1.0), (0.0, PATH.end + 0.1)):
        with pytest.raises(InputError, match="leave the path"):
            replace(TASK, speed_caps=SpeedCaps(s, (1.0, 1.0)))


def test_a_boundary_state_faster_than_its_cap_is_refused():
    middle = PATH.part(0.4 * PATH.end, PATH.end)
    state = BoundaryState(1.0, 0.0, 0.0, 0.0, 0.0)
    speed = float(np.linalg.norm(middle(0.0, 1)))
    task = PlanningTask(middle, HARDWARE.airframe, HARDWARE.limits, start=state)
    assert task.refusal is None
    assert replace(task, speed_caps=SpeedCaps((0.0,), (1.01 * speed,))).refusal is None
    refusal = replace(task, speed_caps=SpeedCaps((0.0,), (0.9 * speed,))).refusal
    assert refusal.status is Status.BAD_BOUNDARY
    assert "the cap" in refusal.reason
