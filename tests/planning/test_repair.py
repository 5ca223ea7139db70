"""Repair: what passes stays, what does not is refined, what cannot be refined is slowed; the end is certified."""

from dataclasses import replace

import numpy as np
import pytest
from hard_paths import hard_paths

from cfplan.learning.learned import plan_learned
from cfplan.planners.expert.expert import plan_expert, refinements
from cfplan.planners.solution import Solution, Status
from cfplan.planners.task import PlanningTask
from cfplan.planning import repair as repairing
from cfplan.planning.repair import repair
from cfplan.safety.certificate import certify
from cfplan.safety.limit_sets import LIMIT_SETS
from cfplan.vehicle.trajectory import Trajectory
from studies.drawn_paths import random_path

HARDWARE = LIMIT_SETS["hardware"]
SHARP_TURNS = [
    case for (case,) in (p.values for p in hard_paths("plan")) if "random" in case.shape and case.yaw == "fixed"
]


def test_a_profile_that_passes_stays_as_it_is():
    path = random_path(1, "10x10x10")
    profile = plan_expert(PlanningTask(path, HARDWARE.airframe, HARDWARE.limits)).profile.slowed(0.9)
    repaired = repair(PlanningTask(path, HARDWARE.airframe, HARDWARE.limits), profile)
    assert repaired.trajectory.profile is profile
    assert repaired.describe() == ""


@pytest.mark.parametrize("limit_set", LIMIT_SETS)
def test_what_exceeds_limits_between_points_after_refining_is_refined_on_not_slowed(limit_set):
    between = 0
    for case in SHARP_TURNS:
        if case.limit_set == limit_set:
            profile = plan_learned(case.task).profile
            first = next(refinements(case.task, profile))
            between += first.stats["rounds"] > 0
            repaired = repair(case.task, profile)
            assert repaired.speed_factor == 1.0
            assert certify(repaired.trajectory, case.limits).passed
            assert repaired.trajectory.duration < 1.01 * Trajectory(case.path, first.profile, case.airframe).duration
    assert between > 0  # else this would test nothing


def test_the_certificate_is_that_of_the_trajectory():
    path = random_path(3, "4.5x8x2")
    profile = plan_learned(PlanningTask(path, HARDWARE.airframe, HARDWARE.limits)).profile
    repaired = repair(PlanningTask(path, HARDWARE.airframe, HARDWARE.limits), profile)
    assert repaired.certificate == certify(repaired.trajectory, HARDWARE.limits)
    assert repaired.before == pytest.approx(Trajectory(path, profile, HARDWARE.airframe).duration, rel=1e-6)


def never_refined(monkeypatch):
    failed = Solution(Status.NOT_CONVERGED, None, "refining: no step improves the solution")
    monkeypatch.setattr(repairing, "refinements", lambda *_: [failed])


def test_what_cannot_be_refined_is_lowered_where_it_must_be_and_says_why(monkeypatch):
    never_refined(monkeypatch)
    path = random_path(1, "10x10x10")
    task = PlanningTask(path, HARDWARE.airframe, HARDWARE.limits)
    profile = plan_learned(task).profile
    repaired = repair(task, profile)
    assert repaired.speed_factor == 1.0
    assert 0.0 < repaired.slower < 1.0
    assert certify(repaired.trajectory, HARDWARE.limits).passed
    assert "no step improves the solution" in repaired.describe()
    assert repaired.trajectory.duration < repairing.slow(task, profile).trajectory.duration


def test_what_cannot_be_lowered_either_is_slowed_as_a_whole_and_says_why(monkeypatch):
    never_refined(monkeypatch)
    monkeypatch.setattr(repairing, "lower_locally", lambda task, profile: profile)
    path = random_path(1, "10x10x10")
    profile = plan_learned(PlanningTask(path, HARDWARE.airframe, HARDWARE.limits)).profile
    repaired = repair(PlanningTask(path, HARDWARE.airframe, HARDWARE.limits), profile)
    assert repaired.speed_factor < 1.0
    assert repaired.certificate.passed
    assert "no step improves the solution" in repaired.describe()


def test_limits_that_the_profile_never_knew_are_kept_too():
    path = random_path(5, "10x10x10")
    profile = plan_expert(PlanningTask(path, HARDWARE.airframe, HARDWARE.limits)).profile
    tighter = replace(HARDWARE.limits, speed=1.2, tilt=np.radians(20))
    repaired = repair(PlanningTask(path, HARDWARE.airframe, tighter), profile)
    assert certify(repaired.trajectory, tighter).passed
    assert repaired.speed_factor == 1.0
