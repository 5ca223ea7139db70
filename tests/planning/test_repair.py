"""Repair: what passes stays, what does not is refined, what cannot be refined is slowed; the end is certified."""

from dataclasses import replace

import numpy as np
import pytest

from cfplan.learning.learned import plan_learned
from cfplan.planners.expert.expert import plan_expert
from cfplan.planners.expert.refine import refine
from cfplan.planners.solution import Solution, Status
from cfplan.planners.task import PlanningTask
from cfplan.planning import repair as repairing
from cfplan.planning.repair import repair
from cfplan.safety.certificate import certify
from cfplan.safety.limit_sets import LIMIT_SETS
from cfplan.studies.trials import random_path
from cfplan.vehicle.trajectory import Trajectory

HARDWARE = LIMIT_SETS["hardware"]


def test_a_profile_that_passes_stays_as_it_is():
    path = random_path(1, "10x10x10")
    profile = plan_expert(PlanningTask(path, HARDWARE.airframe, HARDWARE.limits)).profile.slowed(0.9)
    repaired = repair(PlanningTask(path, HARDWARE.airframe, HARDWARE.limits), profile)
    assert repaired.trajectory.profile is profile
    assert repaired.describe() == ""


@pytest.mark.parametrize("name", ["hardware", "simulation"])
def test_what_exceeds_limits_between_points_after_refining_is_refined_on_not_slowed(name):
    chosen = LIMIT_SETS[name]
    between = 0
    for seed in (11, 71, 99, 124):  # with sharp turns
        path = random_path(seed, "4.5x8x2")
        profile = plan_learned(PlanningTask(path, chosen.airframe, chosen.limits)).profile
        first = refine(PlanningTask(path, chosen.airframe, chosen.limits), profile, passes=lambda _: True).profile
        between += not certify(Trajectory(path, first, chosen.airframe), chosen.limits).passed
        repaired = repair(PlanningTask(path, chosen.airframe, chosen.limits), profile)
        assert repaired.speed_factor == 1.0
        assert certify(repaired.trajectory, chosen.limits).passed
        assert repaired.trajectory.duration < 1.01 * Trajectory(path, first, chosen.airframe).duration
    assert between > 0  # else this would test nothing


def test_the_certificate_is_that_of_the_trajectory():
    path = random_path(3, "4.5x8x2")
    profile = plan_learned(PlanningTask(path, HARDWARE.airframe, HARDWARE.limits)).profile
    repaired = repair(PlanningTask(path, HARDWARE.airframe, HARDWARE.limits), profile)
    assert repaired.certificate == certify(repaired.trajectory, HARDWARE.limits)
    assert repaired.before == pytest.approx(Trajectory(path, profile, HARDWARE.airframe).duration, rel=1e-6)


def test_what_cannot_be_refined_is_slowed_and_says_why(monkeypatch):
    monkeypatch.setattr(
        repairing, "refine", lambda *_, **__: Solution(Status.NOT_CONVERGED, None, "refining: no step makes it better")
    )
    path = random_path(1, "10x10x10")
    profile = plan_learned(PlanningTask(path, HARDWARE.airframe, HARDWARE.limits)).profile
    repaired = repair(PlanningTask(path, HARDWARE.airframe, HARDWARE.limits), profile)
    assert repaired.speed_factor < 1.0
    assert repaired.certificate.passed
    assert "no step makes it better" in repaired.describe()


def test_limits_that_the_profile_never_knew_are_kept_too():
    path = random_path(5, "10x10x10")
    profile = plan_expert(PlanningTask(path, HARDWARE.airframe, HARDWARE.limits)).profile
    tighter = replace(HARDWARE.limits, speed=1.2, tilt=np.radians(20))
    repaired = repair(PlanningTask(path, HARDWARE.airframe, tighter), profile)
    assert certify(repaired.trajectory, tighter).passed
    assert repaired.speed_factor == 1.0
