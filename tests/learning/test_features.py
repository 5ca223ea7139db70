"""What networks see: the geometry of the nodes and nothing else, the same in training and in flight."""

import math

import numpy as np
import pytest

from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.path import Path
from cfplan.learning.features import (
    INPUTS,
    POSITION,
    REFERENCE,
    ROOM,
    bounds,
    coefficient_logs,
    node_features,
    rests,
    start_coefficients,
    start_features,
    window_inputs,
)
from cfplan.learning.training_set import draw, read_training_set
from cfplan.safety.limit_sets import LIMIT_SETS
from cfplan.vehicle.profile import BoundaryState

CHOSEN = LIMIT_SETS["hardware"]
BOUND = bounds(CHOSEN.airframe, CHOSEN.limits)
PATH = min_snap([[-1, -1, 0.8], [0, 0.5, 1.2], [1, -0.5, 0.9], [1.5, 1.0, 1.4]])
START = (2.0, 0.1, 0.01)


def inputs(path: Path, first: float, step: float, count: int = 20, yaw: float = 0.3) -> np.ndarray:
    table = node_features(path, first, step, count, BOUND)
    return window_inputs(table, first == 0.0, False, START if first > 0 else None, yaw, 0.01)


def test_derivatives_are_those_of_the_path_per_step():
    step, first = 0.07, 0.3
    table = node_features(PATH, first, step, 30, BOUND)
    s = first + step * np.arange(30)
    for order in range(4):
        np.testing.assert_allclose(table[:, 3 * order : 3 * order + 3], PATH(s, order) * step**order, atol=1e-12)


def test_the_last_piece_and_beyond_stay_at_the_end():
    table = node_features(PATH, PATH.end - 0.1, 0.05, 6, BOUND)
    np.testing.assert_allclose(table[2:, POSITION], np.tile(PATH(PATH.end), (4, 1)), atol=1e-9)


@pytest.mark.parametrize("first", [0.0, 0.4])
@pytest.mark.parametrize("turn", [0.7, -2.5, math.pi])
def test_place_and_heading_do_not_matter(first, turn):
    moved = PATH.placed([3.0, -7.0, 2.0], turn)
    np.testing.assert_allclose(inputs(moved, first, 0.05, yaw=0.3 + turn), inputs(PATH, first, 0.05), atol=2e-5)


def test_half_a_turn_of_the_vehicle_does_not_matter():
    np.testing.assert_allclose(inputs(PATH, 0.4, 0.05, yaw=0.3 + math.pi), inputs(PATH, 0.4, 0.05), atol=2e-5)
    assert np.abs(inputs(PATH, 0.4, 0.05, yaw=0.3 + math.pi / 2) - inputs(PATH, 0.4, 0.05)).max() > 0.1


def test_up_stays_up():
    """Turned about anything but the vertical, the same curve is another task."""
    table = PATH.coefficients[:, :, [2, 1, 0]]
    assert np.abs(inputs(Path(PATH.breaks, table), 0.4, 0.05) - inputs(PATH, 0.4, 0.05)).max() > 0.01


@pytest.mark.parametrize("first", [0.0, 0.4])
def test_the_unit_of_s_does_not_matter(first):
    """The same nodes on the same curve, run through three times as fast."""
    powers = 3.0 ** np.arange(PATH.coefficients.shape[1])
    faster = Path(PATH.breaks / 3.0, PATH.coefficients * powers[:, None])
    np.testing.assert_allclose(inputs(faster, first / 3.0, 0.05 / 3.0), inputs(PATH, first, 0.05), atol=2e-5)


def test_the_reference_is_within_every_bound_and_near_the_least():
    """Against the limits themselves: at h = reference² Δs², with h' = 0, none is exceeded."""
    step = 0.05
    table = node_features(PATH, 0.0, step, 100, BOUND)
    h = np.exp(2 * table[:, REFERENCE]) * step**2
    s = step * np.arange(100)
    sizes = [np.linalg.norm(PATH(s, order), axis=1) * h ** (order / 2) for order in (1, 2, 3, 4)]
    shares = np.array([size / limit for size, limit in zip(sizes, BOUND, strict=True)])
    assert shares.max() <= 1.0
    assert (shares ** (1 / np.array([[1], [2], [3], [4]]))).max(axis=0).min() > 0.75


def test_rest_and_flight_straight_up_have_finite_inputs():
    up = min_snap([[0, 0, 0.5], [0, 0, 2.0], [0, 0, 3.0]])
    assert rests(PATH, 0.0)
    assert rests(PATH, PATH.end)
    assert not rests(PATH, 0.5)
    for path in (PATH, up):
        found = inputs(path, 0.0, path.end / 19)
        assert found.shape == (20, INPUTS)
        assert np.isfinite(found).all()
        assert found[:, 13:17].max() <= ROOM


def test_a_start_is_told_by_the_spline_that_it_begins():
    """The first three coefficients make a cubic with the state's h, h' and h'' at the node."""
    state, step = BoundaryState(h=1.3, dh=-0.8, ddh=2.0, yaw=0.0, dyaw=0.0), 0.1
    u = start_coefficients(state, step)
    assert (u[0] + 4 * u[1] + u[2]) / 6 == pytest.approx(state.h)
    assert (u[2] - u[0]) / (2 * step) == pytest.approx(state.dh)
    assert (u[2] - 2 * u[1] + u[0]) / step**2 == pytest.approx(state.ddh)
    logs = coefficient_logs(state.h, state.dh * step, state.ddh * step**2, step)
    np.testing.assert_allclose(np.exp(2 * np.array(logs)) * step**2, u)
    rate, slope, bend = start_features(*logs)
    assert math.exp(rate) == pytest.approx(math.sqrt(u[1]) / step)
    assert math.exp(slope) == pytest.approx(math.sqrt(u[2] / u[0]))
    assert math.exp(bend) == pytest.approx(math.sqrt(u[2] * u[0]) / u[1])


def test_training_sees_what_flight_sees(tiny):
    """Windows at a path's start, from a dataset's rows and from the paths rebuilt as the planner has them."""
    training_set = read_training_set(tiny)
    one_window = {"at_start": 0.9, "at_end": 0.0, "closest": 1e9, "widest": 1e9}  # takes all of a path
    rows = np.arange(len(training_set.rows))
    batch = draw(training_set.labels, training_set.bound, rows, 30, np.random.default_rng(0), **one_window)
    for row, path in enumerate(training_set.paths):
        table = node_features(path, 0.0, path.end / 30, 31, BOUND)
        yaw = training_set.labels.yaw[row, 0, 0]
        np.testing.assert_allclose(batch.inputs[row], window_inputs(table, True, True, None, yaw), atol=1e-6)
