"""The learned planner: the face of the others, continuous over any length, and never a profile that is no number."""

import math
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from cfplan.errors import InputError
from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.yaw import YawMode
from cfplan.learning import learned
from cfplan.learning.features import COLUMNS, REFERENCE, scaled_limits, start_features, start_logs
from cfplan.learning.learned import Query, plan_learned, predict
from cfplan.learning.windows import window_starts
from cfplan.planners.solution import Status
from cfplan.planners.task import PlanningTask
from cfplan.safety.limit_sets import LIMIT_SETS
from cfplan.vehicle.profile import BoundaryState
from cfplan.vehicle.trajectory import Trajectory

CHOSEN = LIMIT_SETS["hardware"]
PATH = min_snap([[-1, -1, 0.8], [0, 0.5, 1.2], [1, -0.5, 0.9], [1.5, 1.0, 1.4]])


def plan(model, path=PATH, **options):
    return plan_learned(PlanningTask(path, CHOSEN.airframe, CHOSEN.limits, **options), model=model)


def long_path(turns: int):
    return min_snap([[(k % 4) * 0.6, k * 0.8, 1.0 + 0.3 * (k % 3)] for k in range(turns)])


@pytest.mark.parametrize("nodes", [64, 100, 173])
def test_a_profile_is_smooth_positive_and_of_the_nodes_asked_for(model, nodes):
    solution = plan(model, nodes=nodes)
    assert solution.status is Status.SOLVED
    profile = solution.profile
    assert len(profile.s) == nodes + 1
    assert profile.s[-1] == PATH.end
    Trajectory(PATH, profile, CHOSEN.airframe)  # checks that it is finite, C² and positive
    assert solution.stats["model"] == "fallow"


def test_h_rests_where_the_path_rests(model):
    profile = plan(model).profile
    for values in (profile.dh, profile.ddh):
        assert np.all(values[[0, 1, -2, -1]] == 0.0)
    assert profile.dddh[0] == profile.dddh[-1] == 0.0


def test_a_path_shorter_than_a_window_has_a_windows_nodes(model):
    short = min_snap([[0, 0, 1], [0.3, 0, 1], [0.5, 0.1, 1]])
    profile = plan(model, short, nodes=12).profile
    assert len(profile.s) == model.window + 1
    Trajectory(short, profile, CHOSEN.airframe)


@pytest.mark.parametrize("nodes", [9, 1, -5])
def test_fewer_than_ten_nodes_are_refused(model, nodes):
    with pytest.raises(InputError, match="needs 10"):
        plan(model, nodes=nodes)


def test_no_model_is_a_named_error(monkeypatch, tmp_path):
    monkeypatch.setattr(learned, "find_model", lambda airframe, limits, folders: None)
    with pytest.raises(InputError, match="no model") as error:
        plan(None)
    assert "cfplan train" in error.value.hint


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e6])
def test_what_is_not_a_number_is_no_profile(model, bad):
    network = model.network

    def broken(inputs):
        answers = network(inputs)
        answers[0, 5, 0] = bad
        return answers

    solution = plan(replace(model, network=broken))
    assert solution.status is Status.NOT_CONVERGED
    assert solution.profile is None
    assert "fallow" in solution.reason


def test_all_windows_of_a_path_are_asked_for_at_once_and_the_first_is_told_the_start(model):
    heard = []

    def listening(inputs):
        heard.append(inputs.copy())
        return model.network(inputs)

    path, nodes = long_path(14), 200
    state = BoundaryState(h=0.8, dh=0.3, ddh=-0.2, yaw=0.2, dyaw=0.0)
    plan(replace(model, network=listening), path, nodes=nodes, start=state)
    (seen,) = heard
    asked = math.ceil(path.length / learned.SPACING)
    assert len(seen) == len(window_starts(asked, model.window)) > 3
    begins, ends, known = (seen[:, 0, COLUMNS + k].tolist() for k in range(3))
    assert (sum(begins), ends[-1], sum(ends)) == (0, 1, 1)
    assert (known[0], sum(known)) == (1, 1)
    rate, slope, bend = start_features(*start_logs(state, path.end / asked))
    units = scaled_limits(CHOSEN.airframe, CHOSEN.limits)
    reference = seen[0, 0, REFERENCE] - seen[0, 0, COLUMNS + 10]
    expected = [rate + math.log(units.time) - reference, slope, bend]
    np.testing.assert_allclose(seen[0, 0, COLUMNS + 3 : COLUMNS + 6], expected, atol=1e-4)


