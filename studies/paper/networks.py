"""The networks of the paper's studies: read where they are trained, else trained first, resumed if need be."""

import hashlib
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from cfplan.errors import InputError
from cfplan.geometry.path import Path as PathOfMotion
from cfplan.geometry.yaw import YawMode
from cfplan.learning.checkpoints import Epoch
from cfplan.learning.dataset import make_dataset
from cfplan.learning.dataset_spec import DatasetSpec
from cfplan.learning.paper.networks import SequenceNetwork
from cfplan.learning.paper.sequences import Sequences, read_sequences
from cfplan.learning.paper.training import SequenceOptions, load_network, train_network
from cfplan.safety.limit_sets import BOXES, PAPER
from studies.runner.items import HERE, Progress, Running
from studies.paper.printed import TEST, TRAIN

DATA, NETWORKS = Path("datasets/paper"), Path("datasets/paper-networks")
TESTED = 100  # first rows of the dataset, from which nothing is learned
WAYPOINTS = 4
NODES = 99  # intervals: 100 points
DATA_COMMAND = (
    "cfplan dataset make datasets/paper --count 10100 --seed 1 --limits paper --box 10x10x10 --waypoints 4-4 "
    "--nodes 99 --yaw free"
)
QUICK_PATHS, QUICK_EPOCHS = 40, 2


@dataclass(frozen=True, slots=True)
class PaperData:
    """The paths of the paper's studies, and where their networks are kept."""

    parts: dict[str, Sequences]  # TRAIN: of those learned from the first ones; TEST
    learned_from: Sequences
    folder: Path
    epochs: int | None = None  # None: as many as the options say


@dataclass(frozen=True, slots=True)
class TrainedNetwork:
    """A network ready to be asked."""

    name: str
    options: SequenceOptions
    network: SequenceNetwork
    training_seconds: float  # of the processor


@contextmanager
def paper_data(
    data: Path, networks: Path, paths: int, *, epochs: int | None = None, quick: bool = False
) -> Iterator[PaperData]:
    """Yield `paths` paths for training and for testing each; `quick`: a few of its own, in a folder that goes away.

    Raises InputError where there is no such dataset, or too small a one; says which command makes it.
    """
    if quick:
        with tempfile.TemporaryDirectory() as folder:
            made = Path(folder) / "data"
            make_dataset(made, quick_spec())
            yield _parts(read_sequences(made), Path(folder), min(paths, 4), QUICK_PATHS // 2, QUICK_EPOCHS)
        return
    if not data.is_dir():
        raise InputError("no such dataset", where=str(data), hint=f"make it: {DATA_COMMAND}")
    yield _parts(read_sequences(data), networks, paths, TESTED, epochs)


@contextmanager
def labelled_data(
    folder: Path, spec: DatasetSpec, progress: Progress, *, running: Running = HERE, epochs: int | None = None,
    quick: bool = False,
) -> Iterator[PaperData]:  # fmt: skip
    """Yield the dataset of `spec` to learn from, labelled first where it is not there; networks are kept beside it.

    `quick`: a few paths, in a folder that goes away. Raises InputError where the folder holds another dataset.
    """
    if quick:
        with tempfile.TemporaryDirectory() as passing:
            few = replace(spec, count=QUICK_PATHS // 2)
            with labelled_data(Path(passing), few, progress, running=running, epochs=QUICK_EPOCHS) as material:
                yield material
        return
    done = 0

    def show(rows: int) -> None:
        nonlocal done
        done += rows
        progress(done, spec.rows)

    data = folder / "data"
    make_dataset(data, spec, workers=running.workers, scheduler=running.scheduler, on_rows=show)
    yield PaperData({}, read_sequences(data).learned_from(0), folder, epochs)


class PaperItem(NamedTuple):
    """One path of the dataset, with which a study works."""

    part: str
    row: int
    path: PathOfMotion


def paper_items(data: PaperData) -> dict[str, PaperItem]:
    """Return the paths for training and for testing, by a name."""
    return {
        f"{part} {row}": PaperItem(part, int(row), path)
        for part, sequences in data.parts.items()
        for row, path in zip(sequences.rows, sequences.paths, strict=True)
    }


def quick_spec() -> DatasetSpec:
    """Return a dataset of the paper's kind that is made in a second."""
    return DatasetSpec(
        count=QUICK_PATHS, seed=1, limits=PAPER.name, families=(), boxes=(BOXES["10x10x10"],),
        waypoints=(WAYPOINTS, WAYPOINTS), nodes=NODES, yaw=YawMode.FREE,
    )  # fmt: skip


def _parts(read: Sequences, folder: Path, paths: int, tested: int, epochs: int | None) -> PaperData:
    known, unseen = read.learned_from(tested), read.tested(tested)
    if not 1 <= paths <= min(len(known.rows), len(unseen.rows)):
        raise InputError(
            f"{paths} paths of {len(unseen.rows)} for testing and {len(known.rows)} for training",
            where="paths",
            hint=f"give fewer, at least 1, or make more: {DATA_COMMAND}",
        )
    parts = {TRAIN: known.part(slice(0, paths)), TEST: unseen.part(slice(0, paths))}
    return PaperData(parts, known, folder, epochs)


def trained_networks(data: PaperData, wanted: Sequence[SequenceOptions], progress: Progress) -> list[TrainedNetwork]:
    """Return the networks, those not trained yet after training; `progress` is told of their epochs."""
    options = [replace(each, epochs=data.epochs) if data.epochs else each for each in wanted]
    total, done = sum(each.epochs for each in options), 0
    found = []
    for each in options:

        def show(epoch: Epoch, before: int = done) -> None:
            progress(before + epoch.epoch, total)

        folder = data.folder / each.name
        loaded = load_network(folder, data.learned_from, each)
        if loaded is None:
            train_network(data.learned_from, folder, each, on_epoch=show)
            loaded = load_network(folder, data.learned_from, each)
        assert loaded is not None
        done += each.epochs
        progress(done, total)
        found.append(TrainedNetwork(each.name, each, *loaded))
    return found


def identities(trained: Sequence[TrainedNetwork]) -> dict[str, Any]:
    """Return what tells networks of the same names from others: their options, and a digest of their weights."""
    return {each.name: {**asdict(each.options), "weights": _digest(each.network)} for each in trained}


def _digest(network: SequenceNetwork) -> str:
    weights = b"".join(tensor.numpy().tobytes() for tensor in network.state_dict().values())
    return hashlib.sha256(weights).hexdigest()
