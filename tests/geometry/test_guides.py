"""Guides lie on the straight lines beside their points, and keep a path of least snap near those."""

from itertools import pairwise

import numpy as np
import pytest

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
