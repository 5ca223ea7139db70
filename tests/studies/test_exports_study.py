"""The study of exports: a short path exported and flown on board, beside the same plans streamed."""

from pathlib import Path

import pytest

from cfplan.flight.on_board.memory_format import MEMORY_SIZE
from studies.exports import STUDY, Settings
from studies.runner.cases import run_study

REPOSITORY = Path(__file__).parents[2]
WORSE = 0.02  # m, largest excess of the deviation over that of the same plan streamed

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    through_the_floor = tmp_path_factory.mktemp("paths") / "through-the-floor.yaml"
    through_the_floor.write_text("waypoints: [[0, 0, 1], [1, 0, -1]]\n")
    settings = Settings((through_the_floor, REPOSITORY / "flights" / "line.yaml"))
    return run_study("exports", "studies.exports", STUDY, settings)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["exports", "on-board"])
def test_on_board_it_strays_little_more_than_streamed(result, name):
    (row,) = result.table(name).rows
    assert row["path"] == "line"
    assert 0.0 < row["bytes"] <= MEMORY_SIZE
    assert row["on_board"] < row["streamed"] + WORSE
    assert row["difference"] == pytest.approx(row["on_board"] - row["streamed"])


def test_polynomials_take_the_second_for_the_lead_and_what_they_are_slowed_by(result):
    (row,) = result.table("exports").rows
    assert row["duration"] == pytest.approx(row["planned"] * (1.0 + row["slowed"]) + 1.0, abs=0.05)


def test_the_flight_lands_and_is_slower_for_the_fall(result):
    (row,) = result.table("on-board").rows
    assert row["end"] == "landed"
    assert row["time_lost"] > 0.0


def test_a_path_that_cannot_be_exported_is_listed_with_its_reason_and_the_others_go_on(result):
    rows = result.table("refused").rows
    assert [(row["path"], row["what"]) for row in rows] == [
        ("through-the-floor", "exports"),
        ("through-the-floor", "on-board"),
    ]
    assert all("floor" in row["reason"] for row in rows)
