"""Train the paper's networks, by teacher forcing or on their own answers, one folder each; training is resumable.

Transformer and MLP learn by teacher forcing, on which the paper's explanation of their failures rests. The LSTM, which
according to the paper is fed its own answers, is trained that way in the second half of its epochs. Noise injection
follows the paper: half of the paths of an epoch are perturbed and keep the clean path's label. As an option that is not
in the paper, perturbed paths are solved again.
"""

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cfplan.errors import InputError
from cfplan.files.whole import whole
from cfplan.learning.checkpoints import CHECKPOINT, Epoch, resume, save_checkpoint
from cfplan.learning.dataset_spec import Relabel
from studies.paper.networks import Kind, SequenceNetwork, build_network
from studies.paper.recovery import nodal_time
from studies.paper.sequences import Inputs, Sequences, select_inputs

WEIGHTS = "weights.safetensors"
FORCED = (Kind.TRANSFORMER, Kind.MLP)  # trained by teacher forcing in all epochs
WARM_UP = 0.05  # fraction of the steps over which the learning rate rises; it then decays to zero along a cosine
CLIP = 1.0  # largest norm of the gradient
YAW = 0.1  # weight of the squared error of cos ψ relative to that of log h, both normalised
NOISE_EPOCHS = 5  # epochs between new perturbations
UNSEEN_SHARE = 0.05  # fraction of the paths on which each epoch is validated
FEATURES = "paper 1"  # version of the networks' inputs


@dataclass(frozen=True, slots=True, kw_only=True)
class SequenceOptions:
    """The options of a training; together with the sequences they determine the network."""

    kind: Kind = Kind.LSTM
    inputs: Inputs = Inputs.ALL
    epsilon: float = 0.0  # m, noise injection
    relabel: Relabel = Relabel.KEEP  # label of perturbed paths
    epochs: int = 14
    batch: int = 50
    rate: float = 3e-3  # the highest learning rate; a third of it for Transformers
    seed: int = 0

    @property
    def name(self) -> str:
        """Return the network's name, unique within a study."""
        noise = f"-{self.epsilon:g}" if self.epsilon else ""
        noise += "-solved" if self.relabel is Relabel.SOLVE else ""
        return f"{self.kind}{noise}" + ("" if self.inputs is Inputs.ALL else f"-{self.inputs.replace('/', '-')}")


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
    network = build_network(options.kind, options.inputs.width)
    unseen, known = _split(sequences, options.seed)
    network.set_units(_tensor(known.inputs, options), torch.from_numpy(known.answers))
    optimiser = torch.optim.Adam(network.parameters(), lr=options.rate)
    identity = _identity(sequences, options)
    log = resume(folder, identity, network, optimiser, torch.device("cpu"))
    perturb = _perturbations(known, options)
    while len(log) < options.epochs:
        begun = time.process_time()
        number = len(log)
        loss, rate = _run_epoch(network, optimiser, known, perturb, options, number)
        if not np.isfinite(loss):
            raise InputError(f"the loss is {loss} in epoch {number + 1}", where=str(folder), hint="lower the rate")
        judged = _judge(network, unseen, options)
        log.append(Epoch(number + 1, loss, *judged, rate, time.process_time() - begun))
        save_checkpoint(folder, identity, network, optimiser, log)
        on_epoch(log[-1])
    network.eval()
    _save(network, folder, identity, log)
    return network


def load_network(folder: Path, sequences: Sequences, options: SequenceOptions) -> tuple[SequenceNetwork, float] | None:
    """Return the network of `folder` and its training's processor time, s, or None if it is not trained yet.

    Raises:
        InputError: the weights of another training, or damaged ones.
    """
    from safetensors import SafetensorError, safe_open
    from safetensors.torch import load_file

    file = folder / WEIGHTS
    if not file.is_file():
        return None
    try:
        with safe_open(file, "pt") as opened:
            metadata = opened.metadata() or {}
        card = json.loads(metadata["card"])
        if card["identity"] != json.loads(json.dumps(_identity(sequences, options))):
            raise InputError("holds another training", where=str(folder), hint="give another folder, or delete it")
        network = build_network(options.kind, options.inputs.width)
        network.load_state_dict(load_file(file))
        seconds = float(card["seconds"])
    except (OSError, SafetensorError, ValueError, LookupError, TypeError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:120]
        raise InputError(f"cannot be read: {reason}", where=str(file), hint="delete it to train again") from None
    network.eval()
    return network, seconds


