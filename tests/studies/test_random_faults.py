"""The study of random faults: its tables count flights by faults and phases, and list the failed ones."""

from dataclasses import replace
from pathlib import Path

import pytest

from studies.random_faults import STUDY, Settings
from studies.stepped_flight import FaultFlight

WELL = FaultFlight(
    "radio:dead for 0.94 s", "stream", "none", "land", 0.1, 0.3, 0.1, 0.5, 1.2, (0.0, 0.0, 0.0), 0,
    landed=True, disarmed=True, locked=False, readable=True, reason="", planner="", path="line",
)  # fmt: skip
FLIGHTS = [
    replace(WELL, seed=1, phase="take off"),
    replace(WELL, seed=2, name="pose:flip 0.1 for 1 s + radio:dead for good + radio:dead for 1 s", to_wall=-0.2),
    replace(WELL, seed=3, disarmed=False, off_plan=0.8),
    replace(WELL, seed=4, landed=False, readable=False),
]


@pytest.fixture(scope="module")
def tables():
    return {each.name: each for each in STUDY.tables(Settings((Path("line.yaml"),)), FLIGHTS)}


def figures(table):
    return {row["group"]: [row[key] for key in ("flights", "outside", "armed", "unreadable")] for row in table.rows}


def test_flights_are_counted_by_how_many_faults_they_had_and_all_together(tables):
    assert figures(tables["all"]) == {"1 fault": [3, 0, 2, 1], "3 faults": [1, 1, 0, 0], "random faults": [4, 1, 2, 1]}
    assert (tables["all"].rows[-1]["to_wall"], tables["all"].rows[-1]["off_plan"]) == (-0.2, 0.8)


def test_a_flight_counts_once_for_each_kind_of_its_faults(tables):
    assert figures(tables["kinds"]) == {"pose:flip": [1, 1, 0, 0], "radio:dead": [4, 1, 2, 1]}


def test_phases_are_in_the_order_of_a_flight(tables):
    assert [(row["group"], row["flights"]) for row in tables["phases"].rows] == [("take off", 1), ("stream", 3)]


def test_the_flight_nearest_to_a_wall_is_first_and_every_bad_one_is_shown(tables):
    assert tables["worst"].rows[0]["seed"] == 2
    assert [(row["seed"], row["end"]) for row in tables["bad"].rows] == [
        (2, "landed, disarmed, readable record"), (3, "landed, not disarmed, readable record"),
        (4, "not landed, disarmed, not readable record"),
    ]  # fmt: skip
