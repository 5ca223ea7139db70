"""Path: derivatives, ends, length, and the search for stops."""

import pickle

import numpy as np
import pytest

from cfplan.errors import InputError
from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.path import Path


@pytest.fixture
def path() -> Path:
    return min_snap([[0, 0, 1], [1.2, 0.4, 1.1], [1.5, -0.8, 0.7], [-0.3, -1.0, 1.2]])


@pytest.mark.parametrize("at", [0.02, 0.4, 0.99])
def test_two_parts_one_after_another_are_the_path(path, at):
    joined = path.part(0.0, at * path.end).followed_by(path.part(at * path.end, path.end))
    assert joined.end == pytest.approx(path.end)
    s = np.linspace(0.0, path.end, 400)
    for order in range(5):
        np.testing.assert_allclose(joined(s, order), path(s, order), atol=1e-9 * np.abs(path(s, order)).max())
    assert not joined(path.end, 1).any()  # exactly: it rests there


@pytest.mark.parametrize("order", range(4))
def test_each_derivative_is_the_slope_of_the_one_below(path, order):
    step = 1e-5
    s = np.linspace(0.05, path.end - 0.05, 400)
    s = s[np.abs(s[:, None] - path.breaks).min(axis=1) > 2 * step]  # what is above the fourth may step at a break
    slope = (path(s + step, order) - path(s - step, order)) / (2 * step)
    scale = np.abs(path(s, order + 1)).max()
    np.testing.assert_allclose(path(s, order + 1), slope, atol=2e-7 * scale)


def test_a_cubic_is_evaluated_as_its_textbook_says():
    rows = np.array([[[1.0, 2, 3], [1, 0, -1], [0, 2, 0], [0.5, 0, 1]]] * 2)
    path = Path(np.array([0.0, 2, 3]), rows)
    x, y, z = path(1.5)
    assert (x, y, z) == pytest.approx((1 + 1.5 + 0.5 * 1.5**3, 2 + 2 * 1.5**2, 3 - 1.5 + 1.5**3))
    assert path(2.5)[0] == pytest.approx(1 - 0.5 - 0.5 * 0.5**3)  # the last piece counts back from the end


def test_shapes_follow_s(path):
    assert path(0.5).shape == (3,)
    assert path([0.1, 0.2]).shape == (2, 3)
    assert path(np.zeros((4, 5, 6)), 4).shape == (4, 5, 6, 3)
    assert path(np.zeros(0), 2).shape == (0, 3)


def test_many_s_at_once_are_what_they_are_one_by_one(path):
    s = np.linspace(0, path.end, 57)
    for order in range(5):
        np.testing.assert_array_equal(path(s, order), [path(one, order) for one in s])


def test_beyond_its_ends_a_path_stays_where_it_ends(path):
    np.testing.assert_array_equal(path([-1.0, path.end + 1.0]), path([0.0, path.end]))
    assert not path([-1.0, path.end + 1.0], 1).any()


def test_a_derivative_that_is_not_kept_is_refused(path):
    with pytest.raises(ValueError, match="order 0 to 4"):
        path(0.0, 6)


def test_the_length_is_that_of_a_fine_polygon(path):
    polygon = np.linalg.norm(np.diff(path(np.linspace(0, path.end, 200_001)), axis=0), axis=1).sum()
    assert path.length == pytest.approx(polygon, rel=1e-6)


def test_the_length_of_a_line_is_its_length():
    assert min_snap([[0, 0, 1], [3, 4, 1]]).length == pytest.approx(5.0, abs=1e-12)


def test_placing_turns_and_moves(path):
    placed = path.placed([1, 2, 3], np.pi / 2)
    s = np.linspace(0, path.end, 20)
    x, y, z = path(s).T
    np.testing.assert_allclose(placed(s), np.column_stack([1 - y, 2 + x, 3 + z]), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(placed(s, 3), axis=1), np.linalg.norm(path(s, 3), axis=1), atol=1e-9)


def test_a_path_travels_between_processes(path):
    copy = pickle.loads(pickle.dumps(path))
    np.testing.assert_array_equal(copy(1.0, 3), path(1.0, 3))
    assert copy.end == path.end


def test_a_path_cannot_be_changed(path):
    with pytest.raises(ValueError, match="read-only"):
        path.coefficients[0, 0, 0] = 1.0


