"""Learning rate and width: every architecture has the same number of candidates, and a quick run trains them."""

from studies.paper.networks import SIZES, Kind
from studies.paper.search import CANDIDATES, STUDY, Settings, candidates
from studies.runner.cases import run_study


def test_each_architecture_has_as_many_candidates_and_the_first_is_the_one_in_use():
    for kind in Kind:
        first, *others = candidates(kind)
        assert first.width == SIZES[kind].width
        assert len({(each.rate, each.width) for each in (first, *others)}) == len(CANDIDATES)
        assert {each.until for each in others} == {first.until}


def test_the_quick_run_trains_all_candidates_of_an_architecture():
    kinds = (Kind.MLP,)
    rows = run_study("search", "studies.paper.search", STUDY, Settings(kinds=kinds, quick=True)).table("search").rows
    assert [row["kind"] for row in rows] == [kind for kind in kinds for _ in CANDIDATES]
    assert all(0.0 < row["unseen_loss"] < 10.0 and row["epochs"] <= 2 for row in rows)
    assert rows[0]["parameters"] < rows[4]["parameters"]
