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
from cfplan.learning.features import REFERENCE, bounds, start_features, start_logs
from cfplan.learning.learned import plan_learned, predict
from cfplan.learning.windows import chain, kept_intervals
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
    monkeypatch.setattr(learned, "find_model", lambda airframe, limits: None)
    with pytest.raises(InputError, match="no model for") as error:
        plan(None)
    assert "cfplan train" in error.value.hint


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e6])
def test_what_is_not_a_number_is_no_profile(model, bad):
    network = model.network

    def broken(inputs):
        answers = network(inputs)
        answers[5, 0] = bad
        return answers

    solution = plan(replace(model, network=broken))
    assert solution.status is Status.NOT_CONVERGED
    assert solution.profile is None
    assert "fallow" in solution.reason


def test_each_window_begins_where_the_one_before_was_left(model):
    """What a window is told of its start is the state of the profile there."""
    heard = []

    def listening(inputs):
        heard.append(inputs[0].copy())
        return model.network(inputs)

    path = long_path(14)
    nodes = 200
    solution = plan(replace(model, network=listening), path, nodes=nodes)
    profile, step = solution.profile, path.end / nodes
    windows = list(chain(nodes, model.window, kept_intervals(model.window)))
    assert len(heard) == len(windows) > 5
    for seen, window in zip(heard[1:], windows[1:], strict=True):
        state = profile.boundary(window.first)
        rate, slope, bend = start_features(*start_logs(state, step))
        np.testing.assert_allclose(seen[20:23], [rate - seen[REFERENCE], slope, bend], atol=1e-4)


def test_a_start_state_is_met_exactly(model):
    state = BoundaryState(h=0.8, dh=0.3, ddh=-0.2, yaw=0.2, dyaw=0.0)
    solution = plan(model, nodes=120, start=state)
    assert solution.status is Status.SOLVED, solution.reason
    found = solution.profile.boundary(0)
    for name in ("h", "dh", "ddh", "yaw", "dyaw"):
        assert getattr(found, name) == pytest.approx(getattr(state, name), abs=1e-9)
    Trajectory(PATH, solution.profile, CHOSEN.airframe)


def test_an_end_state_is_met_exactly(model):
    state = BoundaryState(h=0.6, dh=0.0, ddh=0.0, yaw=0.1, dyaw=0.0)
    found = plan(model, nodes=120, end=state).profile.boundary(-1)
    assert (found.h, found.dh, found.ddh) == pytest.approx((0.6, 0.0, 0.0), abs=1e-9)
    assert found.yaw == pytest.approx(0.1)


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


def test_tighter_limits_lower_the_profile_and_looser_ones_leave_it(model):
    own = plan(model).profile
    for change, compare in (({"speed": 3.0, "tilt": 1.0}, np.equal), ({"speed": 1.2}, np.less_equal)):
        limits = replace(CHOSEN.limits, **change)
        found = plan_learned(PlanningTask(PATH, CHOSEN.airframe, limits), model=model).profile
        assert compare(found.h, own.h).all()
    speed = np.linalg.norm(PATH(found.s, 1), axis=1) * np.sqrt(found.h)
    before = np.linalg.norm(PATH(own.s, 1), axis=1) * np.sqrt(own.h)
    assert speed.max() < 0.75 * before.max()
    Trajectory(PATH, found, CHOSEN.airframe)


def test_work_grows_with_the_path_and_no_faster(model):
    """Counted in windows, for paths of one kind."""
    bound = bounds(CHOSEN.airframe, CHOSEN.limits)
    counts = []
    for nodes in (240, 2400):
        calls = []

        def counting(inputs, calls=calls):
            calls.append(len(inputs))
            return model.network(inputs)

        predict(long_path(12), counting, bound, nodes, model.window)
        assert set(calls) == {model.window + 1}
        counts.append(len(calls))
    assert counts[1] <= 11 * counts[0]


def test_planning_imports_no_torch():
    code = (
        "import sys, cfplan, cfplan.cli, cfplan.cli.train, cfplan.learning.learned\n"
        "assert 'torch' not in sys.modules and 'matplotlib' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
