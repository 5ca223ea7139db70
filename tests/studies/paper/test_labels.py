"""Labels: both networks learn from the same paths, and datasets of other paths are refused."""

from dataclasses import replace

import numpy as np
import pytest

from cfplan.errors import InputError
from cfplan.learning.dataset import make_dataset
from cfplan.learning.dataset_spec import Labeller
from studies.paper.labels import NAMES, STUDY, Settings, of_same_paths
from studies.paper.trained import quick_spec
from studies.runner.cases import run_study

FEW = replace(quick_spec(), count=3)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A function from the keys of a dataset that differ to its folder."""

    def make(**changes):
        folder = tmp_path_factory.mktemp("dataset")
        make_dataset(folder, replace(FEW, **changes))
        return folder

    return make


@pytest.fixture(scope="module")
def toppquad(made):
    return made(planner=Labeller.TOPPQUAD)


def test_the_paths_are_those_of_both_datasets_and_the_labels_differ(toppquad, made):
    both = of_same_paths(toppquad, made(count=5))
    theirs, ours = both[Labeller.TOPPQUAD], both[Labeller.EXPERT]
    np.testing.assert_array_equal(theirs.rows, ours.rows)
    assert len(theirs.rows) == 3
    assert 0.0 < np.abs(theirs.travel_time / ours.travel_time - 1.0).max() < 0.02


def test_datasets_that_cannot_be_compared_are_refused(toppquad, made, tmp_path):
    expert = made()
    for first, second, text in (
        (toppquad, made(seed=2), "its paths are not those of"),
        (expert, expert, "its labels are by expert"),
        (toppquad, toppquad, "its labels are by toppquad"),
        (tmp_path / "none", expert, "no such dataset"),
    ):
        with pytest.raises(InputError, match=text):
            of_same_paths(first, second)


@pytest.mark.slow
def test_the_quick_run_trains_both_networks_and_flies_their_plans():
    result = run_study("labels", "studies.paper.labels", STUDY, Settings(paths=1, quick=True))
    assert set(NAMES.values()) < {row["planner"] for row in result.table("labels").rows}
    assert [row["labels"] for row in result.table("training").rows] == list(NAMES)
