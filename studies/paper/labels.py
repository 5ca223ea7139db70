"""Compare an LSTM that learned TOPPQuad's labels, as the paper's did, with one that learned the expert's.

Both are trained with the same options and seed, on the paths that both datasets have solved.
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from cfplan.errors import InputError
from cfplan.learning.dataset import make_dataset
from cfplan.learning.dataset_spec import Labeller
from studies.paper.printed import TEST, TRAIN
from studies.paper.sequences import Sequences, read_sequences
from studies.paper.trained import (
    DATA,
    DATA_COMMAND,
    EPOCHS,
    QUICK,
    QUICK_EPOCHS,
    QUICK_MOST,
    QUICK_TESTED,
    TESTED,
    PaperPath,
    TrainedNetwork,
    identities,
    quick_spec,
    trained_networks,
)
from studies.paper.training import SequenceOptions
from studies.paper.trials import SHIPPED, PaperTrial, ordered, path_trials, planner_columns, planners, training_table
from studies.runner.options import option
from studies.runner.result import Table, table
from studies.runner.study import Run, Study, Work

QUICK_ROWS = QUICK_TESTED + 4  # TOPPQuad takes a second for each
NAMES = {Labeller.TOPPQUAD: "LSTM, TOPPQuad's labels", Labeller.EXPERT: "LSTM, the expert's labels"}


@dataclass(frozen=True, slots=True)
class Settings:
    """The paths to plan, and the labels of the networks that plan them."""

    paths: int = option(100, "Number of training paths, and of test paths.", least=1)
    toppquad: Path = option(DATA.with_name("paper-toppquad"), "Dataset with TOPPQuad's labels.")
    expert: Path = option(DATA, "Dataset with the expert's labels of the same paths, or of more.")
    networks: Path = option(DATA.with_name("labels-networks"), "Folder of the networks; missing ones are trained.")
    epochs: int | None = option(None, EPOCHS, least=1)
    quick: bool = option(False, QUICK)


def work(settings: Settings, run: Run) -> Work:
    """Return one case per path; the networks are trained if necessary.

    Raises InputError if a dataset is missing, the two have not the same paths, or too few.
    """
    if settings.quick:
        made = {Labeller.TOPPQUAD: run.scratch / "toppquad", Labeller.EXPERT: run.scratch / "expert"}
        for labeller, folder in made.items():
            make_dataset(folder, replace(quick_spec(), count=QUICK_ROWS, planner=labeller))
        settings = replace(
            settings, toppquad=made[Labeller.TOPPQUAD], expert=made[Labeller.EXPERT], networks=run.scratch,
            epochs=QUICK_EPOCHS, paths=min(settings.paths, QUICK_MOST),
        )  # fmt: skip
    tested = QUICK_TESTED if settings.quick else TESTED
    both = of_same_paths(settings.toppquad, settings.expert)
    networks = []
    for labeller, sequences in both.items():
        known, folder = sequences.learned_from(tested), settings.networks / labeller
        (network,) = trained_networks(known, folder, [SequenceOptions()], run, settings.epochs)
        networks.append(replace(network, name=NAMES[labeller]))
    paths = {
        f"{part} {row}": PaperPath(part, int(row), path)
        for part, some in ((TRAIN, known), (TEST, sequences.tested(tested)))
        for row, path in zip(some.rows[: settings.paths], some.paths[: settings.paths], strict=True)
    }
    identity = {labeller: asdict(sequences.spec) for labeller, sequences in both.items()}
    return Work(paths, partial(measure, networks), PaperTrial, identity | {"networks": identities(networks)})


def of_same_paths(toppquad: Path, expert: Path) -> dict[Labeller, Sequences]:
    """Return the sequences of the paths that both datasets have solved. Raises InputError if their paths differ."""
    folders = {Labeller.TOPPQUAD: toppquad, Labeller.EXPERT: expert}
    for labeller, folder in folders.items():
        if not folder.is_dir():
            more = f" --planner {labeller}" if labeller is not Labeller.EXPERT else ""
            command = DATA_COMMAND.replace(str(DATA), str(folder)) + more
            raise InputError("no such dataset", where=str(folder), hint=f"make it: {command}")
    read = {labeller: read_sequences(folder) for labeller, folder in folders.items()}
    for labeller, sequences in read.items():
        if sequences.spec.planner is not labeller:
            raise InputError(
                f"its labels are by {sequences.spec.planner}",
                where=str(folders[labeller]),
                hint=f"give a dataset that was made with --planner {labeller}",
            )
    first, second = read.values()
    first, second = first.part(np.isin(first.rows, second.rows)), second.part(np.isin(second.rows, first.rows))
    if not np.array_equal(first.inputs, second.inputs):
        raise InputError(
            f"its paths are not those of {toppquad}",
            where=str(expert),
            hint="make both with the same options, except --planner",
        )
    return dict(zip(read, (first, second), strict=True))


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
