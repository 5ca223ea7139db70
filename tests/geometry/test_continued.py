"""Continued paths: against the path that they continue, and what they promise of their start, joints and end."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cfplan.errors import InputError
from cfplan.geometry.continued import BLEND, continued_min_snap
from cfplan.geometry.min_snap import centripetal_times, min_snap
from cfplan.geometry.path import Path

WAYPOINTS = np.array([[0, 0, 1], [1.2, 0.4, 1.1], [1.5, -0.8, 0.7], [-0.3, -1.0, 1.2], [-1.0, 0.9, 0.9]])
number = st.floats(-2.0, 2.0)
vector = st.tuples(number, number, number)


def state(path: Path, s: float) -> np.ndarray:
    return np.array([path(s, order) for order in range(5)])


def assert_four_times_differentiable(path: Path) -> None:
    inner = path.breaks[1:-1]
    for order in range(5):
        scale = max(np.abs(path(path.breaks, order)).max(), 1.0)
        np.testing.assert_allclose(path(inner - 1e-13 * path.end, order), path(inner, order), atol=1e-6 * scale)


@pytest.mark.parametrize("s", [0.2, 1.3, 2.9, 4.0, 5.5])
def test_from_a_state_of_a_path_of_least_snap_with_its_times_it_is_the_rest_of_it(s):
    whole = min_snap(WAYPOINTS)
    ahead = int(np.searchsorted(whole.breaks, s))
    rest = continued_min_snap(
        state(whole, s), WAYPOINTS[ahead:], [b - a for a, b in pairwise([s, *whole.breaks[ahead:]])]
    )
    assert rest.end == pytest.approx(whole.end - s)
    there = np.linspace(0.0, rest.end, 300)
    for order in range(5):
        np.testing.assert_allclose(rest(there, order), whole(s + there, order), atol=1e-6)


@settings(max_examples=60, deadline=None)
@given(st.tuples(vector, vector, vector, vector, vector), st.lists(vector, min_size=1, max_size=5))
def test_it_begins_as_given_passes_its_waypoints_and_ends_at_rest(start, waypoints):
    points = np.array([start[0], *waypoints])
    if np.linalg.norm(np.diff(points, axis=0), axis=1).min() < 0.05:
        return
    path = continued_min_snap(start, waypoints)
    for order in range(5):
        np.testing.assert_allclose(path(0.0, order), start[order], rtol=0, atol=1e-12)
    reached = np.cumsum(centripetal_times(points))
    np.testing.assert_allclose(path(reached), points[1:], atol=1e-9)
    for order in (1, 2, 3):
        assert not path(path.end, order).any()
    assert_four_times_differentiable(path)


def test_what_is_missing_of_the_fourth_derivative_moves_the_curve_little_and_not_for_long():
    whole = min_snap(WAYPOINTS)
    given_state = state(whole, 2.0)
    other = given_state.copy()
    other[4] += [20.0, -20.0, 20.0]
    paths = [continued_min_snap(each, WAYPOINTS[3:]) for each in (given_state, other)]
    s = np.linspace(0.0, paths[0].end, 500)
    apart = np.linalg.norm(paths[0](s) - paths[1](s), axis=1)
    assert apart.max() < 1e-3
    assert not apart[s > BLEND].any()


STATE = np.zeros((5, 3))


@pytest.mark.parametrize(
    ("start", "waypoints", "times", "message"),
    [
        (STATE[:4], [[1, 0, 1]], None, "continues from finite"),
        (np.full((5, 3), np.nan), [[1, 0, 1]], None, "continues from finite"),
        (STATE, [], None, "each waypoint must be x, y, z"),
        (STATE, [[1, 0]], None, "each waypoint must be x, y, z"),
        (STATE, [[0.001, 0, 0]], None, "begins 0.0010 m from its first waypoint"),
        (STATE, [[np.nan, 0, 0]], None, "not a number|first waypoint"),
        (STATE, [[1, 0, 1], [1, 0, 1]], None, "waypoints 1 and 2"),
        (STATE, [[1, 0, 1], [1, np.inf, 1]], None, "coordinates must be numbers"),
        (STATE, [[1, 0, 1]], [1.0, 1.0], "as many positive times"),
        (STATE, [[1, 0, 1]], [0.0], "as many positive times"),
        (STATE, [[1, 0, 1]], [np.nan], "as many positive times"),
    ],
)
def test_what_cannot_be_continued_is_refused_in_words(start, waypoints, times, message):
    with pytest.raises(InputError, match=message) as refused:
        continued_min_snap(start, waypoints, times)
    assert refused.value.hint
    assert refused.value.where
