"""Gradients of min-snap paths are those that moving each time and each point gives."""

import numpy as np
import pytest

from cfplan.geometry.min_snap import least_snap, pieces_through
from cfplan.geometry.min_snap_gradient import gradient_by_times_and_points
from cfplan.geometry.path import Path
from cfplan.geometry.polynomials import shifted

MOVED = 1e-6


def begun_in_motion(start, points, times):
    """Return the path of least snap that begins with these γ', γ'', γ''' and ends at rest."""
    table = pieces_through(points, times, start=start, rest_end=True).copy()
    table[-1] = shifted(table[-1:], times[-1:])[0]
    return Path(np.concatenate([[0.0], np.cumsum(times)]), table)


@pytest.mark.parametrize("moving", [False, True], ids=["from rest", "in motion"])
@pytest.mark.parametrize("count", [2, 3, 7])
def test_the_gradient_is_that_of_central_differences(count, moving):
    random = np.random.default_rng(count)
    points, times = random.uniform(-2.0, 2.0, (count, 3)), random.uniform(0.5, 2.0, count - 1)
    s = np.sort(random.uniform(0.0, times.sum() - 0.01, 30))
    by_path = random.normal(size=(5, 3, len(s)))
    start = random.normal(size=(5, 3))

    def value(points, times):
        path = begun_in_motion(start[1:4], points, times) if moving else least_snap(points, times)
        return sum(float((path(s, order).T * by_path[order]).sum()) for order in range(5))

    def difference(move, of):
        return (value(*of(move)) - value(*of(-move))) / (2.0 * MOVED)

    given = (start[1:4],) if moving else ()
    by_times, by_points = gradient_by_times_and_points(points, times, s, by_path, *given)
    moves = MOVED * np.eye(count - 1)
    expected = [difference(move, lambda move: (points, times + move)) for move in moves]
    np.testing.assert_allclose(by_times, expected, rtol=1e-5, atol=1e-4)
    moves = MOVED * np.eye(3 * count).reshape(-1, count, 3)
    expected = [difference(move, lambda move: (points + move, times)) for move in moves]
    np.testing.assert_allclose(by_points.ravel(), expected, rtol=1e-5, atol=1e-4)
