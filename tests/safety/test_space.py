"""Paths stay inside the space less its margin, between waypoints too."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cfplan.errors import InfeasibleError
from cfplan.geometry.min_snap import min_snap
from cfplan.safety.space import TOLERANCE, Space, check_space

SPACE = Space(low=(-2.0, -3.0, 0.0), high=(2.0, 3.0, 2.0), margin=0.2)
coordinate = st.floats(-2.2, 2.2)


def test_a_path_inside_is_fine():
    check_space(min_snap([[0, 0, 1], [1.7, 0, 1]]), SPACE, waypoints=[[0, 0, 1], [1.7, 0, 1]])


@pytest.mark.parametrize(
    ("point", "message"),
    [
        ((2.3, 0, 1), r"waypoint 2, .* is 0\.300 m beyond the wall x = 2 m, 0\.500 m too far"),
        ((1.9, 0, 1), r"waypoint 2, .* is 0\.100 m from the wall x = 2 m, 0\.100 m too far"),
        ((0, -3.5, 1), r"0\.500 m beyond the wall y = -3 m"),
        ((0, 1, 0.05), r"0\.050 m from the floor z = 0 m, 0\.150 m too far"),
        ((0, 1, float("nan")), r"waypoint 2, \(0\.000, 1\.000, nan\)"),
    ],
)
def test_a_waypoint_outside_or_within_the_margin_is_named_with_its_distance(point, message):
    path = min_snap([[0, 0, 1], [1, 0, 1]])
    with pytest.raises(InfeasibleError, match=message) as error:
        check_space(path, SPACE, waypoints=[(0, 0, 1), point], where="flight.yaml")
    assert str(error.value).startswith("flight.yaml: waypoint 2")


def test_a_path_that_swings_out_between_its_waypoints_is_found():
    waypoints = [[1.7, -1, 1], [1.75, 0, 1], [1.7, 1, 1], [-1, 1, 1]]
    path = min_snap(waypoints)
    widest = path(np.linspace(0, path.end, 20001))[:, 0].max()
    assert widest > 1.8
    with pytest.raises(InfeasibleError, match=r"the path at s = .* from the wall x = 2 m") as error:
        check_space(path, SPACE, waypoints=waypoints)
    assert f"{widest - 1.8:.3f} m too far" in error.value.what


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(coordinate, coordinate, st.floats(0.0, 2.0)), min_size=3, max_size=5))
def test_what_is_accepted_stays_inside_on_a_far_finer_grid(points):
    if np.linalg.norm(np.diff(points, axis=0), axis=1).min() < 0.02:
        return
    path = min_snap(points)
    worst = SPACE.beyond(path(np.linspace(0, path.end, 20001))).max()
    try:
        check_space(path, SPACE)
    except InfeasibleError:
        assert worst > -0.02
    else:
        assert worst <= TOLERANCE
