"""The study of fleets in real time: one flight to the ends of the paths, and one that is stopped."""

from pathlib import Path

import pytest

from studies.fleet_flights import STUDY, Settings
from studies.runner.cases import run_study

FLEETS = Path(__file__).parents[2] / "flights/fleets"


@pytest.mark.slow
def test_two_vehicles_begin_and_stop_together():
    settings = Settings((FLEETS / "two.yaml",), flights=2)
    (row,) = run_study("fleet-flights", "studies.fleet_flights", STUDY, settings).table("fleets").rows
    assert (row["fleet"], row["vehicles"], row["flights"], row["landed"], row["stops"]) == ("two", 2, 2, 2, 1)
    assert 0.0 <= row["start_skew"] < 0.02
    assert 0.0 <= row["stop_skew"] < 0.03
    assert 0.0 < row["deviation_mean"] <= row["deviation_max"] < 0.1
    assert row["nearest"] > 0.25
