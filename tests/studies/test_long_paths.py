"""The study of long paths: every path certified, near the expert, in memory that hardly grows."""

import json
import math

import pytest

from cfplan.errors import CfplanError, InputError
from cfplan.studies import long_paths as study
from cfplan.studies.long_paths import COLUMNS, long_paths
from cfplan.studies.result import Table

LENGTHS = (20.0, 60.0)


@pytest.fixture(scope="module")
def short():
    return long_paths(lengths=LENGTHS, paths=1, repeats=2)


def plans(result):
    return [study.LongPlan(**row) for row in result.table("plans").rows]


def shown(result, title):
    """The cells under this title."""
    titles, rows = result.tables[0].cells()
    return [row[titles.index(title)] for row in rows]


def test_flights_are_certified_and_near_the_experts(short):
    for length, plan in zip(LENGTHS, plans(short), strict=True):
        assert plan.length == pytest.approx(length, rel=0.05)
        assert plan.certified
        assert plan.worst_share <= 1.0
        assert 0.0 < plan.flight / plan.expert_flight - 1.0 < 0.01
        assert all(part > 0 for part in plan.seconds)


def test_memory_is_measured_where_linux_tells_it(short):
    for plan in plans(short):
        assert plan.peak >= plan.kept
        assert plan.peak < study.GOAL_MEGABYTES


def test_the_result_is_one_table_compared_with_its_first_row_and_survives_json(short):
    (table,) = short.tables
    assert table.cells()[0] == [column.title for column in COLUMNS if column.title]
    assert shown(short, "against the first")[0] == "1.0×"
    document = json.loads(json.dumps(short.to_json(), allow_nan=False))
    again = Table.from_json(document["details"][0])
    assert [row["length"] for row in again.rows] == [plan.length for plan in plans(short)]
    assert shown(short, "certified")[1] == "1/1"


def test_a_path_that_cannot_be_flown_is_told_with_its_reason(monkeypatch, short):
    true = study.repair

    def failing(task, *rest):
        if task.path.length > 40:
            raise CfplanError("no way")
        return true(task, *rest)

    monkeypatch.setattr(study, "repair", failing)
    result = long_paths(lengths=LENGTHS, paths=1, repeats=1)
    first, second = plans(result)
    assert first.certified
    assert second.reason == "no way"
    assert math.isnan(second.flight)
    assert shown(result, "certified")[1] == "0/1"


def test_an_interrupt_keeps_the_lengths_that_are_done(monkeypatch, short):
    true = study.path_of_length

    def stopping(length, *rest):
        if length > 40:
            raise KeyboardInterrupt
        return true(length, *rest)

    monkeypatch.setattr(study, "path_of_length", stopping)
    result = long_paths(lengths=LENGTHS, paths=1, repeats=1)
    assert result.interrupted
    assert len(plans(result)) == len(result.tables[0].rows) == 1


@pytest.mark.parametrize(
    "wrong", [{"lengths": ()}, {"lengths": (-1.0,)}, {"lengths": (math.inf,)}, {"paths": 0}, {"limits": "mild"}]
)
def test_what_makes_no_study_is_refused(wrong):
    with pytest.raises(InputError):
        long_paths(**wrong)
