"""Refining: what is nearly right becomes the expert's, window by window on long paths."""

import itertools

import numpy as np
import pytest

from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.random_paths import random_waypoints
from cfplan.geometry.yaw import YawMode
from cfplan.planners.expert.expert import plan_expert, refine
from cfplan.planners.expert.tuning import TUNING, WindowSize
from cfplan.planners.expert.windows import windows_of
from cfplan.planners.solution import Status
from cfplan.planners.task import PlanningTask
from cfplan.safety.certificate import certify
from cfplan.safety.limit_sets import LIMIT_SETS
from cfplan.vehicle.profile_spline import h_coefficients, spline_profile
from cfplan.vehicle.trajectory import Trajectory
from cfplan.vehicle.yaw_spline import YawSpline

BOX = np.array([[-2.0, -4.0, 0.0], [2.5, 4.0, 2.0]])


def planned(limit_set: str, seed: int, nodes: int = 100, waypoints: tuple[int, int] = (3, 6)):
    """(path, limit set, the expert's profile)."""
    chosen = LIMIT_SETS[limit_set]
    path = min_snap(random_waypoints(seed, BOX, waypoints))
    task = PlanningTask(path, chosen.airframe, chosen.limits, nodes=nodes)
    return path, chosen, plan_expert(task, window=WindowSize(nodes, 0)).profile


def disturbed(profile, end, size, seed=0):
    """The profile with its speed changed by up to that share, smoothly, from place to place."""
    random = np.random.default_rng(seed)
    coefficients = h_coefficients(profile)
    waves = sum(random.normal() * np.sin(np.linspace(0, k * np.pi, len(coefficients))) for k in range(2, 9))
    return spline_profile(coefficients * (1 + size * waves / np.abs(waves).max()) ** 2, end, YawSpline.of(profile))


@pytest.mark.parametrize("limit_set", ["hardware", "simulation"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_profile_near_the_experts_becomes_as_fast_and_certified_in_fewer_steps(limit_set, seed):
    path, chosen, expert = planned(limit_set, seed)
    near = disturbed(expert, path.end, 0.03, seed)
    assert not certify(Trajectory(path, near, chosen.airframe), chosen.limits).passed
    solution = refine(PlanningTask(path, chosen.airframe, chosen.limits), near)
    assert solution.status is Status.SOLVED
    refined = Trajectory(path, solution.profile, chosen.airframe)
    assert certify(refined, chosen.limits).passed
    assert refined.duration == pytest.approx(Trajectory(path, expert, chosen.airframe).duration, rel=5e-3)
    from_afar = plan_expert(PlanningTask(path, chosen.airframe, chosen.limits, nodes=100))
    assert solution.stats["iterations"] < from_afar.stats["iterations"]


@pytest.mark.parametrize("spacing", [1.0, 0.1, 0.01])
def test_windows_cover_a_path_and_each_looks_ahead_far_enough_to_brake(spacing):
    (kept, ahead), limits = TUNING.early_window, LIMIT_SETS["hardware"].limits
    for nodes in (1, 100, kept + ahead, kept + ahead + 1, 1000):
        line = min_snap([[0, 0, 1], [nodes * spacing, 0, 1]])
        windows = windows_of(line, nodes, TUNING.early_window, limits)
        assert windows[0][0] == 0
        assert windows[-1][1:] == (nodes, nodes)
        places = line(np.linspace(0.0, line.end, nodes + 1))[:, 0]
        for (begins, left, ends), (next_begins, _, _) in itertools.pairwise(windows):
            assert left == next_begins
            assert left - begins >= kept
            assert ends - left >= ahead
            assert places[ends] - places[left] > limits.speed**2 / limits.acceleration


def test_a_long_path_by_windows_is_as_fast_as_by_the_whole_and_continuous_at_joints():
    path, chosen, expert = planned("hardware", 5, nodes=320, waypoints=(9, 9))
    task = PlanningTask(path, chosen.airframe, chosen.limits)
    solution = refine(task, disturbed(expert, path.end, 0.02), window=WindowSize(96, 32))
    assert solution.stats["windows"] == 3
    flown = Trajectory(path, solution.profile, chosen.airframe)  # refuses jumps of h, h', h'' and yaw
    assert certify(flown, chosen.limits).passed
    assert flown.duration == pytest.approx(Trajectory(path, expert, chosen.airframe).duration, rel=5e-3)


def test_a_boundary_state_is_kept():
    path, chosen, expert = planned("hardware", 4)
    first, last = 30, 80
    part, start = path.part(expert.s[first], expert.s[last]), expert.boundary(first)
    cut = spline_profile(
        h_coefficients(expert)[first : last + 3] * 0.98**2, part.end, YawSpline.of(expert).part(first, last)
    )
    found = refine(PlanningTask(part, chosen.airframe, chosen.limits, start=start), cut).profile.boundary(0)
    assert (found.h, found.dh, found.ddh) == pytest.approx((start.h, start.dh, start.ddh), rel=1e-6, abs=1e-6)


@pytest.mark.parametrize(
    ("yaw", "seed"), [(YawMode.FIXED, seed) for seed in (1, 2, 3, 4)] + [(YawMode.FREE, seed) for seed in (2, 3, 4)]
)  # turning freely on path 1, the search takes 110 steps from the profile of the expert and 79 from a disturbed one
def test_from_a_boundary_state_too_the_search_begins_at_the_given_profile(yaw, seed):
    path, chosen, expert = planned("hardware", seed)
    first, last = 30, 100
    part, start = path.part(expert.s[first], expert.s[last]), expert.boundary(first)
    near = spline_profile(h_coefficients(expert)[first : last + 3], part.end, YawSpline.of(expert).part(first, last))
    task = PlanningTask(part, chosen.airframe, chosen.limits, nodes=last - first, yaw=yaw, start=start)
    steps = [refine(task, each).stats["iterations"] for each in (near, disturbed(near, part.end, 0.8, seed))]
    assert steps[0] < 0.7 * steps[1]


def test_what_cannot_be_refined_has_a_reason():
    path, chosen, expert = planned("hardware", 2)
    rough = np.random.default_rng(3).uniform(0.01, 400.0, len(expert.s) + 2)
    rough = spline_profile(rough, path.end, YawSpline.of(expert))
    solution = refine(PlanningTask(path, chosen.airframe, chosen.limits), rough)
    if solution.profile is None:
        assert solution.status is Status.NOT_CONVERGED
        assert "refining s = " in solution.reason
    else:
        assert np.isfinite(solution.profile.h).all()
