"""The study of the learned planner counts what happened."""

import json

import pytest

from cfplan.errors import InputError
from cfplan.studies.learned import COLUMNS, learned_study


@pytest.fixture(scope="module")
def small():
    return learned_study(paths=3, boxes=["4.5x8x2"], limit_sets=["hardware"], command="cfplan study learned")


def test_every_path_is_counted_and_certified_flights_are_near_the_experts(small):
    assert len(small.flights) == 3
    for flight in small.flights:
        assert not flight.reason
        assert flight.share == 1.0
        assert flight.learned == pytest.approx(flight.expert, rel=0.01)
        assert flight.network == pytest.approx(flight.expert_planned, rel=0.03)
        assert 0 < flight.deviation < 0.2


def test_the_result_is_one_table_and_survives_json(small):
    ((_, columns, rows),) = small.tables()
    assert columns == list(COLUMNS)
    assert len(rows) == 1
    assert json.loads(json.dumps(small.to_dict()))["table"][0]["paths"] == "3"


@pytest.mark.parametrize("wrong", [{"paths": 0}, {"boxes": ["3x3x3"]}, {"limit_sets": ["mild"]}])
def test_what_makes_no_study_is_refused(wrong):
    with pytest.raises(InputError):
        learned_study(**{"paths": 1} | wrong)
