"""The studies of `cfplan study` that make the paper's tables and figures."""

from collections.abc import Callable
from pathlib import Path

import click

from cfplan.cli.measured import Study, count, measured, seed, use_one_thread
from cfplan.cli.output import print_table

_EPOCHS = click.option("--epochs", type=click.IntRange(1), help="Of each training.  [default: 14]")
_QUICK = click.option("--quick", is_flag=True, help="A few paths and epochs on data of its own: does it run?")
_NETWORKS = (
    click.option(
        "--data", type=click.Path(path_type=Path), default=Path("datasets/paper"), show_default=True,
        help="Dataset; its first 100 paths are for testing.",
    ),
    click.option(
        "--networks", type=click.Path(path_type=Path), default=Path("datasets/paper-networks"), show_default=True,
        help="Where networks are kept; those not there are trained.",
    ),
    _EPOCHS,
    _QUICK,
)  # fmt: skip


@measured(
    "training and planning", "cfplan study architectures -o results/architectures.json",
    count(100, "For training and for testing each."),
    click.option("--kind", "kinds", multiple=True, help="LSTM, Transformer, ETransformer or MLP.  [default: all]"),
    *_NETWORKS,
)  # fmt: skip
def architectures() -> Study:
    """Make the paper's Table 1: networks of four architectures, TOPPQuad, the expert and the network that ships.

    Training that was stopped goes on from its last epoch.
    """
    from cfplan.studies.paper.architectures import architectures as run

    return run


@measured(
    "training and planning", "cfplan study inputs -o results/inputs.json",
    count(100, "For training and for testing each."), *_NETWORKS,
)  # fmt: skip
def inputs() -> Study:
    """Make the paper's table of inputs: an LSTM that sees position, velocity and acceleration of a path, or less."""
    from cfplan.studies.paper.inputs import inputs_study

    return inputs_study


@measured(
    "training and planning", "cfplan study robustness -o results/robustness.json",
    count(100, "For testing."),
    click.option(
        "--draws", type=click.IntRange(1), default=10, show_default=True, help="Perturbations of each, each ε."
    ),
    click.option("--model", "models", multiple=True, help="LSTM, LSTM-0.001, …, LSTM-0.1-solved.  [default: all]"),
    click.option(
        "--reference", type=click.Choice(["toppquad", "expert"]), default="toppquad", show_default=True,
        help="Whose travel times are compared with, on the path and on the perturbed one.",
    ),
    *_NETWORKS,
)  # fmt: skip
def robustness() -> Study:
    """Make the paper's Table 2: networks and the planner that ships, asked about perturbed paths."""
    from cfplan.studies.paper.robustness import robustness as run

    return run


@measured(
    "training and planning", "cfplan study baselines -o results/baselines.json",
    count(50, "Random."),
    click.option(
        "--corridors", type=click.IntRange(2), default=2000, show_default=True,
        help="That the time allocation learns from.",
    ),
    seed(60_000), *_NETWORKS,
)  # fmt: skip
def baselines() -> Study:
    """Make the paper's Table 3: TOPPQuad, networks and the planner that ships beside planners of other kinds."""
    from cfplan.studies.paper.baselines import baselines as run

    return run


@measured(
    "labelling, training and flying", "cfplan study hardware -o results/hardware.json",
    count(8, "In the room, the first a straight line; the long one is flown besides."),
    click.option(
        "--learned-from", type=click.IntRange(10), default=9000, show_default=True,
        help="Paths, for each set of limits.",
    ),
    click.option(
        "--data", type=click.Path(path_type=Path), default=Path("datasets/paper-hardware"), show_default=True,
        help="Where paths and networks are kept; those not there are made.",
    ),
    _EPOCHS, _QUICK,
)  # fmt: skip
def hardware() -> Study:
    """Make the paper's hardware tables on the virtual lab, without real time: TOPPQuad, networks and what ships."""
    from cfplan.studies.paper.hardware import hardware as run

    return run


@measured(
    "planning", "cfplan study yaw-consistency -o results/yaw-consistency.json",
    click.option("--pairs", type=click.IntRange(1), default=100, show_default=True, help="Of random paths."),
    seed(50_000),
)  # fmt: skip
def yaw_consistency() -> Study:
    """Make the paper's figure of yaw consistency: TOPPQuad on pairs of paths whose first waypoint is 0.1 m apart."""
    from cfplan.studies.paper.yaw_consistency import yaw_consistency as run

    return run


@click.command(epilog="Example: cfplan study paper results")
@click.argument("folder", metavar="[DIR]", type=click.Path(path_type=Path), default=Path("results"))
@_QUICK
def paper(folder: Path, quick: bool) -> None:
    """Make all tables of the paper: the studies above and that of long paths, a result each in DIR.

    What was made by the same commit is kept, so that a run that was stopped goes on.
    """
    use_one_thread()
    from rich.console import Console
    from rich.progress import Progress

    from cfplan.studies.paper.all_tables import paper_tables

    with Progress(console=Console(stderr=True)) as bar:

        def begin(name: str) -> Callable[[int, int], None]:
            task = bar.add_task(name, total=None)
            return lambda done, total: bar.update(task, completed=done, total=total)

        made = paper_tables(folder, quick=quick, begin=begin)
    for each in made:
        for table in each.result.tables:
            print_table(table.title, *table.cells())
    for each in made:
        how = "kept, of this commit" if each.kept else f"{each.seconds:.0f} s of the processor"
        click.echo(f"{each.file}: {how}")


@click.command(epilog="Example: cfplan study figures results docs/images")
@click.argument("results", metavar="[RESULTS]", type=click.Path(path_type=Path), default=Path("results"))
@click.argument("images", metavar="[IMAGES]", type=click.Path(path_type=Path), default=Path("docs/images"))
def figures(results: Path, images: Path) -> None:
    """Draw the paper's figures from the JSON in RESULTS, as .png in IMAGES; those without a result are left out."""
    from cfplan.studies.paper.figures import write_figures

    for file, reason in write_figures(results, images):
        click.echo(f"{file}: left out: {reason}" if reason else file)


COMMANDS = (architectures, inputs, robustness, baselines, hardware, yaw_consistency, paper, figures)
