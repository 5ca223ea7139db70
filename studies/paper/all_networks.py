"""Train the networks of the paper's simulated tables one after another; a training that was stopped resumes."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType

from cfplan.errors import InputError
from cfplan.learning.checkpoints import Epoch
from studies.paper import architectures, inputs, robustness
from studies.paper.sequences import read_sequences
from studies.paper.trained import DATA_COMMAND, TESTED
from studies.paper.training import Training, load_network, train_network

ALL = MappingProxyType({
    each.name: each
    for each in (
        *architectures.wanted(architectures.Settings()), *inputs.WANTED,
        *robustness.MODELS.values(),
    )
})  # fmt: skip
"""The networks by name, in the order in which they are trained."""


def train_all(
    data: Path, folder: Path, names: Sequence[str] = (), on_epoch: Callable[[str, Epoch], None] = lambda *_: None
) -> Iterator[tuple[str, Training]]:
    """Train the networks of these names, by default all, and yield each with its training when it is finished.

    Raises:
        InputError: no dataset, an unknown name, or a folder that holds other networks.
    """
    if unknown := sorted({*names} - {*ALL}):
        raise InputError(f"no network {unknown[0]!r}", where="networks", hint=f"known: {', '.join(ALL)}")
    if not data.is_dir():
        raise InputError("no such dataset", where=str(data), hint=f"make it: {DATA_COMMAND}")
    known = read_sequences(data).learned_from(TESTED)
    for name in names or ALL:
        loaded = load_network(folder / name, known, ALL[name])
        if loaded is None:
            train_network(known, folder / name, ALL[name], on_epoch=partial(on_epoch, name))
            loaded = load_network(folder / name, known, ALL[name])
        assert loaded is not None
        yield name, loaded[1]
