"""Random waypoints and perturbed paths: reproducible, within their bounds."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cfplan.errors import InputError
from cfplan.geometry.min_snap import min_snap, smooth_through
from cfplan.geometry.path import Path
from cfplan.geometry.random_paths import perturbed, random_waypoints

BOX = [[-2.25, -4, 0], [2.25, 4, 2]]


@given(st.integers(0, 2**63))
@settings(max_examples=50, deadline=None)
def test_waypoints_lie_in_the_box_and_apart(seed):
    points = random_waypoints(seed, BOX)
    assert 3 <= len(points) <= 6
    assert (points >= BOX[0]).all()
    assert (points <= BOX[1]).all()
    assert np.linalg.norm(np.diff(points, axis=0), axis=1).min() >= 0.5


def test_a_seed_gives_the_same_waypoints_on_every_machine():
    expected = [[-1.035960, -3.672212, 0.033055], [1.409716, 3.302045, 1.213272], [1.032735, 0.349000, 1.870145]]
    np.testing.assert_allclose(random_waypoints(0, BOX)[:3], expected, atol=1e-6)


def test_seeds_differ_and_children_of_one_seed_too():
    first, second = np.random.SeedSequence(7).spawn(2)
    assert not np.array_equal(random_waypoints(first, BOX)[0], random_waypoints(second, BOX)[0])
    assert not np.array_equal(random_waypoints(1, BOX)[0], random_waypoints(2, BOX)[0])


def test_every_count_in_the_range_occurs():
    assert {len(random_waypoints(seed, BOX, (3, 6))) for seed in range(60)} == {3, 4, 5, 6}


@pytest.mark.parametrize(
    ("box", "counts", "message"),
    [
        ([[0, 0, 0], [0.2, 0.2, 0.2]], (3, 6), "no room for waypoints"),
        ([[1, 0, 0], [0, 1, 1]], (3, 6), "a box needs a low and a high corner"),
        ([[0, 0, np.nan], [1, 1, 1]], (3, 6), "a box needs"),
        (BOX, (1, 6), "at least two waypoints"),
        (BOX, (4, 3), "at least two waypoints"),
    ],
)
def test_what_cannot_be_drawn_is_refused(box, counts, message):
    with pytest.raises(InputError, match=message):
        random_waypoints(0, box, counts)


@given(st.integers(0, 1000), st.floats(0.0, 0.5))
@settings(max_examples=30, deadline=None)
def test_a_perturbed_path_is_nowhere_farther_than_epsilon(seed, epsilon):
    path = min_snap(random_waypoints(seed, BOX))
    s = np.linspace(0, path.end, 1001)
    distance = np.linalg.norm(perturbed(path, epsilon, seed)(s) - path(s), axis=1)
    assert distance.max() <= epsilon + 1e-12


def test_a_perturbation_uses_a_good_part_of_epsilon():
    path = min_snap(random_waypoints(3, BOX))
    s = np.linspace(0, path.end, 101)
    distances = [np.linalg.norm(perturbed(path, 0.1, seed)(s) - path(s), axis=1) for seed in range(50)]
    assert 0.03 < np.mean(distances) < 0.08
    assert np.max(distances) > 0.08


def dense(waypoints: np.ndarray) -> Path:
    path = min_snap(waypoints)
    return smooth_through(path(np.linspace(0.1, 0.9, 80) * path.end))


@pytest.mark.parametrize("make", [min_snap, dense])
def test_a_perturbed_path_is_as_smooth_as_before_and_at_rest_at_its_ends(make):
    path = perturbed(make(random_waypoints(5, BOX)), 0.1, 1)
    inner = path.breaks[1:-1]
    for order in range(5):
        largest = np.abs(path(path.breaks, order)).max()
        np.testing.assert_allclose(path(np.nextafter(inner, 0), order), path(inner, order), atol=1e-6 * largest)
    for order in (1, 2, 3):
        assert not path([0.0, path.end], order).any()


def test_the_same_seed_perturbs_the_same_way_and_zero_not_at_all():
    path = min_snap(random_waypoints(5, BOX))
    s = np.linspace(0, path.end, 50)
    np.testing.assert_array_equal(perturbed(path, 0.1, 4)(s), perturbed(path, 0.1, 4)(s))
    assert not np.allclose(perturbed(path, 0.1, 4)(s), perturbed(path, 0.1, 5)(s))
    np.testing.assert_allclose(perturbed(path, 0.0, 4)(s, 4), path(s, 4), atol=1e-9)


@pytest.mark.parametrize("epsilon", [-0.1, np.nan, np.inf])
def test_a_perturbation_must_be_a_size(epsilon):
    with pytest.raises(InputError, match="perturbation"):
        perturbed(min_snap([[0, 0, 1], [1, 0, 1]]), epsilon, 0)
