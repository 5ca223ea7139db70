"""Train the paper's networks until their validation loss is flat, one folder each; training is resumable.

Transformer and MLPs learn by teacher forcing, as the paper's explanation of their failures assumes. The LSTM, which is
fed its own answers according to the paper, is fed its current ones; gradients do not pass through them. Noise injection
follows the paper: half of the paths of an epoch are perturbed and keep the clean path's label. As an option that is not
in the paper, perturbed paths are solved again.
"""

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

from cfplan.errors import InputError
from cfplan.files.atomic import atomic_write
from cfplan.learning.checkpoints import CHECKPOINT, Epoch, resume, save_checkpoint
from cfplan.learning.dataset_spec import Relabel
from studies.paper.networks import SIZES, Kind, SequenceNetwork, build_network
from studies.paper.recovery import nodal_time
from studies.paper.sequences import Inputs, Sequences, select_inputs

WEIGHTS, BEST = "weights.safetensors", "best.safetensors"  # of a finished training; of its best epoch until then
WARM_UP = 200  # steps over which the learning rate rises at first
CLIP = 1.0  # largest norm of the gradient
YAW = 0.01  # weight of the squared error of cos ψ relative to that of log h, both normalised
NOISE_EPOCHS = 5  # epochs between new perturbations
UNSEEN_FRACTION = 0.05  # fraction of the paths on which each epoch is validated
FEATURES = "paper 1"  # version of the networks' inputs, and of what they are validated by


@dataclass(frozen=True, slots=True, kw_only=True)
class UntilFlat:
    """The stopping rule of a training: its validation loss is flat at every learning rate.

    The loss is flat after `patience` epochs in which it stayed above (1 - `improvement`) of the least until then. The
    learning rate is then multiplied by `factor`, `cuts` times; when the loss is flat once more, the training ends. Its
    network is that of the epoch with the least validation loss.
    """

    patience: int = 5  # epochs
    improvement: float = 0.02  # relative
    cuts: int = 3
    factor: float = 1 / 3
    most: int = 300  # epochs, after which a training ends in any case

    def cuts_after(self, losses: Sequence[float]) -> int:
        """Return how often the rate has been cut, or `cuts` + 1 if the training has ended, by validation losses."""
        least, waited, cuts = np.inf, 0, 0
        for loss in losses:
            waited += 1
            if loss < (1.0 - self.improvement) * least:
                least, waited = loss, 0
            if waited >= self.patience:
                cuts, waited = cuts + 1, 0
        return self.cuts + 1 if len(losses) >= self.most else cuts

    def ended(self, losses: Sequence[float]) -> bool:
        """Return whether the training has ended."""
        return self.cuts_after(losses) > self.cuts


@dataclass(frozen=True, slots=True, kw_only=True)
class Training:
    """The figures of a finished training."""

    epochs: int
    best: int  # epoch with the least validation loss, whose network is kept
    loss: float  # of the last epoch, on the paths learned from
    unseen_loss: float  # of the best epoch, on validation paths
    seconds: float  # s of processor time
    flat: bool  # it ended because the validation loss was flat, not at the most epochs


@dataclass(frozen=True, slots=True, kw_only=True)
class SequenceOptions:
    """The options of a training; together with the sequences they determine the network."""

    kind: Kind = Kind.LSTM
    inputs: Inputs = Inputs.ALL
    epsilon: float = 0.0  # m, noise injection
    relabel: Relabel = Relabel.KEEP  # label of perturbed paths
    until: UntilFlat = UntilFlat()
    batch: int = 50
    rate: float = 3e-3  # the highest learning rate; a third of it for Transformers
    width: int | None = None  # of the network's layers; None: as in `SIZES`
    slopes: float = 0.0  # weight of the squared error of differences between nodes; 0 in the paper's networks
    seed: int = 0

    @property
    def highest_rate(self) -> float:
        """Return the learning rate before the first cut."""
        return self.rate / (3.0 if self.kind in (Kind.TRANSFORMER, Kind.ENCODER) else 1.0)

    @property
    def name(self) -> str:
        """Return the network's name, unique within a study."""
        return self.model + (f"-seed-{self.seed}" if self.seed else "")

    @property
    def model(self) -> str:
        """Return the name of its tables' rows, which trainings with different seeds share."""
        parts = (
            str(self.kind),
            f"{self.epsilon:g}" if self.epsilon else "",
            "solved" if self.relabel is Relabel.SOLVE else "",
            f"slopes-{self.slopes:g}" if self.slopes else "",
            f"width-{self.width}" if self.width else "",
            "" if self.inputs is Inputs.ALL else self.inputs.replace("/", "-"),
        )
        return "-".join(part for part in parts if part)


