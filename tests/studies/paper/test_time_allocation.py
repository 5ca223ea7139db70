"""Segment times learned from corridors: better than equal times, and able to generalise."""

import numpy as np
import pytest

from cfplan.errors import InputError
from cfplan.geometry.min_snap import min_snap
from cfplan.geometry.random_paths import random_waypoints
from studies.paper.corridors import Corridor, corridor_about, least_time, min_jerk
from studies.paper.time_allocation import (
    allotted_times,
    box_features,
    fastest_times,
    time_label,
    train_times,
)

BOX = np.array([[-5.0, -5.0, -2.5], [5.0, 5.0, 2.5]])


def corridor(seed):
    return corridor_about(min_snap(random_waypoints(seed, BOX, (4, 4))))


def test_the_fastest_times_are_no_slower_than_equal_ones():
    for seed in range(3):
        own, equal = corridor(seed), np.full(3, 1 / 3)
        assert fastest_times(own).sum() <= 1.001 * least_time(min_jerk(own, equal), equal)


def test_a_box_is_seen_the_same_whichever_way_its_axes_point():
    own = corridor(3)
    turned = Corridor(own.start, own.goal, -own.axes, -own.high, -own.low)
    np.testing.assert_allclose(box_features(turned), box_features(own), atol=1e-5)


def straight(seed):
    """Return a corridor along a line of 1 to 12 m."""
    random = np.random.default_rng(seed)
    way = random.normal(size=3)
    way *= random.uniform(1.0, 12.0) / np.linalg.norm(way)
    return corridor_about(min_snap([[0, 0, 0], way / 2, way]))


def test_it_learns_times_of_corridors_that_it_has_not_seen():
    known = [straight(seed) for seed in range(40)]
    network = train_times(known, [time_label(each) for each in known], epochs=60)
    unseen = [straight(seed) for seed in range(100, 110)]
    labels = np.log([fastest_times(each).sum() for each in unseen])
    found = np.log([allotted_times(network, each).sum() for each in unseen])
    assert np.abs(found - labels).mean() < 0.5 * np.abs(labels - labels.mean()).mean()


def test_nothing_to_learn_from_is_refused():
    with pytest.raises(InputError, match="too few"):
        train_times([straight(1), straight(2)], [time_label(straight(1)), None])
