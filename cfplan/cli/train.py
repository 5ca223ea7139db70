"""`cfplan train`: train a model on a dataset."""

import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cfplan.cli import options
from cfplan.cli.output import print_json
from cfplan.errors import InputError

if TYPE_CHECKING:
    from rich.progress import Progress


@click.command(
    short_help="Train a model of the expert on a dataset.",
    epilog="Example: cfplan train datasets/hardware -o models/hardware --epsilon 0.001",
)
@click.argument("dataset", metavar="DATASET", type=click.Path(path_type=Path))
@click.option("-o", "--output", "folder", type=click.Path(path_type=Path), required=True, help="Model folder to write.")
@click.option(
    "--architecture",
    type=click.Choice(["bilstm", "attention"]),
    default="bilstm",
    show_default=True,
    help="Bidirectional LSTM, or the paper's encoder-decoder with attention.",
)
@click.option("--hidden", type=int, default=40, show_default=True, help="Size of each LSTM, in each direction.")
@click.option("--layers", type=int, default=2, show_default=True)
@click.option("--window", type=int, default=64, show_default=True, help="Intervals that the network sees at once.")
@click.option("--epochs", type=int, default=40, show_default=True)
@click.option("--windows", type=int, default=2, show_default=True, help="Windows of each path per epoch.")
@click.option("--batch", type=int, default=64, show_default=True, help="Windows per step.")
@click.option("--rate", type=float, default=2e-3, show_default=True, help="Highest learning rate.")
@click.option("--epsilon", type=float, default=0.0, help="Perturb the paths of half the windows by at most this, m.")
@click.option("--seed", type=int, default=0, show_default=True)
@click.option(
    "--start",
    type=click.Path(path_type=Path),
    metavar="MODEL",
    help="Model folder to take initial weights from.  [default: random weights]",
)
@click.option("--device", default="cpu", show_default=True, help="cpu or cuda; several GPUs under torchrun.")
@options.as_json
def train(dataset: Path, folder: Path, device: str, as_json: bool, **what: Any) -> None:
    """Train a model on DATASET. An interrupted training resumes after its last complete epoch."""
    if not dataset.is_dir():  # before torch is loaded, which takes seconds
        raise InputError("no such dataset", where=str(dataset), hint="make one: `cfplan dataset make` says how")
    try:
        from cfplan.learning.checkpoints import Epoch
        from cfplan.learning.networks import Architecture
        from cfplan.learning.training import Options, train
    except ModuleNotFoundError as error:
        if error.name not in ("torch", "safetensors", "matplotlib"):
            raise
        raise InputError(
            f"training needs {error.name}", where="cfplan train", hint='pip install "cfplan[learn]"'
        ) from None
    chosen = Options(**what | {"architecture": Architecture(what["architecture"])})
    with _progress(as_json) as progress:
        task = progress.add_task("", total=chosen.epochs)

        def show(epoch: Epoch) -> None:
            progress.update(task, completed=epoch.epoch, description=_line(epoch))
            if not progress.console.is_terminal:
                more = f"loss {epoch.loss:.2e}, {epoch.seconds:.1f} s"
                progress.console.print(f"epoch {epoch.epoch} of {chosen.epochs}: {_line(epoch)}, {more}")

        card = train(dataset, folder, chosen, device=device, command=_command(), on_epoch=show)
    if card is None:
        return
    if as_json:
        print_json(asdict(card))
    else:
        scores = card.scores
        click.echo(
            f"{folder}: travel time of unseen paths off by {scores['time_error_mean']:.2%} in the mean, "
            f"{scores['time_error_p95']:.2%} at the 95th percentile\n"
            f"plan with it: cfplan plan PATH --model {folder}"
        )


def _progress(as_json: bool) -> "Progress":
    """Return a progress bar with epochs, time passed and time left."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("epochs"), BarColumn(10), MofNCompleteColumn(), TextColumn("{task.description}"),
        TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(elapsed_when_finished=False),
    )  # fmt: skip
    return Progress(*columns, console=Console(stderr=True, quiet=as_json), speed_estimate_period=600)


def _line(epoch: Any) -> str:
    return f"time off by {epoch.time_error_mean:.2%}, p95 {epoch.time_error_p95:.2%}"


def _command() -> str:
    """Return the command as typed, with absolute paths reduced to their last part."""
    return " ".join(["cfplan", *(Path(word).name if Path(word).is_absolute() else word for word in sys.argv[1:])])
