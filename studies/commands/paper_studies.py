"""The studies of `cfplan study` that make the paper's tables and figures."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from studies.commands.measured import SCHEDULER, WORKERS, Study, count, measured, seed, shown_progress, use_one_thread
from cfplan.cli.output import print_table

if TYPE_CHECKING:
    from studies.paper.expected_time import Expected

_EPOCHS = click.option("--epochs", type=click.IntRange(1), help="Of each training.  [default: 14]")
_QUICK = click.option("--quick", is_flag=True, help="A few paths and epochs on data of its own: does it run?")
_SPREAD = (WORKERS, SCHEDULER)
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
    *_SPREAD,
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
    from studies.paper.architectures import architectures as run

    return run


@measured(
    "training and planning", "cfplan study inputs -o results/inputs.json",
    count(100, "For training and for testing each."), *_NETWORKS,
)  # fmt: skip
def inputs() -> Study:
    """Make the paper's table of inputs: an LSTM that sees position, velocity and acceleration of a path, or less."""
    from studies.paper.inputs import inputs_study

    return inputs_study


@measured(
    "training and planning", "cfplan study robustness -o results/robustness.json",
    count(100, "For testing."),
    click.option(
        "--draws", type=click.IntRange(1), default=10, show_default=True, help="Perturbations of each, each ε."
    ),
    click.option(
        "--model", "models", multiple=True, help="LSTM, LSTM-0.001, …, LSTM-0.1-solved; shipped, with free yaw, "
        "shipped-fixed, shipped-tangent; expert, toppquad.  [default: all but toppquad]",
    ),
    click.option(
        "--reference", type=click.Choice(["toppquad", "expert"]), default="toppquad", show_default=True,
        help="Whose travel times are compared with, on the path and on the perturbed one.",
    ),
    click.option(
        "--reference-draws", type=click.IntRange(1), help="Of each, that are compared so; it takes the most time.  "
        "[default: all]",
    ),
    *_NETWORKS,
)  # fmt: skip
def robustness() -> Study:
    """Make the paper's Table 2: networks and the planner that ships, asked about perturbed paths."""
    from studies.paper.robustness import robustness as run

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
    from studies.paper.baselines import baselines as run

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
    _EPOCHS, _QUICK, *_SPREAD,
)  # fmt: skip
def hardware() -> Study:
    """Make the paper's hardware tables on the virtual lab, without real time: TOPPQuad, networks and what ships."""
    from studies.paper.hardware import hardware as run

    return run


@measured(
    "planning", "cfplan study yaw-consistency -o results/yaw-consistency.json",
    click.option("--pairs", type=click.IntRange(1), default=100, show_default=True, help="Of random paths."),
    seed(50_000), *_SPREAD,
)  # fmt: skip
def yaw_consistency() -> Study:
    """Make the paper's figure of yaw consistency: TOPPQuad on pairs of paths whose first waypoint is 0.1 m apart."""
    from studies.paper.yaw_consistency import yaw_consistency as run

    return run


@measured(
    "training and simulating", "cfplan study simulators -o results/simulators.json",
    count(8, "Of each kind of table."), *_NETWORKS,
)  # fmt: skip
def simulators() -> Study:
    """Fly bytes of the paper's tables on bodies of RotorPy, with two motor lags, and of drone-models."""
    from studies.paper.simulators import simulators as run

    return run


@click.command(epilog="Example: cfplan study paper results --workers 2")
@click.argument("folder", metavar="[DIR]", type=click.Path(path_type=Path), default=Path("results"))
@_QUICK
@click.option("--dry-run", is_flag=True, help="Only say what would be made, and how long it would take.")
@WORKERS
@SCHEDULER
def paper(folder: Path, quick: bool, dry_run: bool, workers: int, scheduler: str | None) -> None:
    """Make all tables of the paper: the studies above and that of long paths, a result each in DIR.

    What was made by the same commit is kept, so that a run that was stopped goes on, also within a study; results of
    another commit are stale, and are made anew.
    """
    use_one_thread()
    from studies.runner.items import Running
    from studies.paper.all_tables import paper_tables
    from studies.paper.expected_time import expected
    from studies.runner.time_left import duration_text

    processes = workers if scheduler is None else 1
    _print_expected(expected(folder, quick=quick), processes, quick=quick)
    if dry_run:
        return
    running = Running(workers, scheduler, tell=lambda text: click.echo(text, err=True))
    with shown_progress(quiet=False) as begin:
        made = paper_tables(folder, quick=quick, running=running, begin=begin)
    for each in made:
        for table in each.result.tables:
            print_table(table.title, *table.cells())
    for each in made:
        click.echo(f"{each.file}: {'kept, of this commit' if each.kept else f'made in {duration_text(each.seconds)}'}")
    click.echo(f"all in {duration_text(sum(each.seconds for each in made))}")


def _print_expected(studies: "Sequence[Expected]", processes: int, *, quick: bool) -> None:
    """Print what there is of each study, and how long all of them take."""
    from studies.runner.time_left import duration_text

    there = [[each.study, f"{each.state} {each.remark}".strip()] for each in studies]
    if quick:
        print_table("What there is", ["study", "result"], there)
        return
    times = [[duration_text(each.training_seconds), duration_text(each.other_seconds)] for each in studies]
    cells = [line + taken + [_without(each.unknown)] for line, taken, each in zip(there, times, studies, strict=True)]
    titles = ["study", "result", "training", "the rest", "without"]
    print_table("What there is, and how long a whole run takes the processor", titles, cells)
    whole = sum(each.training_seconds + each.other_seconds / processes for each in studies)
    on = "one process" if processes == 1 else f"{processes} processes"
    click.echo(
        f"A whole run takes {duration_text(whole)} on {on}, where a processor is as fast as that of the results."
    )
    if any(each.unknown for each in studies):
        click.echo("No result says how long those steps take that it is without.")


def _without(steps: "Sequence[str]") -> str:
    return f"{steps[0]}, {len(steps) - 1} more" if len(steps) > 1 else "".join(steps)


@click.command(epilog="Example: cfplan study figures results docs/images")
@click.argument("results", metavar="[RESULTS]", type=click.Path(path_type=Path), default=Path("results"))
@click.argument("images", metavar="[IMAGES]", type=click.Path(path_type=Path), default=Path("docs/images"))
def figures(results: Path, images: Path) -> None:
    """Draw the paper's figures from the JSON in RESULTS, as .png in IMAGES; those without a result are left out."""
    from studies.paper.figures import write_figures

    for file, reason in write_figures(results, images):
        click.echo(f"{file}: left out: {reason}" if reason else file)


COMMANDS = (architectures, inputs, robustness, baselines, hardware, yaw_consistency, simulators, paper, figures)
