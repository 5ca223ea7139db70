"""What the networks of the ablation see: the same in other units, or less of it."""

import numpy as np
import pytest

from cfplan.geometry.min_snap import min_snap
from cfplan.learning.features import REFERENCE, node_features, scaled_limits
from cfplan.safety.limit_sets import LIMIT_SETS
from studies.ablation import speed_alone, without_limits, without_scaling

PATH = min_snap([[0, 0, 1], [1.5, 1, 1.4], [1, -1.5, 0.6], [-1, 0.5, 1.2]])


@pytest.mark.parametrize("limit_set", LIMIT_SETS.values(), ids=lambda each: each.name)
def test_without_scaling_the_same_is_told_in_metres_and_seconds(limit_set):
    airframe, limits = limit_set.airframe, limit_set.limits
    scaled, plain = scaled_limits(airframe, limits), without_scaling(airframe, limits)
    assert np.exp(plain.numbers[:3]) == pytest.approx(
        [limits.acceleration, limits.angular_velocity, np.exp(scaled.numbers[2]) / scaled.time**2]
    )
    reference = [node_features(PATH, 50, known, None)[:, REFERENCE] for known in (scaled, plain)]
    assert reference[1] + np.log(scaled.time) == pytest.approx(reference[0])  # rates a second, and a unit of time
    assert plain.smoothing == pytest.approx(scaled.smoothing * scaled.time)


def test_without_limits_as_inputs_only_the_reference_tells_them_apart():
    one, other = (without_limits(each.airframe, each.limits) for each in LIMIT_SETS.values())
    np.testing.assert_array_equal(one.numbers, other.numbers)
    assert not np.allclose(one.bounds, other.bounds)


def test_the_speed_alone_tells_nothing_but_units():
    one, other = (speed_alone(each.airframe, each.limits) for each in LIMIT_SETS.values())
    np.testing.assert_array_equal(one.numbers, other.numbers)
    np.testing.assert_array_equal(one.bounds, other.bounds)
    assert one.length != other.length
