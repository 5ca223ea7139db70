"""Compare an LSTM that learned TOPPQuad's labels, as the paper's did, with one that learned the expert's.

Both are trained with the same options and seed, each on the paths that its planner solved.
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from cfplan.errors import InputError
from cfplan.learning.dataset import make_dataset
from cfplan.learning.dataset_spec import Labeller
from studies.paper.sequences import Sequences, read_sequences
from studies.paper.trained import (
    DATA,
    DATA_COMMAND,
    QUICK_EPOCHS,
    QUICK_TESTED,
    TESTED,
    NetworkSettings,
    PaperPath,
    TrainedNetwork,
    identities,
    paper_data,
    quick_spec,
    trained_networks,
)
from studies.paper.training import SequenceOptions
from studies.paper.trials import SHIPPED, PaperTrial, ordered, path_trials, planner_columns, planners, training_table
from studies.runner.options import option
from studies.runner.result import Table, table
from studies.runner.study import Run, Study, Work

QUICK_ROWS = QUICK_TESTED + 4  # TOPPQuad takes a second for each
TOPPQUAD_COMMAND = DATA_COMMAND.replace(str(DATA), "{folder}") + f" --planner {Labeller.TOPPQUAD}"
LEARNED_TOPPQUAD, LEARNED_EXPERT = "LSTM, TOPPQuad's labels", "LSTM, the expert's labels"


@dataclass(frozen=True, slots=True)
class Settings(NetworkSettings):
    """The paths to plan, and the labels of the networks that plan them."""

    toppquad: Path = option(DATA.with_name("paper-toppquad"), "Dataset of the same paths with TOPPQuad's labels.")


def work(settings: Settings, run: Run) -> Work:
    """Return one case per path; the networks are trained if necessary.

    Raises InputError if a dataset is missing or too small, or the two have not the same paths.
    """
    data, folder, tested, epochs = settings.data, settings.networks, TESTED, settings.epochs
    toppquad = settings.toppquad
    expert = paper_data(settings, run, [SequenceOptions()])
    if settings.quick:
        data, folder, tested, epochs = run.scratch / "data", run.scratch, QUICK_TESTED, QUICK_EPOCHS
        toppquad = run.scratch / "toppquad"
        make_dataset(toppquad, replace(quick_spec(), count=QUICK_ROWS, planner=Labeller.TOPPQUAD))
    answered = toppquad_answers(toppquad, read_sequences(data))
    known, options = answered.learned_from(tested), [SequenceOptions()]
    (learned,) = trained_networks(known, folder / Labeller.TOPPQUAD, options, run, epochs)
    networks = [replace(learned, name=LEARNED_TOPPQUAD), replace(expert.networks[0], name=LEARNED_EXPERT)]
    identity = {"data": expert.identity["data"], "toppquad": asdict(answered.spec), "networks": identities(networks)}
    return Work(expert.paths, partial(measure, networks), PaperTrial, identity)


def toppquad_answers(folder: Path, expert: Sequences) -> Sequences:
    """Return the dataset with TOPPQuad's labels. Raises InputError if it is none, or not of the expert's paths."""
    if not folder.is_dir():
        command = TOPPQUAD_COMMAND.format(folder=folder)
        raise InputError("no such dataset", where=str(folder), hint=f"make it: {command}")
    read = read_sequences(folder)
    if read.spec.planner is not Labeller.TOPPQUAD:
        raise InputError(
            f"its labels are by {read.spec.planner}",
            where=str(folder),
            hint=f"give a dataset that was made with --planner {Labeller.TOPPQUAD}",
        )
    _, ours, theirs = np.intersect1d(expert.rows, read.rows, return_indices=True)
    if not len(ours) or not np.array_equal(expert.inputs[ours], read.inputs[theirs]):
        raise InputError(
            "its paths are not those with the expert's labels",
            where=str(folder),
            hint="make both datasets with the same options, except --planner",
        )
    return read


def measure(networks: list[TrainedNetwork], asked: PaperPath) -> list[PaperTrial]:
    """Plan a path with TOPPQuad, the expert and both networks, and fly each plan without repair."""
    plans = {name: plan for name, plan in planners(networks).items() if name != SHIPPED}
    trials = path_trials(plans, {each.name: each for each in networks}, asked)
    return [trial for trial in trials if not trial.repaired]


def tables(settings: Settings, rows: list[PaperTrial]) -> Iterator[Table]:
    """Yield the flights of plans as planned, and the trainings."""
    columns = [column for column in planner_columns("planner", {}) if not column.key.startswith("paper_")]
    yield table("labels", "Labels by TOPPQuad and by the expert", columns, ordered(rows), by=("planner", "part"))
    yield training_table(rows)


STUDY = Study(Settings, work, tables, "-o results/labels.json")
