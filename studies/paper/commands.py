"""The commands of `python -m studies` that make all of the paper's tables, and its figures."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from studies.runner.cases import Effort
from studies.runner.commands import SCHEDULER, WORKERS, note, print_result, progress_bars

if TYPE_CHECKING:
    from cfplan.learning.checkpoints import Epoch


NETWORKS = click.option(
    "--networks", "folder", type=click.Path(path_type=Path), default=Path("datasets/paper-networks"),
    show_default=True, help="Folder of the networks.",
)  # fmt: skip


@click.command(epilog="Example: python -m studies paper results --workers 2")
@click.argument("folder", metavar="[DIR]", type=click.Path(path_type=Path), default=Path("results"))
@click.option("--quick", is_flag=True, help="Smoke test: a few paths and epochs, on data made for it.")
@WORKERS
@SCHEDULER
def paper(folder: Path, quick: bool, workers: int, scheduler: str | None) -> None:
    """Make the results of all of the paper's tables in DIR: train the networks, then run one study after another.

    Networks, and results of the present sources and settings, are kept, so that a run that was stopped resumes.
    """
    from studies.paper import trained
    from studies.paper.all_networks import train_all
    from studies.paper.all_tables import paper_results

    if not quick:
        for name, training in train_all(trained.DATA, trained.NETWORKS, on_epoch=_say_epoch):
            click.echo(f"{name}: {training.seconds:.0f} s of the processor")
    with progress_bars() as bar:
        effort = Effort(workers, scheduler, say=note, progress=bar)
        made = list(paper_results(folder, quick=quick, effort=effort))
    for each in made:
        print_result(each.result)
    for each in made:
        click.echo(f"{each.file}: {each.result.seconds:.0f} s of the processor{', kept' if each.kept else ''}")


@click.command(epilog="Example: python -m studies networks LSTM LSTM-seed-1")
@click.argument("names", metavar="[NAME]...", nargs=-1)
@click.option("--data", type=click.Path(path_type=Path), default=Path("datasets/paper"), show_default=True,
              help="Dataset; its first 100 paths are for testing.")  # fmt: skip
@NETWORKS
def networks(names: tuple[str, ...], data: Path, folder: Path) -> None:
    """Train the networks of the paper's simulated tables, by default all, until their validation loss is flat.

    A training that was stopped resumes from its last epoch; two commands may train different networks of one folder.
    """
    from studies.paper.all_networks import train_all

    for name, training in train_all(data, folder, names, on_epoch=_say_epoch):
        ended = "flat" if training.flat else "not flat"
        click.echo(
            f"{name}: {training.seconds:.0f} s of the processor, {training.epochs} epochs, validation loss {ended} at "
            f"{training.unseen_loss:.4f} since epoch {training.best}"
        )


def _say_epoch(name: str, epoch: "Epoch") -> None:
    note(f"{name}: epoch {epoch.epoch}, loss {epoch.loss:.4f}, validation loss {epoch.unseen_loss:.4f}")


@click.command(epilog="Example: python -m studies figures results docs/images")
@click.argument("results", metavar="[RESULTS]", type=click.Path(path_type=Path), default=Path("results"))
@click.argument("images", metavar="[IMAGES]", type=click.Path(path_type=Path), default=Path("docs/images"))
@NETWORKS
def figures(results: Path, images: Path, folder: Path) -> None:
    """Draw the paper's figures as .png in IMAGES from the rows of the cases in RESULTS and the networks' logs."""
    from studies.paper.figures import write_figures

    for file, reason in write_figures(results, images, folder):
        click.echo(f"{file}: left out: {reason}" if reason else file)