def answer(network: SequenceNetwork, inputs: NDArray, chosen: Inputs = Inputs.ALL) -> NDArray:
    """Return h and cos ψ, (R, N, 2), for path inputs, (R, N, 9)."""
    with torch.inference_mode():
        found: NDArray = network(torch.from_numpy(np.ascontiguousarray(select_inputs(inputs, chosen)))).numpy()
    return found


def _identity(sequences: Sequences, options: SequenceOptions) -> dict[str, Any]:
    decided = asdict(options)
    if options.relabel is Relabel.KEEP:
        del decided["relabel"]  # older trainings have no such option
    return {
        "options": json.loads(json.dumps(decided)),
        "data": {
            "dataset": json.loads(json.dumps(asdict(sequences.spec))),
            "rows": [int(sequences.rows[0]), int(sequences.rows[-1]), len(sequences.rows)],
        },
        "features": FEATURES,
    }


def _split(sequences: Sequences, seed: int) -> tuple[Sequences, Sequences]:
    """Return the validation set and the training set."""
    order = np.random.default_rng([seed, 0]).permutation(len(sequences.rows))
    count = max(1, round(UNSEEN_SHARE * len(order)))
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
    perturb: Callable[[int], Sequences], options: SequenceOptions, epoch: int,
) -> tuple[float, float]:  # fmt: skip
    """Train for one epoch; return the mean loss and the last learning rate."""
    random = np.random.default_rng([options.seed, 1, epoch])
    seen, answers = _tensor(known.inputs, options), torch.from_numpy(known.answers)
    if options.epsilon:
        noisy = perturb(epoch)
        moved = torch.from_numpy(random.uniform(size=len(seen)) < 0.5)[:, None, None]
        seen = torch.where(moved, _tensor(noisy.inputs, options), seen)
        answers = torch.where(moved, torch.from_numpy(noisy.answers), answers)
    order = torch.from_numpy(random.permutation(len(seen)))
    batches = torch.split(order, options.batch)
    total, rate = 0.0, 0.0
    network.train()
    for count, chosen in enumerate(batches):
        rate = _rate(options, (epoch * len(batches) + count) / (options.epochs * len(batches)))
        for group in optimiser.param_groups:
            group["lr"] = rate
        forced = options.kind in FORCED or (options.kind is Kind.LSTM and 2 * epoch < options.epochs)
        fed = answers[chosen] if forced else None
        loss = _loss(network, network(seen[chosen], fed), answers[chosen])
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), CLIP)
        optimiser.step()
        total += loss.item() * len(chosen)
    return total / len(order), rate


def _judge(network: SequenceNetwork, unseen: Sequences, options: SequenceOptions) -> tuple[float, float, float, float]:
    """Return the loss and the errors of travel time on unseen paths, without teacher forcing."""
    network.eval()
    found = answer(network, unseen.inputs, options.inputs)
    loss = _loss(network, torch.from_numpy(found), torch.from_numpy(unseen.answers)).item()
    errors = nodal_time(found, unseen.end) / nodal_time(unseen.answers, unseen.end) - 1.0
    return loss, float(errors.mean()), float(np.abs(errors).mean()), float(np.quantile(np.abs(errors), 0.95))


def _loss(network: SequenceNetwork, found: Tensor, wanted: Tensor) -> Tensor:
    squares = (network.scaled(found) - network.scaled(wanted)).square().mean((0, 1))
    return squares[0] + YAW * squares[1]


def _rate(options: SequenceOptions, done: float) -> float:
    """Return the learning rate after a fraction `done` of the steps."""
    highest = options.rate / (3.0 if options.kind in (Kind.TRANSFORMER, Kind.ENCODER) else 1.0)
    return highest * min(1.0, (done + 1e-3) / WARM_UP) * 0.5 * (1.0 + math.cos(math.pi * done))


def _tensor(inputs: NDArray, options: SequenceOptions) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(select_inputs(inputs, options.inputs)))


def _save(network: SequenceNetwork, folder: Path, identity: dict[str, Any], log: list[Epoch]) -> None:
    """Write the weights atomically, and remove the checkpoint."""
    from safetensors.torch import save_file

    card = {"identity": identity, "seconds": sum(epoch.seconds for epoch in log), "last": asdict(log[-1])}
    weights = {name: tensor.contiguous() for name, tensor in network.state_dict().items()}
    with whole(folder / WEIGHTS) as unfinished:
        save_file(weights, unfinished, metadata={"card": json.dumps(card)})
    (folder / CHECKPOINT).unlink(missing_ok=True)
