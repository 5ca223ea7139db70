"""The paths and networks of the paper's studies: read a dataset, and load its networks or train them first.

Interrupted training resumes from its last epoch.
"""

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from cfplan.errors import InputError
from cfplan.geometry.path import Path as PathOfMotion
from cfplan.geometry.yaw import YawMode
from cfplan.learning.dataset import make_dataset
from cfplan.learning.dataset_spec import DatasetSpec
from cfplan.safety.limit_sets import BOXES, PAPER
from studies.paper.networks import SequenceNetwork
from studies.paper.printed import TEST, TRAIN
from studies.paper.sequences import Sequences, read_sequences
from studies.paper.training import SequenceOptions, Training, UntilFlat, load_network, train_network
from studies.runner.options import option
from studies.runner.result import Column
from studies.runner.study import Run

DATA, NETWORKS = Path("datasets/paper"), Path("datasets/paper-networks")
TESTED = 100  # first rows of the dataset, reserved for testing
WAYPOINTS = 4
NODES = 99  # grid intervals: 100 points
DATA_COMMAND = (
    "cfplan dataset make datasets/paper --count 10100 --seed 1 --limits paper --box 10x10x10 --waypoints 4-4 "
    "--nodes 99 --yaw free"
)
QUICK_PATHS, QUICK_TESTED, QUICK_MOST, QUICK_EPOCHS = 40, 20, 4, 2  # epochs at most
QUICK = "Smoke test: a few paths and epochs, on data made for it."
EPOCHS = f"Epochs after which a training ends though its loss is not flat yet.  [default: {UntilFlat().most}]"
SEEDS = "Trainings of each LSTM, with different seeds."


@dataclass(frozen=True, slots=True)
class NetworkSettings:
    """The paths to plan, and the networks that plan them."""

    paths: int = option(100, "Number of training paths, and of test paths.", least=1)
    data: Path = option(DATA, "Dataset; its first 100 paths are for testing.")
    networks: Path = option(NETWORKS, "Folder of the networks; missing ones are trained.")
    epochs: int | None = option(None, EPOCHS, least=1)
    quick: bool = option(False, QUICK)


@dataclass(frozen=True, slots=True)
class TrainedNetwork:
    """A network ready for evaluation."""

    name: str
    options: SequenceOptions
    network: SequenceNetwork
    learned_from: int  # paths
    labels: str  # planner whose answers it learned
    trained: Training

    @property
    def training(self) -> dict[str, Any]:
        """Return the figures of the training tables, which each row of the network carries."""
        return {
            "network": self.options.model,
            "seed": self.options.seed,
            "parameters": sum(tensor.numel() for tensor in self.network.parameters()),
            "rate": self.options.highest_rate,
            "learned_from": self.learned_from,
            "labels": self.labels,
            **asdict(self.trained),
        }


def _of_training(key: str, title: str, unit: str = "", spec: str = "", meaning: str = "") -> Column:
    return Column(key, title, unit, spec, meaning=meaning, value=lambda rows: _mean_of(rows, key))


def _mean_of(rows: Sequence[Any], key: str) -> Any:
    """Return the figure of the rows' training, or its mean over trainings with different seeds."""
    by_seed = {row.training["seed"]: row.training[key] for row in rows}
    values = list(by_seed.values())
    return values[0] if isinstance(values[0], str) else sum(values) / len(values)


TRAINING_COLUMNS = (
    Column("seeds", "seeds", meaning="trainings; other figures are means over them",
           value=lambda rows: len({row.training["seed"] for row in rows})),
    _of_training("learned_from", "paths learned from", spec=".0f"),
    _of_training("labels", "labels by"),
    _of_training("rate", "learning rate", spec=".1g", meaning="the highest"),
    _of_training("epochs", "epochs", spec=".0f"),
    _of_training("best", "best epoch", spec=".0f", meaning="its network is kept"),
    _of_training("loss", "loss", spec=".4f", meaning="of the last epoch, on the paths learned from"),
    _of_training("unseen_loss", "validation loss", spec=".4f", meaning="of the best epoch"),
    Column("flat", "flat", meaning="trainings that ended because the validation loss was flat", of="seeds",
           value=lambda rows: len({row.training["seed"] for row in rows if row.training["flat"]})),
    _of_training("seconds", "training", "s", ".0f", meaning="of the processor, one thread"),
)  # fmt: skip
PARAMETERS = _of_training("parameters", "parameters", spec=".0f")


