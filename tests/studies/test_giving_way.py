"""The study of giving way: what was outside the walls is inside behind it, and its result survives JSON."""

import json
from pathlib import Path

from cfplan.safety.limits_file import load_limits
from studies.giving_way import giving_way, random_paths

REPOSITORY = Path(__file__).parents[2]
SAFETY = REPOSITORY / "safety.yaml"


def test_flights_that_would_end_outside_end_inside_for_little_time():
    result = giving_way([REPOSITORY / "flights" / "line.yaml"], SAFETY, paths=1, first_seed=17)
    line, random = result.table("giving-way").rows
    assert line["rates_beyond"] > 1.0 > 0.0 > line["before_beyond"]  # as rates were once sent, and as they are
    assert random["before_beyond"] > 0.0 >= random["after_beyond"]
    assert (random["outside_before"], random["outside_after"], random["refused"]) == (1, 0, 0)
    assert 0.0 < random["lost_median"] < 0.05
    (table,) = json.loads(json.dumps(result.to_json(), allow_nan=False))["tables"]
    assert [row[0] for row in table["rows"]] == ["line", "random paths"]


def test_random_paths_stay_within_the_space():
    limits = load_limits(SAFETY)
    paths = random_paths(limits, 0, 3)
    assert len({seed for seed, _ in paths}) == 3
    for _, path in paths:
        assert (limits.space.beyond(path([k * path.end / 99 for k in range(100)])) <= 1e-9).all()
