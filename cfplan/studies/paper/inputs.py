"""The paper's table of inputs (appendix): the LSTM that sees position, velocity and acceleration of a path, or less."""

from pathlib import Path

from cfplan.learning.paper.sequences import Inputs
from cfplan.learning.paper.training import SequenceOptions
from cfplan.studies.paper.architectures import TrialSteps, all_trials, planner_tables, settings_of, training_table
from cfplan.studies.paper.networks import DATA, NETWORKS, Progress, paper_data, trained_networks
from cfplan.studies.paper.printed import INPUTS
from cfplan.studies.paper.trials import TOPPQUAD, network_plan, planners
from cfplan.studies.result import StudyResult, collect, detail_table


def inputs_study(
    *,
    paths: int = 100,
    data: Path = DATA,
    networks: Path = NETWORKS,
    epochs: int | None = None,
    quick: bool = False,
    progress: Progress = lambda done, total: None,
) -> StudyResult:
    """Compare the inputs on `paths` paths for training and for testing each; networks are trained if need be.

    Raises:
        InputError: no such dataset, or fewer paths in it.
    """
    wanted = [SequenceOptions(inputs=inputs) for inputs in Inputs]
    with paper_data(data, networks, paths, epochs=epochs, quick=quick) as material:
        more = 2 * (len(wanted) + 1)
        trained = trained_networks(material, wanted, progress, more)
        steps = TrialSteps(progress, sum(each.options.epochs for each in trained), more)
        found = {TOPPQUAD: planners([])[TOPPQUAD]}
        found |= {each.options.inputs.value: network_plan(each) for each in trained}
        trials, interrupted = collect(all_trials(found, material, steps))
    tables = (*planner_tables(trials, list(found), "inputs", "inputs", INPUTS), training_table(trained, material))
    details = (detail_table("trials", trials),)
    return StudyResult("inputs", settings_of(material, quick), tables, details, interrupted)
