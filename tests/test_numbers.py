"""Numbers are printed alike on all processors: none that rounds to zero has a sign; and texts are compared by parts."""

import math

import numpy as np
import pytest

from cfplan.errors import InfeasibleError
from cfplan.geometry.min_snap import min_snap
from cfplan.numbers import coordinates, shown
from cfplan.safety.certificate import Margin
from cfplan.safety.space import Space, check_space
from tests.texts import same_text

pytestmark = pytest.mark.unit


@pytest.mark.parametrize(
    ("value", "spec", "text"),
    [
        (-1e-17, ".3f", "0.000"), (-0.0, "g", "0"), (-0.0004, ".3f", "0.000"), (-0.0006, ".3f", "-0.001"),
        (-1e-9, "+.1f", "+0.0"), (0.25, "+.2%", "+25.00%"), (-1e-9, " .1f", " 0.0"), (math.nan, ".1f", "nan"),
        (0, ".1f", "0.0"), (np.float32(-0.0), ".1f", "0.0"),
    ],
)  # fmt: skip
def test_a_number_that_rounds_to_zero_has_no_sign(value, spec, text):
    assert shown(value, spec) == text


def test_coordinates_are_numbers_in_brackets():
    assert coordinates((6.0081, -1e-17, np.float64(1.0)), ".3f") == "(6.008, 0.000, 1.000)"


def test_a_path_that_leaves_the_space_is_refused_alike_on_both_sides_of_zero():
    space, said = Space((-2.0, -2.0, 0.0), (2.0, 2.0, 2.0), 0.2), set()
    for y in (-1e-12, 1e-12):
        waypoints = np.array([[0.0, y, 1.0], [3.0, y, 1.0]])
        for given in (waypoints, None):
            with pytest.raises(InfeasibleError) as refused:
                check_space(min_snap(waypoints), space, waypoints=given)
            said.add(refused.value.what)
    assert len(said) == 2
    assert not any("-0.000" in text for text in said)


def test_a_margin_that_rounds_to_zero_has_no_sign():
    margin = Margin("distance to the walls", "m", -1e-9, 0.2, 1.2, 1.0, 0.5, (0.0, 0.0, 1.0))
    assert margin.shown(margin.worst) == "0.00 m"


@pytest.mark.parametrize(
    ("said", "same"),
    [
        ("waypoint 2, (6.008, 0.000) m, within 80 %", True),
        ("waypoint 2, (6.009, -0.001) m, within 80 %", True),
        ("waypoint 2, (6.010, 0.000) m, within 80 %", False),
        ("waypoint 3, (6.008, 0.000) m, within 80 %", False),
        ("waypoint 2, (6.008, 0.000) m, within 81 %", False),
        ("waypoint 2, (6.008, 0.000) cm, within 80 %", False),
        ("waypoint 2, (6.008) m, within 80 %", False),
    ],
)
def test_texts_are_the_same_if_their_words_are_and_their_numbers_nearly(said, same):
    assert same_text(said, "waypoint 2, (6.008, 0.000) m, within 80 %") == same
