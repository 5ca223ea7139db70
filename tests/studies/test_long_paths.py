"""The study of long paths: every path certified, near the expert, in memory that hardly grows."""

import json
import math

import pytest

from cfplan.errors import CfplanError, InputError
from cfplan.studies import long_paths as study
from cfplan.studies.long_paths import COLUMNS, long_paths

LENGTHS = (20.0, 60.0)


@pytest.fixture(scope="module")
def short():
    return long_paths(lengths=LENGTHS, paths=1, repeats=2, command="cfplan study long")


def test_flights_are_certified_and_near_the_experts(short):
    for length, (walk,) in zip(LENGTHS, short.walks, strict=True):
        assert walk.length == pytest.approx(length, rel=0.05)
        assert walk.certified
        assert walk.worst_share <= 1.0
        assert 0.0 < walk.flight / walk.expert_flight - 1.0 < 0.01
        assert all(part > 0 for part in walk.seconds)


def test_memory_is_measured_where_linux_tells_it(short):
    for (walk,) in short.walks:
        assert walk.peak >= walk.kept
        assert walk.peak < study.GOAL_MEGABYTES


def test_the_result_is_one_table_compared_with_its_first_row_and_survives_json(short):
    ((_, columns, rows),) = short.tables()
    assert columns == list(COLUMNS)
    assert rows[0][COLUMNS.index("against the first")] == "1.0×"
    document = json.loads(json.dumps(short.to_dict()))
    assert [walk["length"] for walk in document["walks"]] == [walk.length for (walk,) in short.walks]
    assert document["table"][1]["certified"] == "1/1"


def test_a_path_that_cannot_be_flown_is_told_with_its_reason(monkeypatch, short):
    true = study.repair

    def failing(task, *rest):
        if task.path.length > 40:
            raise CfplanError("no way")
        return true(task, *rest)

    monkeypatch.setattr(study, "repair", failing)
    result = long_paths(lengths=LENGTHS, paths=1, repeats=1)
    ((first,), (second,)) = result.walks
    assert first.certified
    assert second.reason == "no way"
    assert math.isnan(second.flight)
    assert result.tables()[0][2][1][COLUMNS.index("certified")] == "0/1"


def test_an_interrupt_keeps_the_lengths_that_are_done(monkeypatch, short):
    true = study.path_of_length

    def stopping(length, *rest):
        if length > 40:
            raise KeyboardInterrupt
        return true(length, *rest)

    monkeypatch.setattr(study, "path_of_length", stopping)
    result = long_paths(lengths=LENGTHS, paths=1, repeats=1)
    assert result.interrupted
    assert len(result.walks) == len(result.tables()[0][2]) == 1


@pytest.mark.parametrize(
    "wrong", [{"lengths": ()}, {"lengths": (-1.0,)}, {"lengths": (math.inf,)}, {"paths": 0}, {"limits": "mild"}]
)
def test_what_makes_no_study_is_refused(wrong):
    with pytest.raises(InputError):
        long_paths(**wrong)
