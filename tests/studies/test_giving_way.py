"""The study of giving way: flights that would end outside the walls end inside."""

from pathlib import Path

from cfplan.safety.limits_file import load_limits
from studies.giving_way import STUDY, Settings, random_paths
from studies.runner.cases import run_study

REPOSITORY = Path(__file__).parents[2]


def test_flights_that_would_end_outside_end_inside_for_little_time():
    settings = Settings((REPOSITORY / "flights" / "line.yaml",), random=1, seed=17)
    line, random = run_study("giving-way", "studies.giving_way", STUDY, settings).table("giving-way").rows
    assert (line["path"], random["path"]) == ("line", "random paths")
    assert line["rates_beyond"] > 1.0 > 0.0 > line["before_beyond"]  # as rates were once sent, and as they are
    assert random["before_beyond"] > 0.0 >= random["after_beyond"]
    assert (random["outside_before"], random["outside_after"], random["refused"]) == (1, 0, 0)
    assert 0.0 < random["lost_median"] < 0.05


def test_random_paths_stay_within_the_space():
    limits = load_limits(REPOSITORY / "safety.yaml")
    paths = random_paths(limits, 0, 3)
    assert len({seed for seed, _ in paths}) == 3
    for _, path in paths:
        assert (limits.space.beyond(path([k * path.end / 99 for k in range(100)])) <= 1e-9).all()
