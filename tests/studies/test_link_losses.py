"""The study of link loss: slower flights end farther inside, and the watchdog brings the vehicle down nearer."""

import json
from pathlib import Path

import pytest

from studies.link_losses import link_losses

REPOSITORY = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def line():
    path = REPOSITORY / "flights" / "line.yaml"
    return link_losses([path], lambda _: REPOSITORY / "safety.yaml", speeds=(1.0, 0.3))


def test_a_slower_flight_ends_farther_inside(line):
    fast, slow = line.table("link-loss").rows
    assert slow["beyond"] < fast["beyond"] - 0.3
    assert fast["beyond"] < 0


def test_with_rates_in_its_setpoints_it_would_go_far_beyond_the_walls(line):
    fast, slow = line.table("link-loss").rows
    assert fast["rates_beyond"] > 1.0
    assert slow["rates_beyond"] < 0.5


def test_with_the_watchdog_it_comes_down_nearer(line):
    for row in line.table("link-loss").rows:
        assert row["distance"] < row["alone_distance"]
        assert row["beyond"] <= row["alone_beyond"]


def test_the_result_survives_json(line):
    (table,) = json.loads(json.dumps(line.to_json(), allow_nan=False))["tables"]
    assert [row[:2] for row in table["rows"]] == [["line", 1.0], ["line", 0.3]]
