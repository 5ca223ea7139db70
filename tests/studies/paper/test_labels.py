"""Labels: both networks learn from datasets of the same paths, and others are refused."""

from dataclasses import replace

import numpy as np
import pytest

from cfplan.errors import InputError
from cfplan.learning.dataset import make_dataset
from cfplan.learning.dataset_spec import Labeller
from studies.paper.labels import LEARNED_EXPERT, LEARNED_TOPPQUAD, STUDY, Settings, toppquad_answers
from studies.paper.sequences import read_sequences
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


def test_the_paths_are_the_same_and_the_labels_differ(toppquad, made):
    ours = read_sequences(made(count=5))
    theirs = toppquad_answers(toppquad, ours)
    np.testing.assert_array_equal(theirs.rows, ours.rows[:3])
    assert 0.0 < np.abs(theirs.travel_time / ours.travel_time[:3] - 1.0).max() < 0.02


def test_datasets_that_cannot_be_compared_are_refused(toppquad, made, tmp_path):
    expert, other = made(), made(seed=2)
    for first, second, text in (
        (toppquad, other, "its paths are not those"),
        (expert, expert, "its labels are by expert"),
        (tmp_path / "none", expert, "no such dataset"),
    ):
        with pytest.raises(InputError, match=text):
            toppquad_answers(first, read_sequences(second))


@pytest.mark.slow
def test_the_quick_run_trains_both_networks_and_flies_their_plans():
    result = run_study("labels", "studies.paper.labels", STUDY, Settings(paths=1, quick=True))
    assert {LEARNED_TOPPQUAD, LEARNED_EXPERT} < {row["planner"] for row in result.table("labels").rows}
    assert [row["labels"] for row in result.table("training").rows] == [Labeller.TOPPQUAD, Labeller.EXPERT]
