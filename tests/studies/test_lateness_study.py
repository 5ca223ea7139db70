"""Lateness: of a sleeper and of the stream, with and without going first; who gives that up has given it up."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from cfplan.flight.telemetry import SetpointSent
from cfplan.studies import lateness
from cfplan.studies.lateness import FIRST, ORDINARY, Measured, lateness_study
from cfplan.studies.real_time import Flight

pytestmark = pytest.mark.unit
REPOSITORY = Path(__file__).parents[2]
STILL, LEVEL = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)

GIVES_UP = """
import subprocess, sys
from cfplan.studies.lateness import give_up_priority
give_up_priority()
sys.exit(subprocess.run([sys.executable, "-c",
    "import sys; from cfplan.flight.pace import may_go_first; sys.exit(may_go_first())"]).returncode)
"""


def flight(late, reason="landed"):
    sent = [SetpointSent(1 + i / 100 + each, 1 + i / 100, i, *[STILL] * 3, LEVEL, STILL) for i, each in enumerate(late)]
    return Flight(None, reason, sent=sent)


@pytest.fixture
def study(monkeypatch):
    """The study with flights that are not flown; what it gives up stays in place for the other tests."""
    given_up, flights = [], []
    monkeypatch.setattr(lateness, "give_up_priority", lambda: given_up.append(True))
    monkeypatch.setattr(lateness, "fly_in_real_time", lambda *_, **__: flights.pop(0))

    def run(*ends, permitted=True):
        monkeypatch.setattr(lateness, "may_go_first", lambda: permitted)
        flights.extend(ends)
        result = lateness_study(REPOSITORY / "flights" / "line.yaml", REPOSITORY / "safety.yaml", 0.05)
        assert given_up == [True]
        return result

    return run


def test_percentiles_are_those_of_the_setpoints():
    late = [1e-4] * 990 + [2e-3] * 10
    row = Measured.of("stream", FIRST, late)
    assert (row.count, row.above, row.max) == (1000, 10, 2e-3)
    assert row.p50 == 1e-4
    assert row.p999 == pytest.approx(2e-3)
    assert row.seconds == 10.0


def test_a_sleeper_stands_beside_each_stream_and_what_did_not_fly_is_told(study):
    result = study(flight([], "the vehicle is gone"), flight([], "too late"))
    assert [(row.what, row.priority) for row in result.rows] == [
        ("asleep", FIRST), ("stream", FIRST), ("asleep", ORDINARY), ("stream", ORDINARY),
    ]  # fmt: skip
    assert result.rows[1].reason == "the vehicle is gone"
    assert result.rows[0].count == 5
    assert all(len(row) == len(columns) for _, columns, rows in result.tables() for row in rows)
    json.dumps(result.to_dict())


def test_where_it_is_not_permitted_to_go_first_the_rest_is_measured(study):
    result = study(flight([], "too late"), permitted=False)
    assert result.rows[0].reason == "not permitted here"
    assert [row.priority for row in result.rows[1:]] == [ORDINARY, ORDINARY]


def test_after_giving_priority_up_no_child_can_have_it():
    assert subprocess.run([sys.executable, "-c", GIVES_UP], check=False, timeout=60).returncode == 0


def test_a_stream_that_ends_early_is_measured_as_far_as_it_came():
    row = replace(Measured.of("stream", ORDINARY, [1e-4] * 300), reason="poses stopped")
    assert "3 s, then poses stopped" in row.texts()
