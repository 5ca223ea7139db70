"""Make the paper's table of inputs: LSTMs that see all or some of a path's position, velocity and acceleration."""

from collections.abc import Iterator
from functools import partial

from studies.paper.printed import INPUTS
from studies.paper.sequences import Inputs
from studies.paper.trained import NetworkSettings, PaperPath, TrainedNetwork, paper_data
from studies.paper.training import SequenceOptions
from studies.paper.trials import (
    TOPPQUAD,
    PaperTrial,
    network_plan,
    path_trials,
    planner_tables,
    planners,
    training_table,
)
from studies.runner.result import Table
from studies.runner.study import Run, Study, Work

WANTED = tuple(SequenceOptions(inputs=inputs) for inputs in Inputs)


def work(settings: NetworkSettings, run: Run) -> Work:
    """Return one case per path; networks are trained if necessary. Raises what `paper_data` raises."""
    data = paper_data(settings, run, WANTED)
    networks = {each.options.inputs.value: each for each in data.networks}
    return Work(data.paths, partial(measure, networks), PaperTrial, data.identity)


def measure(networks: dict[str, TrainedNetwork], asked: PaperPath) -> list[PaperTrial]:
    """Plan a path with TOPPQuad and each network."""
    plans = {TOPPQUAD: planners([])[TOPPQUAD]} | {name: network_plan(each) for name, each in networks.items()}
    return path_trials(plans, networks, asked)


def tables(settings: NetworkSettings, rows: list[PaperTrial]) -> Iterator[Table]:
    """Yield the paper's table, the same after repair, and the trainings."""
    yield from planner_tables("inputs", "inputs", INPUTS, rows)
    yield training_table(rows)


STUDY = Study(NetworkSettings, work, tables, "-o results/inputs.json")
