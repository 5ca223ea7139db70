"""The study of link loss: slower flights end farther inside, and the watchdog brings the vehicle down nearer."""

from pathlib import Path

import pytest

from studies.link_loss import STUDY, Settings
from studies.runner.cases import run_study

REPOSITORY = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def line():
    """Return the line's rows at two speeds."""
    settings = Settings((REPOSITORY / "flights" / "line.yaml",), speeds=(1.0, 0.3))
    return run_study("link-loss", "studies.link_loss", STUDY, settings).table("link-loss").rows


def test_a_slower_flight_ends_farther_inside(line):
    fast, slow = line
    assert slow["beyond"] < fast["beyond"] - 0.3
    assert fast["beyond"] < 0


def test_with_rates_in_its_setpoints_it_would_go_far_beyond_the_walls(line):
    fast, slow = line
    assert fast["rates_beyond"] > 1.0
    assert slow["rates_beyond"] < 0.5


def test_with_the_watchdog_it_comes_down_nearer(line):
    for row in line:
        assert row["distance"] < row["alone_distance"]
        assert row["beyond"] <= row["alone_beyond"]
