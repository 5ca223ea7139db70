"""Search learning rate and width of each of the paper's architectures, with the same budget for each.

Every candidate is trained by a short rule, until its validation loss is nearly flat. The least validation loss of an
architecture determines the rate and the width with which its networks are trained.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from cfplan.errors import InputError
from cfplan.learning.dataset import make_dataset
from studies.paper.architectures import OF_KIND
from studies.paper.networks import SIZES, Kind
from studies.paper.sequences import read_sequences
from studies.paper.trained import DATA, DATA_COMMAND, QUICK, QUICK_EPOCHS, QUICK_TESTED, TESTED, quick_spec
from studies.paper.training import SequenceOptions, UntilFlat, load_network, train_network
from studies.runner.options import option
from studies.runner.result import Column, Table, table
from studies.runner.study import Run, Study, Work

SHORT = UntilFlat(patience=2, improvement=0.05, cuts=2, most=20)
CANDIDATES = ((1.0, 1.0), (1 / 3, 1.0), (3.0, 1.0), (1.0, 0.5), (1.0, 1.5))  # factors of learning rate and of width


@dataclass(frozen=True, slots=True)
class Settings:
    """The paths to learn from."""

    kinds: tuple[Kind, ...] = option(tuple(Kind), "Architecture.")
    data: Path = option(DATA, "Dataset; its first 100 paths are for testing.")
    quick: bool = option(False, QUICK)


@dataclass(frozen=True, slots=True)
class Searched:
    """One candidate, trained."""

    kind: Kind
    rate: float  # the highest learning rate
    width: int
    parameters: int
    epochs: int
    unseen_loss: float
    seconds: float  # s of processor time


COLUMNS = (
    Column("kind", "architecture"),
    Column("rate", "learning rate", "", ".1g", meaning="the highest"),
    Column("width", "width"),
    Column("parameters", "parameters"),
    Column("epochs", "epochs", meaning=f"patience {SHORT.patience}, improvement {100 * SHORT.improvement:g} %, "
           f"{SHORT.cuts} cuts of the rate, at most {SHORT.most}"),
    Column("unseen_loss", "validation loss", "", ".4f", meaning="the least; comparable within an architecture"),
    Column("seconds", "training", "s", ".0f", meaning="of the processor, one thread"),
)  # fmt: skip


def work(settings: Settings, run: Run) -> Work:
    """Return one case per candidate. Raises InputError, with the command that makes it, if there is no dataset."""
    data, until, tested = settings.data, SHORT, TESTED
    if settings.quick:
        data, until, tested = run.scratch / "data", replace(SHORT, most=QUICK_EPOCHS), QUICK_TESTED
        make_dataset(data, quick_spec())
    if not data.is_dir():
        raise InputError("no such dataset", where=str(data), hint=f"make it: {DATA_COMMAND}")
    cases = {
        f"{kind}, rate {each.highest_rate:.1g}, width {each.width}": each
        for kind in settings.kinds
        for each in candidates(Kind(kind), until)
    }
    return Work(cases, partial(measure, data, tested, run.scratch), Searched)


def candidates(kind: Kind, until: UntilFlat = SHORT) -> list[SequenceOptions]:
    """Return the options of an architecture's candidates, the one in use first."""
    usual = OF_KIND[kind]
    return [
        replace(usual, until=until, rate=rate * usual.rate, width=round(width * SIZES[kind].width / 16) * 16)
        for rate, width in CANDIDATES
    ]


def measure(data: Path, tested: int, scratch: Path, options: SequenceOptions) -> Searched:
    """Train one candidate."""
    known = read_sequences(data).learned_from(tested)
    folder = scratch / f"{options.name}-rate-{options.rate:g}"
    network = train_network(known, folder, options)
    loaded = load_network(folder, known, options)
    assert loaded is not None
    assert options.width is not None
    return Searched(
        options.kind, options.highest_rate, options.width, sum(tensor.numel() for tensor in network.parameters()),
        loaded[1].epochs, loaded[1].unseen_loss, loaded[1].seconds,
    )  # fmt: skip


def tables(settings: Settings, rows: list[Searched]) -> Iterator[Table]:
    """Yield a row per candidate."""
    yield table("search", "Learning rate and width, the first of each architecture in use", COLUMNS, rows,
                by=("kind", "rate", "width"))  # fmt: skip


STUDY = Study(Settings, work, tables, "-o results/search.json")
