"""Studies count what happened, on the same paths, and can be stopped; their numbers survive JSON."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from cfplan.errors import InputError
from cfplan.planners.solution import Solution, Status
from cfplan.planning import planners
from studies import feasibility, proposals, scaling, trials
from studies.bench import bench
from studies.runner.machine import this_machine
from studies.runner.result import Column
from studies.trials import quantiles, random_path

pytestmark = pytest.mark.unit
SMALL = {"boxes": ["4.5x8x2"], "limit_sets": ["hardware"], "planners": ["convex", "minsnap"]}


@pytest.fixture(scope="module")
def small():
    return bench(paths=2, nodes=60, **SMALL)


def rows(result):
    """The figures of each planner of the one group, from both of its tables."""
    times, flights = result.tables
    return [time | flight for time, flight in zip(times.rows, flights.rows, strict=True)]


def test_every_planner_meets_the_same_paths_and_the_same_bound(small):
    by_planner = {
        name: [(trial["seed"], trial["bound"]) for trial in small.table("trials").rows if trial["planner"] == name]
        for name in SMALL["planners"]
    }
    assert by_planner["convex"] == by_planner["minsnap"]
    assert len(by_planner["convex"]) == 2


def test_certified_flights_are_no_faster_than_planned_nor_than_the_bound(small):
    for trial in small.table("trials").rows:
        assert trial["certified_time"] >= trial["planned_time"] * (1 - 1e-12)
        assert trial["certified_time"] > trial["bound"]
    for row in rows(small):
        assert row["paths"] == row["certified"] == 2
        assert row["gap_median"] > 0


def test_what_is_slowed_is_what_broke_a_limit(small):
    for trial in small.table("trials").rows:
        slowed = trial["certified_time"] > trial["planned_time"] * (1 + 1e-9)
        assert slowed == (trial["worst_share"] > 1.0)


def test_a_run_is_reproduced_by_its_seed_but_for_times(small):
    again = bench(paths=2, nodes=60, **SMALL)
    assert [row["flight"] for row in rows(again)] == [row["flight"] for row in rows(small)]


def test_the_result_survives_json_and_names_command_and_machine(small):
    made = replace(small.provenance, command="cfplan bench --paths 2")
    document = json.loads(json.dumps(replace(small, provenance=made).to_json(), allow_nan=False))
    assert document["provenance"]["command"] == "cfplan bench --paths 2"
    assert document["provenance"]["machine"]["cores"] >= 1
    (trials,) = document["details"]
    assert len(trials["rows"]) == 4
    for table in small.tables:
        titles, cells = table.cells()
        assert all(len(row) == len(titles) for row in cells)


def test_a_failing_planner_is_counted_with_its_reason(monkeypatch):
    def never(*_arguments, **_options):
        return Solution(Status.NOT_CONVERGED, None, "gave up")

    monkeypatch.setattr(trials, "find_planner", lambda name: never)
    result = bench(paths=1, boxes=["4.5x8x2"], limit_sets=["hardware"], planners=["minsnap"])
    (row,) = rows(result)
    assert row["certified"] == 0
    assert result.table("trials").rows[0]["reason"] == "gave up"
    assert math.isnan(row["flight"])
    assert all(isinstance(text, str) for table in result.tables for text in table.cells()[1][0])


def test_an_interrupt_keeps_what_is_measured(monkeypatch):
    paths = []
    true = planners.find_planner("minsnap")

    def stopping(task):
        if task.path not in paths:
            paths.append(task.path)
        if len(paths) > 3:  # warming up, then two paths
            raise KeyboardInterrupt
        return true(task)

    monkeypatch.setattr(trials, "find_planner", lambda name: stopping)
    result = bench(paths=5, boxes=["4.5x8x2"], limit_sets=["hardware"], planners=["minsnap"])
    assert result.interrupted
    assert rows(result)[0]["paths"] == 2


def test_feasibility_shares_its_paths_out_and_keeps_failures():
    result = feasibility.dense_feasibility(
        paths=2, boxes=["4.5x8x2"], limit_sets=["hardware", "simulation"], planner="convex", nodes=60
    )
    (groups,), failures = result.tables, result.table("failures").rows
    assert [group["paths"] for group in groups.rows] == [1, 1]
    for group in groups.rows:
        assert group["certified"] == group["paths"]
        failed = sum(failure["limits"] == group["limits"] for failure in failures)
        assert group["unslowed"] + failed == group["paths"]
    titles, cells = groups.cells()
    assert all(len(row) == len(titles) for row in cells)


def test_every_proposal_is_refined_to_the_experts_flight_and_the_networks_in_the_fewest_steps():
    result = proposals.proposals(paths=2, speeds=(2.0,))
    rows = {row["proposal"]: row for row in result.table("speeds").rows}
    assert list(rows) == list(proposals.WAYS)
    assert [row["failed"] for row in rows.values()] == [0] * len(rows)
    assert max(row["slower_max"] for row in rows.values()) < 2e-3
    assert rows["network"]["steps"] < min(rows["convex"]["steps"], rows["expert"]["steps"])
    assert rows["network"]["steps"] < rows["network, multipliers not kept"]["steps"]


def test_scaling_grows_the_path_with_the_grid():
    result = scaling.scaling(sizes=(50, 100), repeats=1, planner="minsnap")
    sizes = result.table("sizes").rows
    assert [size["nodes"] for size in sizes] == [50, 100]
    assert sizes[1]["length"] > 1.4 * sizes[0]["length"]
    assert sizes[0]["against_first"] == 1.0


@pytest.mark.parametrize("length", [20.0, 200.0, 600.0])
def test_paths_come_in_the_length_that_was_asked_for(length):
    path = scaling.path_of_length(length, "10x10x10", 3)
    assert path.length == pytest.approx(length, rel=scaling.LENGTH_ERROR)


@pytest.mark.parametrize(
    "wrong",
    [
        {"paths": 0},
        {"boxes": ["3x3x3"]},
        {"limit_sets": ["mild"]},
        {"planners": ["oracle"]},
    ],
)
def test_wrong_arguments_are_input_errors(wrong):
    with pytest.raises(InputError):
        bench(**wrong)


@pytest.mark.parametrize(("spec", "shown"), [("+.1f", "+0.0 cm"), (".1f", "0.0 cm"), ("", "-0.01 cm")])
def test_no_cell_says_minus_zero(spec, shown):
    assert Column("off", "off", "cm", spec).text({"off": -0.0001}) == shown


def test_quantiles_pass_over_what_is_not_finite():
    assert quantiles([3.0, float("nan"), 1.0, 2.0])[0] == 2.0
    assert np.isnan(quantiles([])).all()


def test_random_paths_come_from_their_seed():
    np.testing.assert_array_equal(random_path(3, "10x10x10").coefficients, random_path(3, "10x10x10").coefficients)


def test_the_machine_knows_its_packages():
    assert {"numpy", "casadi"} <= set(this_machine().packages)


def test_a_refined_planner_is_another_candidate_than_the_same_one_slowed():
    names = ["convex", "convex, refined", "expert, refined"]
    result = bench(paths=2, nodes=60, boxes=["4.5x8x2"], limit_sets=["hardware"], planners=names)
    slowed, refined, expert = rows(result)
    assert refined["refined"] >= slowed["refined"]
    assert refined["flight"] <= slowed["flight"]
    assert (expert["against_expert_mean"], expert["against_expert_p95"]) == (0.0, 0.0)
    assert slowed["against_expert_mean"] > 0
