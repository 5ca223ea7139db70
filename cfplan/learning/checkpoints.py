"""What a training leaves behind each epoch, so that it can go on after a kill: a checkpoint, and a table of epochs."""

import csv
import io
from dataclasses import asdict, dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch
from torch import nn, optim

from cfplan.errors import InputError

CHECKPOINT, LOG = "checkpoint.pt", "log.csv"


@dataclass(frozen=True, slots=True)
class Epoch:
    """What an epoch came to; a row of log.csv."""

    epoch: int
    loss: float
    unseen_loss: float
    time_error: float
    # mean of the relative errors of travel time, whole unseen paths, as a chain flies them
    time_error_mean: float
    # of their absolute values
    time_error_p95: float
    rate: float
    seconds: float
    # that the epoch took


def save_checkpoint(
    folder: Path, identity: dict[str, Any], network: nn.Module, optimiser: optim.Optimizer, log: list[Epoch]
) -> None:
    """Everything that going on needs, and the log as a table; each whole or not at all."""
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
        temporary = folder / f".{name}.new"
        temporary.write_bytes(data)
        temporary.replace(folder / name)


def resume(
    folder: Path, identity: dict[str, Any], network: nn.Module, optimiser: optim.Optimizer, place: torch.device
) -> list[Epoch]:
    """Go on from the folder's checkpoint, where it has one: its log, which is empty where there is none.

    Raises:
        InputError: a damaged checkpoint, or that of another training.
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
            if there[part].get(name) != value
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