def test_a_grid_finer_than_the_network_needs_has_the_same_motion(model):
    path = long_path(14)
    coarse, fine = (plan(model, path, nodes=nodes).profile for nodes in (math.ceil(path.length / 0.2), 700))
    at = fine.at(coarse.s[2:-2])
    np.testing.assert_allclose(at.h, coarse.h[2:-2], rtol=0.02)
    Trajectory(path, fine, CHOSEN.airframe)


def test_many_paths_at_once_are_each_as_alone(model):
    known = scaled_limits(CHOSEN.airframe, CHOSEN.limits)
    asked = [Query(long_path(turns), known, nodes) for turns, nodes in ((4, 30), (9, 60), (5, 100))]
    together = predict(asked, model.network, model.window)
    for query, found in zip(asked, together, strict=True):
        (alone,) = predict([query], model.network, model.window)
        np.testing.assert_allclose(found.coefficients, alone.coefficients, rtol=1e-5)
        np.testing.assert_allclose(found.yaw, alone.yaw, atol=1e-5)


def test_a_start_state_is_met_exactly(model):
    state = BoundaryState(h=0.8, dh=0.3, ddh=-0.2, yaw=0.2, dyaw=0.0)
    solution = plan(model, nodes=120, start=state)
    assert solution.status is Status.SOLVED, solution.reason
    found = solution.profile.boundary(0)
    for name in ("h", "dh", "ddh", "yaw", "dyaw"):
        assert getattr(found, name) == pytest.approx(getattr(state, name), abs=1e-9)
    Trajectory(PATH, solution.profile, CHOSEN.airframe)


def test_a_boundary_state_beyond_the_limits_is_refused(model):
    solution = plan(model, start=BoundaryState(h=-1.0, dh=0.0, ddh=0.0, yaw=0.0, dyaw=0.0))
    assert solution.status is Status.BAD_BOUNDARY


@pytest.mark.parametrize("yaw_angle", [math.nan, math.inf])
def test_arguments_that_are_not_numbers_are_refused(model, yaw_angle):
    with pytest.raises(InputError):
        plan(model, yaw_angle=yaw_angle)


def test_yaw_is_held_or_follows_the_path(model):
    assert np.all(plan(model, yaw_angle=0.4).profile.yaw == 0.4)
    profile = plan(model, nodes=200, yaw=YawMode.TANGENT).profile
    middle = 100
    x, y, _ = PATH(profile.s[middle], 1)
    assert math.remainder(profile.yaw[middle] - math.atan2(y, x), 2 * math.pi) == pytest.approx(0.0, abs=0.2)


def test_free_yaw_is_the_networks_and_continuous(model):
    profile = plan(model, long_path(8), nodes=200, yaw=YawMode.FREE, yaw_angle=0.3).profile
    assert np.ptp(profile.yaw) > 0.01
    assert profile.dyaw[0] == profile.dyaw[-1] == 0.0
    before = profile.at(profile.s[1:], np.arange(200))
    np.testing.assert_allclose(before.yaw, profile.yaw[1:], atol=1e-9)
    np.testing.assert_allclose(before.dyaw, profile.dyaw[1:], atol=1e-9)


def test_limits_and_vehicle_scale_the_proposal(model):
    """In a world four times as long and twice as slow the network proposes the same motion, on any weights."""
    limits, airframe = CHOSEN.limits, CHOSEN.airframe
    larger = replace(
        limits, speed=2 * limits.speed, angular_velocity=limits.angular_velocity / 2,
        angular_acceleration=limits.angular_acceleration / 4,
    )  # fmt: skip
    vehicle = replace(
        airframe, inertia=tuple(4 * j for j in airframe.inertia), drag=tuple(d / 2 for d in airframe.drag)
    )
    path = min_snap(4.0 * PATH(PATH.breaks))
    here, there = (
        predict([Query(each, scaled_limits(*who), 100)], model.network, model.window)[0].coefficients
        for each, who in ((PATH, (airframe, limits)), (path, (vehicle, larger)))
    )
    # s is four times as long and time twice: h = (ds/dt)² is four times
    np.testing.assert_allclose(there, 4.0 * here, rtol=1e-3)


def test_work_grows_with_the_path_and_no_faster(model):
    """Counted in windows, for paths of one kind."""
    counts = []
    for nodes in (240, 2400):
        calls = []

        def counting(inputs, calls=calls):
            calls.append(inputs.shape)
            return model.network(inputs)

        predict([Query(long_path(12), scaled_limits(CHOSEN.airframe, CHOSEN.limits), nodes)], counting, model.window)
        ((windows, count, _),) = calls
        assert count == model.window + 1
        counts.append(windows)
    assert counts[1] <= 11 * counts[0]


def test_planning_imports_no_torch():
    code = (
        "import sys, cfplan, cfplan.cli, cfplan.cli.train, cfplan.learning.learned\n"
        "assert 'torch' not in sys.modules and 'matplotlib' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