@pytest.mark.parametrize(
    ("breaks", "shape"),
    [([0.0, 1.0], (2, 8, 3)), ([0.0, 1.0, 1.0], (2, 8, 3)), ([1.0, 2.0], (1, 8, 3)), ([0.0, np.nan], (1, 8, 3))],
)
def test_breaks_that_do_not_fit_are_refused(breaks, shape):
    with pytest.raises(InputError):
        Path(np.array(breaks), np.ones(shape))


def test_coefficients_that_are_not_finite_are_refused():
    with pytest.raises(InputError, match="finite"):
        Path(np.array([0.0, 1.0]), np.full((1, 8, 3), np.inf))


def test_a_good_path_passes_the_check(path):
    path.check()


@pytest.mark.parametrize("sideways", [0.0, 0.7])
def test_there_and_back_is_a_stop_at_the_turning_point(sideways):
    with pytest.raises(InputError, match=r"stops between its ends.*position \(1\.000, "):
        min_snap([[0, 0, 1], [1, sideways, 1], [0, 0, 1]]).check()


def test_a_turn_with_room_is_no_stop():
    min_snap([[0, 0, 1], [1, 0.3, 1], [0, 0.6, 1]]).check()


def test_a_cusp_is_found_wherever_it_lies():
    # (t², t³) has its cusp at t = 0, here put at s = 0.3777, well between samples
    t0 = 0.3777
    polynomial = np.zeros((1, 4, 3))
    polynomial[0, :, 0] = [0, 0, 1, 0]
    polynomial[0, :, 1] = [0, 0, 0, 1]
    shift = np.polynomial.Polynomial([1 - t0, 1.0])  # the last piece counts from its right end
    for axis, power in ((0, 2), (1, 3)):
        polynomial[0, : power + 1, axis] = (shift**power).coef
    with pytest.raises(InputError, match=r"stops between its ends.* s = 0\.378"):
        Path(np.array([0.0, 1.0]), polynomial).check()


def test_a_piece_without_length_is_named(path):
    breaks = np.array([0.0, 1.0, 2.0, 3.0])
    rows = np.zeros((3, 2, 3))
    rows[0, :, 0] = [0, 1]
    rows[1, 0, 0] = 1
    rows[2, :, 0] = [2, 1]
    with pytest.raises(InputError, match=r"here\.yaml:3: a piece has no length at s = 1\.000"):
        Path(breaks, rows).check("here.yaml:3")


def test_all_derivatives_in_one_pass_are_those_one_by_one():
    path = min_snap([[0, 0, 1], [1, 2, 1.5], [3, 1, 0.7], [2, -1, 1]])
    s = np.random.default_rng(0).uniform(-0.5, path.end + 0.5, 300)  # beyond the ends too, and in no order
    found = path.derivatives(s)
    for order in range(5):
        np.testing.assert_allclose(found[order], path(s, order).T, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("low", "high"), [(0.0, 0.3), (0.2, 0.9), (0.5, 1.0), (0.0, 1.0)])
def test_a_part_of_a_path_is_that_part(low, high):
    path = min_snap([[0, 0, 1], [1, 2, 1.5], [3, 1, 0.7], [2, -1, 1]])
    low, high = low * path.end, high * path.end
    part = path.part(low, high)
    s = np.linspace(0.0, high - low, 101)
    assert part.end == pytest.approx(high - low)
    for order in range(5):
        np.testing.assert_allclose(part(s, order), path(low + s, order), rtol=1e-7, atol=1e-8)
    assert np.linalg.norm(part(0.0, 1)) == pytest.approx(np.linalg.norm(path(low, 1)), abs=1e-12)
    if high == path.end:
        assert not part(part.end, 1).any()  # a rest stays exact


def test_a_part_may_end_a_rounding_error_behind_the_path():
    path = min_snap([[0, 0, 1], [1, 2, 1.5], [3, 1, 0.7], [2, -1, 1]])
    part = path.part(0.4 * path.end, np.nextafter(path.end, np.inf))
    np.testing.assert_allclose(part(part.end), path(path.end), atol=1e-12)
    assert not part(part.end, 1).any()


def test_coefficients_whose_derivatives_are_no_numbers_are_refused():
    with pytest.raises(InputError, match="too large") as error:
        Path(np.array([0.0, 1.0, 2.0]), np.full((2, 8, 3), 1e308))
    assert error.value.hint