class PaperPath(NamedTuple):
    """One path of the dataset."""

    part: str  # TRAIN or TEST
    row: int  # of the dataset
    path: PathOfMotion


@dataclass(frozen=True, slots=True)
class PaperData:
    """The paths of a study, and the networks that it evaluates."""

    paths: dict[str, PaperPath]  # by case name: first TRAIN, then TEST
    networks: list[TrainedNetwork]
    identity: dict[str, Any]  # of dataset and networks

    def part(self, name: str) -> dict[str, PaperPath]:
        """Return the paths of one part."""
        return {case: each for case, each in self.paths.items() if each.part == name}


def paper_data(
    settings: NetworkSettings, run: Run, wanted: Sequence[SequenceOptions], paths: int | None = None
) -> PaperData:
    """Return the paths of a study, by default as many as its settings ask for, and the `wanted` networks.

    Raises InputError, with the command that makes the dataset, if there is none or it is too small.
    """
    count = settings.paths if paths is None else paths
    data, folder, tested, epochs = settings.data, settings.networks, TESTED, settings.epochs
    if settings.quick:
        data, folder, tested, epochs = run.scratch / "data", run.scratch, QUICK_TESTED, QUICK_EPOCHS
        count = min(count, QUICK_MOST)
        make_dataset(data, quick_spec())
    if not data.is_dir():
        raise InputError("no such dataset", where=str(data), hint=f"make it: {DATA_COMMAND}")
    read = read_sequences(data)
    known, unseen = read.learned_from(tested), read.tested(tested)
    if count > min(len(known.rows), len(unseen.rows)):
        raise InputError(
            f"{count} paths of {len(unseen.rows)} for testing and {len(known.rows)} for training",
            where="paths",
            hint=f"give fewer, or make more: {DATA_COMMAND}",
        )
    networks = trained_networks(known, folder, wanted, run, epochs)
    found = {
        f"{part} {row}": PaperPath(part, int(row), path)
        for part, sequences in ((TRAIN, known), (TEST, unseen))
        for row, path in zip(sequences.rows[:count], sequences.paths[:count], strict=True)
    }
    return PaperData(found, networks, {"data": asdict(read.spec), "networks": identities(networks)})


def quick_spec() -> DatasetSpec:
    """Return the spec of a dataset of the paper's kind that takes a second to make."""
    return DatasetSpec(
        count=QUICK_PATHS, seed=1, limits=PAPER.name, families=(), boxes=(BOXES["10x10x10"],),
        waypoints=(WAYPOINTS, WAYPOINTS), nodes=NODES, yaw=YawMode.FREE,
    )  # fmt: skip


def trained_networks(
    sequences: Sequences, folder: Path, wanted: Sequence[SequenceOptions], run: Run, epochs: int | None = None
) -> list[TrainedNetwork]:
    """Return the `wanted` networks of a folder, training those that are missing, for at most `epochs` epochs.

    Raises InputError if the folder holds networks of another training.
    """
    found = []
    for done, each in enumerate(wanted):
        if epochs is not None:
            each = replace(each, until=replace(each.until, most=epochs))
        run.progress(done, len(wanted))
        loaded = load_network(folder / each.name, sequences, each)
        if loaded is None:
            train_network(sequences, folder / each.name, each)
            loaded = load_network(folder / each.name, sequences, each)
        assert loaded is not None
        found.append(TrainedNetwork(each.name, each, loaded[0], len(sequences.rows), sequences.spec.planner, loaded[1]))
    run.progress(len(wanted), len(wanted))
    return found


def identities(trained: Iterable[TrainedNetwork]) -> dict[str, Any]:
    """Return an identity by network name: options, and a digest of the weights."""
    return {each.name: {**asdict(each.options), "weights": _digest(each.network)} for each in trained}


def _digest(network: SequenceNetwork) -> str:
    weights = b"".join(tensor.numpy().tobytes() for tensor in network.state_dict().values())
    return hashlib.sha256(weights).hexdigest()
