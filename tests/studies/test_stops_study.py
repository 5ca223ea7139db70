"""The study of stops: from full speed, stops shorter than those that a request tries lean too far."""

import pytest

from studies.runner.cases import run_study
from studies.stops import STUDY, Settings


@pytest.fixture(scope="module")
def result():
    return run_study("stops", "studies.stops", STUDY, Settings(durations=(0.43, 0.54)))


def test_the_stop_that_is_flown_takes_hardly_more_way_than_the_fastest_plan_to_brake(result):
    """The distance may be 10 % longer, as stops are certified for every moment without a search."""
    [_, stop], [braking] = result.table("stops").rows, result.table("braking").rows
    assert braking["acceleration"] <= 5.0
    assert braking["turning"] <= 35.0
    for way in ("distance", "flown"):
        assert stop[way] < 1.1 * braking[way] * 2.0 / braking["speed"]
    assert stop["distance"] < stop["flown"] < stop["distance"] + 0.02  # motors lag, and the vehicle overshoots


def test_shorter_stops_from_full_speed_lean_too_far(result):
    short, flown = result.table("stops").rows
    assert not flown["refused"]
    assert flown["tilt"] < 35.0
    assert abs(flown["distance"] - 0.54) < 0.01  # as many metres as seconds at 2 m/s
    assert "tilt" in short["refused"]
    assert short["tilt"] > 40.0
