"""Yaw consistency: pairs of paths, and the differences between their plans."""

import numpy as np

from studies.paper.yaw_consistency import (
    PENALISED,
    PLAIN,
    STUDY,
    WAYS,
    Pair,
    Settings,
    tables,
)
from studies.runner.cases import run_study


def test_pairs_that_are_solved_are_counted_by_their_difference_of_yaw():
    pairs = [
        Pair(PLAIN, 1, "", 5.0, 1.0, 0.1, 0.01, 0.03),
        Pair(PLAIN, 2, "", 6.0, 3.0, 0.2, 0.03, 9.0),
        Pair(PLAIN, 3, "no"),
    ]
    differences, histogram = tables(Settings(), pairs)
    (row,) = differences.rows
    assert (row["pairs"], row["solved"]) == (3, 2)
    assert row["yaw_max"] == 9.0
    assert row["time_median"] == 0.02
    (counts,) = histogram.rows
    assert counts["0 to 0.05"] == counts["above 4"] == 1
    assert sum(count for name, count in counts.items() if name != "planner") == 2


def test_both_penalties_and_the_expert_plan_the_same_paths_in_nearly_the_same_time():
    result = run_study("yaw-consistency", "studies.paper.yaw_consistency", STUDY, Settings(pairs=1))
    found = {pair.planner: pair for pair in result.rows}
    assert list(found) == list(WAYS)
    assert all(pair.solved for pair in found.values())
    times = np.array([pair.travel_time for pair in found.values()])
    assert times.max() < 1.03 * times.min()
    assert found[PLAIN].travel_time != found[PENALISED].travel_time
    assert all(pair.time < 0.3 for pair in found.values())
