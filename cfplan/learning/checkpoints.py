"""Checkpoints from which a killed training resumes, and the log of epochs as a table and a picture."""

import csv
import io
from dataclasses import asdict, dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch
from torch import nn, optim

from cfplan.errors import InputError
from cfplan.files.atomic import atomic_write

CHECKPOINT, LOG = "checkpoint.pt", "log.csv"


@dataclass(frozen=True, slots=True)
class Epoch:
    """The losses and errors after an epoch; a row of log.csv."""

    epoch: int
    loss: float
    unseen_loss: float
    time_error: float  # mean relative error of travel time on complete unseen paths
    time_error_mean: float  # of the absolute errors
    time_error_p95: float
    rate: float
    seconds: float  # duration of the epoch


def save_checkpoint(
    folder: Path, identity: dict[str, Any], network: nn.Module, optimiser: optim.Optimizer, log: list[Epoch]
) -> None:
    """Write everything that resuming needs, and the log as a table; each file atomically."""
    content = {
        "identity": identity,
        "network": network.state_dict(),
        "optimiser": optimiser.state_dict(),
        "log": [asdict(epoch) for epoch in log],
    }
    buffer = io.BytesIO()
    torch.save(content, buffer)
    table = io.StringIO()
    writer = csv.DictWriter(table, Epoch.__slots__, lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(epoch) for epoch in log)
    folder.mkdir(parents=True, exist_ok=True)
    for name, data in ((CHECKPOINT, buffer.getvalue()), (LOG, table.getvalue().encode())):
        with atomic_write(folder / name) as unfinished:
            unfinished.write_bytes(data)


def resume(
    folder: Path, identity: dict[str, Any], network: nn.Module, optimiser: optim.Optimizer, place: torch.device
) -> list[Epoch]:
    """Load the folder's checkpoint into network and optimiser, if there is one; return its log.

    The number of epochs may differ: the learning rate then falls towards the new end.

    Raises:
        InputError: a damaged checkpoint, or one of a different training.
    """
    file = folder / CHECKPOINT
    if not file.exists():
        return []
    try:
        content = torch.load(file, map_location=place, weights_only=True)
        there = content["identity"]
        different = [
            f"{name} {there[part].get(name)} there, {value} here"
            for part in ("options", "data")
            for name, value in identity[part].items()
            if there[part].get(name) != value and name != "epochs"
        ]
        if different or there["features"] != identity["features"]:
            raise InputError(
                f"holds another training: {'; '.join(different) or 'of other features'}",
                where=str(folder),
                hint=f"give another folder, or delete its {CHECKPOINT}",
            )
        network.load_state_dict(content["network"])
        optimiser.load_state_dict(content["optimiser"])
        return [Epoch(**row) for row in content["log"]]
    except (
        OSError,
        RuntimeError,
        ValueError,
        LookupError,
        TypeError,
        AttributeError,
        EOFError,
        UnpicklingError,
    ) as error:
        reason = " ".join(str(error).split())[:120]
        raise InputError(f"cannot be read: {reason}", where=str(file), hint="delete it to begin again") from None


def draw_curves(log: list[Epoch], file: Path) -> None:
    """Draw the losses and the errors of travel time on unseen paths by epoch, as a PNG."""
    from matplotlib.figure import Figure

    epochs = [epoch.epoch for epoch in log]
    figure = Figure(figsize=(9, 3.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.semilogy(epochs, [epoch.loss for epoch in log], label="learned from")
    left.semilogy(epochs, [epoch.unseen_loss for epoch in log], label="unseen")
    left.set(xlabel="epoch", ylabel="loss")
    right.semilogy(epochs, [100 * epoch.time_error_mean for epoch in log], label="mean")
    right.semilogy(epochs, [100 * epoch.time_error_p95 for epoch in log], label="95th percentile")
    right.set(xlabel="epoch", ylabel="travel time, |error| on unseen paths, %")
    for axes in (left, right):
        axes.legend()
        axes.grid(alpha=0.3)
    figure.savefig(file, dpi=120)
