"""The study of long paths: every path certified, near the expert, in memory that hardly grows."""

import json
import math

import pytest

from cfplan.errors import CfplanError, InputError
from studies import long_paths as study
from studies.long_paths import BESIDE, COLUMNS, long_paths
from studies.runner.result import Table

LENGTHS = (20.0, 60.0)


@pytest.fixture(scope="module")
def short():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "TOPPQUAD_NODES", 250)
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


def test_flights_are_followed_however_long_they_are(short):
    for plan in plans(short):
        assert 0.0 < plan.deviation < 0.04


def test_the_network_is_as_near_the_expert_at_its_joints_as_elsewhere(short):
    for plan in plans(short):
        assert plan.joints > 0
        assert 0.0 < plan.error_at_joints < 1.5 * plan.error_elsewhere


def test_toppquad_stands_beside_as_far_as_it_goes(short):
    first, second = plans(short)
    assert first.toppquad_asked
    assert first.toppquad_seconds > 0.0
    assert first.flight / first.toppquad_flight == pytest.approx(1.0, abs=0.1)
    assert not second.toppquad_asked
    assert math.isnan(second.toppquad_flight)
    assert [row["toppquad_asked"] for row in short.table("beside").rows] == [1, None]


def test_memory_is_measured_where_linux_tells_it(short):
    for plan in plans(short):
        assert plan.peak >= plan.kept
        assert plan.peak < study.GOAL_MEGABYTES


def test_the_result_is_one_table_compared_with_its_first_row_and_survives_json(short):
    table, beside = short.tables
    assert beside.cells()[0] == [column.title for column in BESIDE if column.title]
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
