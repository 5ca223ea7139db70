"""The study of the learned planner counts what happened."""

import json
from dataclasses import replace

import pytest

from cfplan.errors import InputError
from cfplan.safety.limit_sets import LIMIT_SETS
from studies.learned import CONVEX_EVERY, FIGURES, figures_table, fly_unseen, learned_study
from studies.runner.result import Table


@pytest.fixture(scope="module")
def small():
    return list(fly_unseen([("4.5x8x2", LIMIT_SETS["hardware"])], range(20_000, 20_003)))


def figures(flights):
    return {row[0]: row[2] for row in figures_table(flights).cells()[1]}


def test_every_path_is_counted_and_certified_flights_are_near_the_experts(small):
    assert len(small) == 3
    for flight in small:
        assert not flight.reason
        assert flight.speed_factor == 1.0
        assert flight.learned == pytest.approx(flight.expert, rel=0.01)
        assert flight.network == pytest.approx(flight.expert_planned, rel=0.03)
        assert 0 < flight.deviation < 0.2


def test_the_result_is_one_table_of_figures_and_goals_and_survives_json():
    result = learned_study(paths=3, boxes=["4.5x8x2"], limit_sets=["hardware"])
    (table,) = result.tables
    titles, rows = table.cells()
    assert titles == ["figure", "goal", "4.5x8x2 m, hardware"]
    assert [row[:2] for row in rows] == [[column.title, column.goal] for column in FIGURES[1:] if column.title]
    document = json.loads(json.dumps(result.to_json(), allow_nan=False))
    figures = {row[0]: row[2] for row in Table.from_json(document["tables"][0]).cells()[1]}
    assert figures["paths"] == figures["certified"] == "3"
    assert figures["dry run: failed"] == "0/3"
    by_kind = [int(figures[f"certified {kind}"]) for kind in ("as the network has it", "when refined", "when slowed")]
    assert sum(by_kind) == 3


def test_the_convex_planner_flies_one_path_in_ten_and_no_faster_when_slowed(small):
    flown = [flight for flight in small if flight.convex_refined > 0]
    assert [flight.seed % CONVEX_EVERY for flight in flown] == [0]
    assert flown[0].convex_slowed >= flown[0].convex_refined > 0.99 * flown[0].expert


def test_times_of_about_twenty_metres_are_those_of_such_paths_alone(small):
    some = [replace(small[0], length=length, seconds=(ms / 1e3, 0, 0)) for length, ms in ((10, 99), (22, 7))]
    shown = figures(some)
    assert shown["path to bytes, about 20 m: paths"] == "1"
    assert shown["path to bytes, about 20 m: p99"] == "7.0 ms"
    assert shown["path to bytes: median"] == "53.0 ms"


def test_what_was_not_measured_is_a_dash(small):
    shown = figures([replace(small[1], length=10.0)])
    assert shown["path to bytes, about 20 m: p99"] == shown["convex, slowed, against learned: median"] == "–"


def test_nothing_measured_is_an_empty_table():
    assert figures_table([]).cells()[1] == []


@pytest.mark.parametrize("wrong", [{"paths": 0}, {"boxes": ["3x3x3"]}, {"limit_sets": ["mild"]}])
def test_what_makes_no_study_is_refused(wrong):
    with pytest.raises(InputError):
        learned_study(**{"paths": 1} | wrong)