OURS = SequenceOptions(kind=Kind.BIDIRECTIONAL, slopes=10.0)
"""The network that is not in the paper: its loss counts errors of the slope of log h, which become acceleration."""


def train_network(
    sequences: Sequences,
    folder: Path,
    options: SequenceOptions,
    *,
    on_epoch: Callable[[Epoch], None] = lambda _: None,
) -> SequenceNetwork:
    """Train the network of `folder`, from its last checkpoint if there is one, and return it.

    Raises:
        InputError: fewer than three paths, another training in the folder, or a loss that is not a number.
    """
    if len(sequences.rows) < 3:
        raise InputError(f"{len(sequences.rows)} paths are too few to learn from", where="dataset", hint="make more")
    torch.manual_seed(options.seed)
    network = _built(options)
    unseen, known = _split(sequences, options.seed)
    network.set_units(_tensor(known.inputs, options), torch.from_numpy(known.answers))
    optimiser = torch.optim.Adam(network.parameters(), lr=options.rate)
    identity = _identity(sequences, options)
    log = resume(folder, identity, network, optimiser, torch.device("cpu"))
    perturb = _perturbations(known, options)
    while not options.until.ended([epoch.unseen_loss for epoch in log]):
        begun = time.process_time()
        learned, rate = _run_epoch(network, optimiser, known, perturb, options, log)
        if not np.isfinite(learned):
            raise InputError(f"the loss is {learned} in epoch {len(log) + 1}", where=str(folder), hint="lower the rate")
        judged = _judge(network, unseen, options)
        log.append(Epoch(len(log) + 1, learned, *judged, rate, time.process_time() - begun))
        if log[-1] is _best(log):
            _save(network, folder / BEST, {"epoch": len(log)})
        save_checkpoint(folder, identity, network, optimiser, log)
        on_epoch(log[-1])
    network.load_state_dict(load_file(folder / BEST))
    network.eval()
    best, validated = _best(log), [epoch.unseen_loss for epoch in log]
    training = Training(
        epochs=len(log), best=best.epoch, loss=log[-1].loss, unseen_loss=best.unseen_loss,
        seconds=sum(epoch.seconds for epoch in log), flat=options.until.ended(validated[: options.until.most - 1]),
    )  # fmt: skip
    _save(network, folder / WEIGHTS, {"identity": identity, "training": asdict(training)})
    for name in (CHECKPOINT, BEST):
        (folder / name).unlink(missing_ok=True)
    return network


def load_network(
    folder: Path, sequences: Sequences, options: SequenceOptions
) -> tuple[SequenceNetwork, Training] | None:
    """Return the network of `folder` and its training, or None if it is not trained yet.

    Raises:
        InputError: the weights of another training, or damaged ones.
    """
    file = folder / WEIGHTS
    if not file.is_file():
        return None
    try:
        with safe_open(file, "pt") as opened:
            metadata = opened.metadata() or {}
        card = json.loads(metadata["card"])
        if card["identity"] != json.loads(json.dumps(_identity(sequences, options))):
            raise InputError("holds another training", where=str(folder), hint="give another folder, or delete it")
        network = _built(options)
        network.load_state_dict(load_file(file))
        training = Training(**card["training"])
    except (OSError, SafetensorError, ValueError, LookupError, TypeError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:120]
        raise InputError(f"cannot be read: {reason}", where=str(file), hint="delete it to train again") from None
    network.eval()
    return network, training


def answer(network: SequenceNetwork, inputs: NDArray, chosen: Inputs = Inputs.ALL) -> NDArray:
    """Return h and cos ψ, (R, N, 2), for path inputs, (R, N, 9)."""
    with torch.inference_mode():
        found: NDArray = network(torch.from_numpy(np.ascontiguousarray(select_inputs(inputs, chosen)))).numpy()
    return found


def _identity(sequences: Sequences, options: SequenceOptions) -> dict[str, Any]:
    return {
        "options": json.loads(json.dumps(asdict(options))),
        "data": {
            "dataset": json.loads(json.dumps(asdict(sequences.spec))),
            "rows": [int(sequences.rows[0]), int(sequences.rows[-1]), len(sequences.rows)],
        },
        "features": FEATURES,
    }


def _split(sequences: Sequences, seed: int) -> tuple[Sequences, Sequences]:
    """Return the validation set and the training set."""
    order = np.random.default_rng([seed, 0]).permutation(len(sequences.rows))
    count = max(1, round(UNSEEN_FRACTION * len(order)))
    return sequences.part(np.sort(order[:count])), sequences.part(np.sort(order[count:]))


