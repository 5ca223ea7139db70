"""The studies of `cfplan study` that plan."""

from functools import partial
from pathlib import Path

import click

from studies.commands.measured import BOXES, JOBS, NODES, PLANNER, SETS, YAW, Study, count, measured, safety_file_of, seed


@measured(
    "planning", "cfplan study feasibility --paths 1000 -o results/feasibility.json",
    count(1000, "Random paths in all."), PLANNER, NODES, BOXES, SETS, YAW,
)  # fmt: skip
def feasibility() -> Study:
    """Count the plans that pass the dense certificate as they are, and what slowing costs the others."""
    from studies.feasibility import dense_feasibility

    return dense_feasibility


@measured(
    "planning", "cfplan study learned --paths 1000 -o results/learned.json",
    count(1000, "Random paths in each box with each set."), seed(20_000), BOXES, SETS,
)  # fmt: skip
def learned() -> Study:
    """Try the learned planner on unseen paths, against the expert: the network alone, repaired, in the dry run."""
    from studies.learned import learned_study

    return learned_study


@measured(
    "planning", "cfplan study proposals -o results/proposals.json",
    count(60, "Random paths at each speed."),
    click.option("--box", default="4.5x8x2", show_default=True, help="4.5x8x2 or 10x10x10."),
    click.option(
        "--limits", default="simulation", show_default=True, help="hardware or simulation; the speed is varied."
    ),
    seed(20_000),
)  # fmt: skip
def proposals() -> Study:
    """Refine what the network, the convex planner and the expert begin with to the same end: steps, time, failures."""
    from studies.proposals import proposals as run

    return run


@measured(
    "planning", "cfplan study unseen-limits -o results/unseen-limits.json", count(1000, "In each of four groups.")
)
def unseen_limits() -> Study:
    """Try the learned planner under limits and for vehicles that it has not learned from, against the expert."""
    from studies.unseen_limits import unseen_limits as run

    return run


@measured(
    "training and planning", "cfplan study ablation datasets/any -o results/ablation.json",
    click.argument("dataset", metavar="DATASET", type=click.Path(path_type=Path)),
    click.option("--rows", type=int, default=10_000, show_default=True, help="Of the dataset, from which each learns."),
    click.option("--epochs", type=click.IntRange(1), default=6, show_default=True),
    count(300, "Unseen, each under other limits."),
)  # fmt: skip
def ablation() -> Study:
    """Train networks on DATASET for a short time, each without a part of what it sees of limits, and compare them."""
    from studies.ablation import ablation as run

    return run


@measured(
    "planning", "cfplan study scaling -o results/scaling.json",
    PLANNER, click.option("--repeats", type=int, default=5, show_default=True, help="Paths of each size."), YAW,
)  # fmt: skip
def scaling() -> Study:
    """Measure how planning time grows with the number of nodes, from 100 to 3,000."""
    from studies.scaling import scaling as run

    return run


@measured(
    "planning", "cfplan study long -o results/long.json",
    click.option(
        "--length", "lengths", type=click.FloatRange(10, 10_000), multiple=True,
        help="m; may be given several times, the first is compared with.  [default: 20 to 2000]",
    ),
    click.option("--paths", type=click.IntRange(1), default=3, show_default=True, help="Random paths of each length."),
    click.option("--limits", default="hardware", show_default=True, help="hardware or simulation."),
    seed(20_000),
)  # fmt: skip
def long() -> Study:
    """Plan paths of 1 to 100 times the usual length with the learned planner: time, memory, flights, joints.

    Beside it the expert, and TOPPQuad as far as it goes.
    """
    from studies.long_paths import long_paths

    return long_paths


@measured(
    "planning", "cfplan study hard-paths --jobs 2 -o results/hard-paths.json",
    count(1000, "Families take turns."), seed(0),
    click.option(
        "--compare-every", type=click.IntRange(0), default=7, show_default=True,
        help="Of so many paths one is planned by the expert too, with all the time that it wants; 0: none.",
    ),
    JOBS,
)  # fmt: skip
def hard_paths() -> Study:
    """Plan adversarial paths under limits from a hundredth to ten times the usual: time, memory, what is refused."""
    from studies.hard_paths import hard_paths as run

    return partial(run, safety_file_of(Path()))


COMMANDS = (feasibility, learned, proposals, unseen_limits, ablation, scaling, long, hard_paths)
