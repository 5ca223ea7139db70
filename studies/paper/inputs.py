"""The paper's table of inputs (appendix): the LSTM that sees position, velocity and acceleration of a path, or less."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from cfplan.learning.paper.sequences import Inputs
from cfplan.learning.paper.training import SequenceOptions
from studies.runner.items import HERE, Progress, Running, work_table, work_through
from studies.paper.architectures import planner_tables, settings_of, training_steps, training_table
from studies.paper.networks import (
    DATA,
    NETWORKS,
    PaperItem,
    TrainedNetwork,
    identities,
    paper_data,
    paper_items,
    trained_networks,
)
from studies.paper.printed import INPUTS
from studies.paper.trials import TOPPQUAD, PaperTrial, Plan, network_plan, path_trials, planners
from studies.runner.result import StudyResult, detail_table


def inputs_study(
    *,
    paths: int = 100,
    data: Path = DATA,
    networks: Path = NETWORKS,
    epochs: int | None = None,
    quick: bool = False,
    running: Running = HERE,
    progress: Progress = lambda done, total: None,
) -> StudyResult:
    """Compare the inputs on `paths` paths for training and for testing each; networks are trained if need be.

    Raises:
        InputError: no such dataset, or fewer paths in it.
    """
    wanted = [SequenceOptions(inputs=inputs) for inputs in Inputs]
    with paper_data(data, networks, paths, epochs=epochs, quick=quick) as material:
        trained = trained_networks(material, wanted, progress)
        settings = settings_of(material, quick)
        work = work_through(
            "inputs", settings | {"networks": identities(trained)}, partial(_trials_of, trained),
            paper_items(material), running, progress,
        )  # fmt: skip
    trials = [PaperTrial(**trial) for value in work.values for trial in value]
    tables = (
        *planner_tables(trials, list(_plans(trained)), "inputs", "inputs", INPUTS),
        training_table(trained, material),
    )
    details = (
        detail_table("trials", trials),
        work_table(training_steps(trained, settings["learned_from"]) | {"path": (len(work.values), work.seconds)}),
    )
    return StudyResult("inputs", settings, tables, details, work.interrupted)


def _plans(networks: Sequence[TrainedNetwork]) -> dict[str, Plan]:
    found = {TOPPQUAD: planners([])[TOPPQUAD]}
    return found | {each.options.inputs.value: network_plan(each) for each in networks}


def _trials_of(networks: Sequence[TrainedNetwork], item: PaperItem) -> list[PaperTrial]:
    return path_trials(_plans(networks), *item)