def _perturbations(known: Sequences, options: SequenceOptions) -> Callable[[int], Sequences]:
    """Return a function from an epoch to its perturbed paths, with a cache for the current ones."""

    @lru_cache(maxsize=1)
    def drawn(turn: int) -> Sequences:
        return known.perturbed_by(
            options.epsilon, np.random.SeedSequence(options.seed, spawn_key=(2, turn)), options.relabel
        )

    return lambda epoch: drawn(epoch // NOISE_EPOCHS)


def _run_epoch(
    network: SequenceNetwork, optimiser: torch.optim.Optimizer, known: Sequences,
    perturb: Callable[[int], Sequences], options: SequenceOptions, log: Sequence[Epoch],
) -> tuple[float, float]:  # fmt: skip
    """Train for the epoch after those of the log; return the mean loss and the learning rate."""
    epoch = len(log)
    random = np.random.default_rng([options.seed, 1, epoch])
    seen, answers = _tensor(known.inputs, options), torch.from_numpy(known.answers)
    if options.epsilon:
        noisy = perturb(epoch)
        moved = torch.from_numpy(random.uniform(size=len(seen)) < 0.5)[:, None, None]
        seen = torch.where(moved, _tensor(noisy.inputs, options), seen)
        answers = torch.where(moved, torch.from_numpy(noisy.answers), answers)
    batches = torch.split(torch.from_numpy(random.permutation(len(seen))), options.batch)
    rate, total = _rate(options, log), 0.0
    network.train()
    for count, chosen in enumerate(batches, start=epoch * len(batches)):
        for group in optimiser.param_groups:
            group["lr"] = rate * min(1.0, (count + 1) / WARM_UP)
        fed = _fed(network, seen[chosen], answers[chosen], options)
        h, yaw = losses(network, network(seen[chosen], fed), answers[chosen], options)
        value = h + YAW * yaw
        optimiser.zero_grad()
        value.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), CLIP)
        optimiser.step()
        total += value.item() * len(chosen)
    return total / len(seen), rate


def _fed(network: SequenceNetwork, seen: Tensor, answers: Tensor, options: SequenceOptions) -> Tensor:
    """Return the previous answers that a network is fed: the true ones, or its own at this moment."""
    if options.kind is not Kind.LSTM:
        return answers
    with torch.no_grad():
        own: Tensor = network(seen)
    return own


def _judge(network: SequenceNetwork, unseen: Sequences, options: SequenceOptions) -> tuple[float, float, float, float]:
    """Return the loss and the errors of travel time on unseen paths, without teacher forcing."""
    network.eval()
    found = answer(network, unseen.inputs, options.inputs)
    h, yaw = losses(network, torch.from_numpy(found), torch.from_numpy(unseen.answers), options)
    value = (h + YAW * yaw).item()
    errors = nodal_time(found, unseen.end) / nodal_time(unseen.answers, unseen.end) - 1.0
    return value, float(errors.mean()), float(np.abs(errors).mean()), float(np.quantile(np.abs(errors), 0.95))


def losses(network: SequenceNetwork, found: Tensor, wanted: Tensor, options: SequenceOptions) -> Tensor:
    """Return the losses of log h and of cos ψ of answers, (B, N, 2)."""
    errors = network.scaled(found) - network.scaled(wanted)
    return errors.square().mean((0, 1)) + options.slopes * errors.diff(dim=1).square().mean((0, 1))


def _rate(options: SequenceOptions, log: Sequence[Epoch]) -> float:
    """Return the learning rate of the epoch after those of the log."""
    return options.highest_rate * options.until.factor ** options.until.cuts_after([epoch.unseen_loss for epoch in log])


def _best(log: Sequence[Epoch]) -> Epoch:
    """Return the first epoch with the least validation loss."""
    return min(log, key=lambda epoch: epoch.unseen_loss)


def _built(options: SequenceOptions) -> SequenceNetwork:
    size = SIZES[options.kind]
    return build_network(options.kind, options.inputs.width, size._replace(width=options.width or size.width))


def _tensor(inputs: NDArray, options: SequenceOptions) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(select_inputs(inputs, options.inputs)))


def _save(network: SequenceNetwork, file: Path, card: dict[str, Any]) -> None:
    """Write the weights and their card atomically."""
    weights = {name: tensor.contiguous() for name, tensor in network.state_dict().items()}
    file.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(file) as unfinished:
        save_file(weights, unfinished, metadata={"card": json.dumps(card)})
