"""Guides lie on the straight lines beside their points, and keep a path of least snap near those."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from cfplan.geometry.guides import with_guides
from cfplan.geometry.min_snap import centripetal_times, min_snap

POINTS = np.array([[0.0, 0.0, 1.0], [2.0, 0.0, 1.0], [2.0, 2.0, 1.2], [0.3, 2.0, 1.0]])


def off_the_lines(path):
    """How far a path is from the straight lines between the points, at most."""
    places = path(np.linspace(0.0, path.end, 500))
    distances = []
    for begin, end in pairwise(POINTS):
        line = end - begin
        along = np.clip((places - begin) @ line / (line @ line), 0.0, 1.0)
        distances.append(np.linalg.norm(places - begin - along[:, None] * line, axis=1))
    return np.min(distances, axis=0).max()


@pytest.mark.parametrize("first_too", [True, False])
def test_guides_lie_on_the_lines_and_points_stay(first_too):
    guided, rows = with_guides(POINTS, 0.3, first_too=first_too)
    np.testing.assert_array_equal(guided[rows], POINTS)
    assert len(guided) == 3 * len(POINTS) - 2 - (not first_too)
    assert np.allclose(guided[-2], POINTS[-1] + [0.3, 0.0, 0.2 * 0.3 / np.hypot(1.7, 0.2)], atol=0.01)
    assert np.linalg.norm(guided[rows[1] + 1] - POINTS[1]) == pytest.approx(0.3)


def test_on_a_short_line_they_lie_at_its_thirds():
    guided, rows = with_guides([[0, 0, 1], [0.3, 0, 1]], 0.5)
    np.testing.assert_allclose(guided[:, 0], [0.0, 0.1, 0.2, 0.3])
    assert rows.tolist() == [0, 3]


def test_with_guides_a_path_swings_out_far_less():
    swing = off_the_lines(min_snap(POINTS, times=centripetal_times(POINTS)))
    for away in (0.15, 0.3):
        guided, _ = with_guides(POINTS, away)
        assert off_the_lines(min_snap(guided, times=centripetal_times(guided))) < 0.5 * swing


COORDINATE = st.floats(-3.0, 3.0)
POINT = st.tuples(COORDINATE, COORDINATE, COORDINATE)


def angle_at(points, row):
    """The angle between the directions from a point to the one before and the one behind it, rad."""
    one, other = points[row - 1] - points[row], points[row + 1] - points[row]
    return math.atan2(np.linalg.norm(np.cross(one, other)), one @ other)


@pytest.mark.parametrize(
    "end", [[-1.0, 0.0, 1.0], [-1.0, 0.05, 1.0], [-1.0, 0.0, 1.04]], ids=["back", "back aside", "back upwards"]
)
def test_where_the_lines_turn_back_guides_lie_apart_and_the_path_does_not_stop_there(end):
    points = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], end])
    for away in (0.1, 0.3):
        guided, rows = with_guides(points, away)
        assert angle_at(guided, rows[1]) == pytest.approx(math.radians(40.0))
        path = min_snap(guided, times=centripetal_times(guided))
        path.check()
        assert np.linalg.norm(path(np.linspace(0.0, path.end, 2000), 1), axis=1)[100:-100].min() > 0.05


def test_straight_back_it_turns_at_the_same_height_unless_it_flies_up_and_down():
    guided, _ = with_guides([[0.0, 0.0, 1.0], [1.0, 0.5, 1.0], [0.0, 0.0, 1.0]], 0.3)
    np.testing.assert_allclose(guided[:, 2], 1.0)
    upwards, rows = with_guides([[0.0, 0.0, 0.6], [0.0, 0.0, 1.6], [0.0, 0.0, 0.8]], 0.3)
    assert angle_at(upwards, rows[1]) == pytest.approx(math.radians(40.0))


@given(one=POINT, turn=POINT, other=POINT)
def test_guides_of_any_points_are_as_far_off_as_asked_for_and_never_on_one_another(one, turn, other):
    points = np.array([one, turn, other])
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assume(lengths.min() > 0.05)  # waypoints are farther apart
    guided, rows = with_guides(points, 0.2)
    np.testing.assert_array_equal(guided[rows], points)
    for row, length in ((rows[1] - 1, lengths[0]), (rows[1] + 1, lengths[1])):
        assert np.linalg.norm(guided[row] - guided[rows[1]]) == pytest.approx(min(0.2, length / 3.0))
    lines = angle_at(points, 1)
    assert angle_at(guided, rows[1]) == pytest.approx(max(lines, math.radians(40.0)), abs=1e-6)
