"""Paths stay inside the space less its margin and clear of obstacles, between waypoints too."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cfplan.errors import InfeasibleError
from cfplan.geometry.min_snap import min_snap
from cfplan.safety.space import FLOOR, SIDES, TOLERANCE, Box, Cylinder, Space, check_space, distances_beyond, inside

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


TABLE = Box((-0.5, -1.0, 0.0), (0.5, 1.0, 0.8), yaw=np.pi / 2, name="table")
POLE = Cylinder(1.0, 2.0, 0.1, 0.0, 2.0)
FURNISHED = Space(SPACE.low, SPACE.high, SPACE.margin, (TABLE, POLE))


def boxes():
    middle, half = st.tuples(*[st.floats(-1.5, 1.5)] * 3), st.tuples(*[st.floats(0.01, 0.8)] * 3)
    return st.builds(
        lambda m, h, yaw: Box(tuple(np.subtract(m, h).tolist()), tuple(np.add(m, h).tolist()), yaw),
        middle, half, st.floats(-4.0, 4.0),
    )  # fmt: skip


def cylinders():
    return st.builds(
        lambda x, y, radius, low, tall: Cylinder(x, y, radius, low, low + tall),
        st.floats(-1.5, 1.5), st.floats(-1.5, 1.5), st.floats(0.01, 0.8), st.floats(-1.0, 1.0), st.floats(0.02, 1.5),
    )  # fmt: skip


def within(obstacle, points):
    """Return (N,) whether points, (N, 3), are in an obstacle, straight from its definition."""
    x, y, z = points.T
    if isinstance(obstacle, Cylinder):
        round_ = (x - obstacle.x) ** 2 + (y - obstacle.y) ** 2 < obstacle.radius**2
        return round_ & (z > obstacle.low) & (z < obstacle.high)
    middle = np.add(obstacle.low, obstacle.high) / 2
    about = ((x - middle[0]) + 1j * (y - middle[1])) * np.exp(-1j * obstacle.yaw)
    own = np.stack([about.real, about.imag, z - middle[2]], axis=1) + middle
    return ((own > obstacle.low) & (own < obstacle.high)).all(axis=1)


def directions(count):
    """Return (count, 3) unit vectors all around, on a spiral, and the six along the axes."""
    k = np.arange(count) + 0.5
    z, turn = 1.0 - 2.0 * k / count, np.pi * (1.0 + 5.0**0.5) * k
    flat = np.sqrt(1.0 - z**2)
    return np.concatenate([np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1), np.eye(3), -np.eye(3)])


AROUND = directions(6000)


@settings(max_examples=60, deadline=None)
@given(boxes() | cylinders(), st.tuples(*[st.floats(-2.5, 2.5)] * 3))
def test_the_distance_from_an_obstacle_is_that_of_the_nearest_place_on_the_other_side_of_its_surface(obstacle, point):
    space = Space((-9.0, -9.0, -9.0), (9.0, 9.0, 9.0), 0.25, (obstacle,))
    beyond = space.beyond(point)
    assert beyond.shape == (SIDES + 1,)
    distance, here = 0.25 - beyond[SIDES], within(obstacle, np.array([point]))[0]
    assert (distance < 0.0) == here or abs(distance) < 1e-9
    size = abs(distance)
    # Nothing nearer than that is on the other side; a little farther something is, seen from some direction.
    near = np.array(point) + AROUND * size * 0.999
    assert (within(obstacle, near) == here).all() or size < 1e-6
    far = np.array(point) + np.concatenate([AROUND * (size + step) for step in (0.004, 0.01, 0.02)])
    assert (within(obstacle, far) != here).any() or min(size, 1.0) * 0.04 > 0.02


@settings(max_examples=60, deadline=None)
@given(boxes() | cylinders(), st.tuples(*[st.floats(-2.0, 2.0)] * 3), st.tuples(*[st.floats(0.0, 0.5)] * 3))
def test_a_box_about_a_place_is_at_most_as_far_from_an_obstacle_as_its_nearest_point(obstacle, point, half):
    space = Space((-9.0, -9.0, -9.0), (9.0, 9.0, 9.0), 0.25, (obstacle,))
    grid = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 9)] * 3), axis=-1).reshape(-1, 3)
    nearest = space.beyond(np.array(point) + grid * half)[:, SIDES].max()
    assert space.beyond(point, half)[SIDES] >= nearest - 1e-9
    if isinstance(obstacle, Cylinder) or obstacle.yaw == 0.0:
        reach = np.linalg.norm(half) / 8
        assert nearest > 0.25 or space.beyond(point, half)[SIDES] <= nearest + reach


@settings(max_examples=60, deadline=None)
@given(
    st.lists(boxes() | cylinders(), min_size=1, max_size=4),
    st.lists(st.tuples(st.floats(-1.7, 1.7), st.floats(-2.7, 2.7), st.floats(0.3, 1.7)), min_size=2, max_size=5),
)
def test_a_path_among_obstacles_is_refused_exactly_where_a_far_finer_grid_finds_it_too_near(obstacles, points):
    if np.linalg.norm(np.diff(points, axis=0), axis=1).min() < 0.02:
        return
    path = min_snap(points)  # which swings far out where points are close together
    space = Space((-999.0, -999.0, -999.0), (999.0, 999.0, 999.0), 0.1, tuple(obstacles))
    s, beyond = distances_beyond(path, space)
    fine = np.linspace(0.0, path.end, 20001)
    seen = space.beyond(path(fine)).max(axis=1)
    worst, found = seen.max(), beyond.max()
    assert found >= worst - 1e-9
    assert found <= max(worst, 0.0) + 0.02  # it says so of the walls too, which are far
    if abs(worst) > 1e-5:
        assert inside(found) == inside(worst)
        assert passes(path, space) == inside(worst)
    piece = np.clip(np.searchsorted(path.breaks, fine, side="right") - 1, 0, len(path.breaks) - 2)
    share = (fine - path.breaks[piece]) / np.diff(path.breaks)[piece] * (s.shape[1] - 1)
    before = np.clip(share.astype(int), 0, s.shape[1] - 2)
    assert (np.maximum(beyond[piece, before], beyond[piece, before + 1]) >= seen - 1e-9).all()


def passes(path, space):
    try:
        check_space(path, space)
    except InfeasibleError:
        return False
    return True


@pytest.mark.parametrize("radius", [0.05, 0.3])
@pytest.mark.parametrize(("gap", "clear"), [(0.0, True), (2e-5, True), (-2e-5, False), (-0.05, False)])
def test_a_straight_path_just_at_the_margin_of_a_pole_passes_and_one_within_is_refused(radius, gap, clear):
    space = Space(SPACE.low, SPACE.high, SPACE.margin, (Cylinder(0.0, 0.0, radius, 0.0, 2.0, "pole"),))
    aside = radius + space.margin + gap
    path = min_snap([[aside, -2.0, 1.0], [aside, 1.7, 1.0]])
    if clear:
        check_space(path, space)
    else:
        with pytest.raises(InfeasibleError, match=r"the path at s = .* the obstacle 'pole', .* m too near") as error:
            check_space(path, space)
        assert f"{-gap:.3f} m too near" in error.value.what
        assert "space.obstacles" in error.value.hint


@pytest.mark.parametrize(
    ("point", "message"),
    [
        ((0.9, 0, 0.5), r"waypoint 2, .* is 0\.100 m inside the obstacle 'table', 0\.300 m too near"),
        ((0.0, 0.6, 0.5), r"is 0\.100 m from the obstacle 'table', 0\.100 m too near with the margin of 0\.2 m"),
        ((0.0, 0.0, 0.9), r"is 0\.100 m from the obstacle 'table'"),
        ((1.0, 2.05, 1.0), r"is 0\.050 m inside obstacle 2"),
        ((1.9, 2.0, 1.0), r"is 0\.100 m from the wall x = 2 m"),
    ],
)
def test_a_waypoint_in_an_obstacle_or_within_its_margin_is_named_with_the_obstacle(point, message):
    path = min_snap([[-1.5, 0, 1], [-1.5, 1, 1]])
    with pytest.raises(InfeasibleError, match=message):
        check_space(path, FURNISHED, waypoints=[(-1.5, 0, 1), point])


def test_waypoints_above_beside_and_between_obstacles_are_fine():
    waypoints = [[0.0, 0.0, 1.2], [0.0, 1.0, 1.2], [0.5, 2.0, 1.0], [0.5, 2.7, 0.6]]
    check_space(min_snap(waypoints), FURNISHED, waypoints=waypoints)


def test_a_thousand_obstacles_say_the_same_as_each_of_them_alone():
    random = np.random.default_rng(5)
    many = tuple(
        Cylinder(*place, 0.02, 0.0, 1.0) for place in random.uniform((-2.0, -3.0), (2.0, 3.0), (1000, 2)).tolist()
    )
    path = min_snap([[-1.5, -2.0, 0.9], [1.0, 0.0, 1.1], [-1.0, 2.0, 1.3]])
    _, beyond = distances_beyond(path, Space(SPACE.low, SPACE.high, 0.05, many))
    alone = [distances_beyond(path, Space(SPACE.low, SPACE.high, 0.05, (each,)))[1].max() for each in many]
    assert beyond.max() == pytest.approx(max(alone), abs=2e-3)


@settings(max_examples=40, deadline=None)
@given(st.lists(boxes() | cylinders(), max_size=5), st.integers(0, 1000))
def test_shorter_ways_to_the_worst_of_many_positions_say_what_each_position_says(obstacles, seed):
    space = Space((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0), 0.1, tuple(obstacles))
    steps = np.random.default_rng(seed).normal(0.0, 0.02, (400, 3))
    positions = np.clip(np.cumsum(steps, axis=0), -1.7, 1.7)
    all_of_them = space.beyond(positions)
    beyond, face = space.nearest(positions)
    np.testing.assert_allclose(beyond, all_of_them.max(axis=1), atol=1e-12)
    of_face = all_of_them[np.arange(len(face)), face]  # of two faces that are as near, either may be named
    np.testing.assert_allclose(of_face, all_of_them.max(axis=1), atol=1e-12)
    worst = all_of_them.max()
    if worst > 0.0:
        assert space.farthest(positions) == pytest.approx(worst, abs=1e-12)
    else:
        assert worst - 1e-12 <= space.farthest(positions) <= 0.0
    np.testing.assert_allclose(
        space.nearest(positions, floor=False)[0], np.delete(all_of_them, FLOOR, axis=1).max(axis=1), atol=1e-12
    )
