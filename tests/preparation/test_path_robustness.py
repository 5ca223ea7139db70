"""A path moved a little, planned and rehearsed again; and `cfplan robustness`, which shows it."""

from pathlib import Path

import pytest

from cfplan.errors import InputError
from cfplan.geometry.path_file import load_path_file
from cfplan.preparation.path_robustness import path_robustness
from cfplan.safety.limits_file import load_limits

REPOSITORY = Path(__file__).parents[2]
LINE = REPOSITORY / "flights" / "line.yaml"


def test_a_flight_hardly_changes_where_its_path_hardly_changes():
    path_file, limits = load_path_file(LINE), load_limits(REPOSITORY / "safety.yaml")
    found = path_robustness(path_file, limits, scales=(1e-4, 0.02), draws=2)
    little, more = found.scales
    assert little.certified == little.flown == little.plans == 2
    assert abs(little.longer_most) < 0.01
    assert little.faster < more.faster
    again = path_robustness(path_file, limits, scales=(1e-4,), draws=1)
    assert again.plans[0] == found.plans[0]


@pytest.mark.parametrize("wrong", [{"draws": 0}, {"scales": ()}, {"scales": (0.0,)}, {"scales": (float("inf"),)}])
def test_no_draws_and_no_lengths_are_refused(wrong):
    with pytest.raises(InputError, match="at least 1"):
        path_robustness(load_path_file(LINE), load_limits(REPOSITORY / "safety.yaml"), **wrong)
