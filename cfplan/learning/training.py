"""Train a network by imitation: from a dataset of the expert's profiles to a model folder.

Every epoch draws its windows by its own seed and ends with a checkpoint, so that a training that was killed resumes
with the same result; the best network so far is a model in the folder at any time. Under torchrun each process takes
its share of the windows, and the first one writes.
"""

import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, distributed
from torch.nn.parallel import DistributedDataParallel

from cfplan import __version__
from cfplan.errors import InputError
from cfplan.learning import features, inference
from cfplan.learning.checkpoints import Epoch, draw_curves, resume, save_checkpoint
from cfplan.learning.learned import Query, predict
from cfplan.learning.model_files import CARD, Card, load_card, load_weights, save_model
from cfplan.learning.networks import Architecture, build
from cfplan.learning.smooth import travel_time
from cfplan.learning.training_set import Labels, TrainingSet, draw, read_training_set, split
from cfplan.learning.windows import WINDOW
from cfplan.vehicle.yaw_spline import YawSpline

CURVES = "curves.png"
CHUNK = 4096  # windows drawn at once
WARM_UP = 0.05  # of the steps, over which the learning rate rises; then it falls to zero along a cosine
CLIP = 1.0  # largest norm of the gradient
NOISE_EPOCHS = 5  # between perturbations of the paths
_DATA, _NOISE, _UNSEEN = 1, 2, 3  # streams of random numbers of one seed
# Weights in the loss of squared errors, against those of the values: of the first and second difference between nodes,
# of the window's time (relative), and of the cosine and sine of yaw
SLOPES, BENDS, DURATION, YAW = 2.0, 5.0, 1.0, 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """Options of a training: with the dataset they decide its result."""

    architecture: Architecture = Architecture.BILSTM
    hidden: int = 40
    layers: int = 2
    window: int = WINDOW
    epochs: int = 40
    windows: int = 2  # drawn from each path in an epoch
    batch: int = 64
    rate: float = 2e-3  # the highest learning rate
    epsilon: float = 0.0  # m, noise injection: the paths of half the windows are perturbed by at most this
    seed: int = 0
    start: Path | None = None  # model folder whose weights it starts from; None: random ones

    def __post_init__(self) -> None:
        wrong = [
            ("hidden", not 1 <= self.hidden <= 4096, "from 1 to 4096"),
            ("layers", not 1 <= self.layers <= 8, "from 1 to 8"),
            ("window", not 8 <= self.window <= 4096, "from 8 to 4096"),
            ("epochs", self.epochs < 1, "at least 1"),
            ("windows", self.windows < 1, "at least 1"),
            ("batch", self.batch < 1, "at least 1"),
            ("rate", not 0 < self.rate < 1, "between 0 and 1"),
            ("epsilon", not 0 <= self.epsilon < float("inf"), "at least 0"),
            ("seed", not 0 <= self.seed < 2**63, "at least 0 and below 2^63"),
        ]
        for name, is_wrong, allowed in wrong:
            if is_wrong:
                raise InputError(
                    f"{name} is {getattr(self, name)}; it must be {allowed}",
                    where="training",
                    hint="see `cfplan train --help`",
                )


def train(
    dataset: Path,
    folder: Path,
    options: Options,
    *,
    device: str = "cpu",
    command: str = "",
    on_epoch: Callable[[Epoch], None] = lambda _: None,
) -> Card | None:
    """Train, or resume the training in the folder, and write the model. Returns None in all processes but the first.

    Raises:
        InputError: a dataset without usable rows, another training or a model in the folder, a start of another
            architecture, a device that is not there, or a loss that is not a number.
    """
    return train_on(read_training_set(dataset), folder, options, device=device, command=command, on_epoch=on_epoch)


def train_on(
    training_set: TrainingSet,
    folder: Path,
    options: Options,
    *,
    device: str = "cpu",
    command: str = "",
    on_epoch: Callable[[Epoch], None] = lambda _: None,
) -> Card | None:
    """Train on rows that are read already, else as train() does."""
    with processes(device) as (rank, world, place):
        run = _Run(training_set, folder, options, rank, world, place)
        try:
            if rank == 0 and run.log and run.improved:
                run.save(command)  # it may have been killed between checkpoint and model
            for epoch in run.epochs():
                if rank == 0 and run.improved:
                    run.save(command)
                on_epoch(epoch)
            return run.finish(command) if rank == 0 else None
        except OSError as error:
            raise InputError(
                f"cannot be written: {error.strerror or error}",
                where=str(folder),
                hint="make room, or name another folder, and give the same command again",
            ) from None


class _Run:
    """One process's part in a training."""

    def __init__(
        self, training_set: TrainingSet, folder: Path, options: Options, rank: int, world: int, place: torch.device
    ) -> None:
        self.folder, self.options, self.rank, self.world, self.place = folder, options, rank, world, place
        self.identity: dict[str, Any] = {
            "options": _plain(options),
            "data": _plain(training_set.spec),
            "features": features.VERSION,
        }
        self.seen, self.unseen = split(training_set, options.seed)
        self.noise: tuple[int, Labels] | None = None
        torch.manual_seed(options.seed)
        self.network = build(options.architecture, options.hidden, options.layers)
        self.started = None if options.start is None else self._start_from(options.start)
        if self.started is None:
            self._normalise()
        self.network.to(place)
        self.parallel: Any = DistributedDataParallel(self.network) if world > 1 else self.network
        self.optimiser = torch.optim.AdamW(self.network.parameters(), lr=options.rate, weight_decay=1e-4)
        per_process = len(self.seen.rows) * options.windows // world
        self.batch = max(1, min(options.batch // world, per_process))
        self.batches = per_process // self.batch
        self.unseen_windows = self._windows(self.unseen, np.tile(np.arange(len(self.unseen.rows)), 2), _UNSEEN, 0)
        self.log = resume(folder, self.identity, self.network, self.optimiser, place)
        if rank == 0 and not self.log and (folder / CARD).exists():
            raise InputError("holds a model without its training", where=str(folder), hint="name another folder")

    def epochs(self) -> Iterator[Epoch]:
        """Train and yield epoch by epoch."""
        for number in range(len(self.log) + 1, self.options.epochs + 1):
            began = time.perf_counter()
            learned = self._learn(number)
            if self.rank == 0:
                unseen, errors = self._unseen_loss(), self._time_errors()
                size = np.abs(errors)
                epoch = Epoch(
                    number, learned, unseen, float(errors.mean()), float(size.mean()), float(np.percentile(size, 95)),
                    self.optimiser.param_groups[0]["lr"], time.perf_counter() - began,
                )  # fmt: skip
                self.log.append(epoch)
                save_checkpoint(self.folder, self.identity, self.network, self.optimiser, self.log)
                yield epoch
            if self.world > 1:
                distributed.barrier()

    @property
    def improved(self) -> bool:
        """Return whether the last epoch is the best so far."""
        return self.log[-1].unseen_loss <= min(epoch.unseen_loss for epoch in self.log)

    def finish(self, command: str) -> Card:
        """Draw the picture of the log; return the card of the best network."""
        draw_curves(self.log, self.folder / CURVES)
        try:
            card = load_card(self.folder)
        except InputError:  # a checkpoint alone was left
            return self.save(command)
        return card

    def save(self, command: str) -> Card:
        """Write the network as a model; return its card."""
        spec, last, options = self.seen.spec, self.log[-1], self.options
        card = Card(
            name=self.folder.name,
            architecture=str(options.architecture),
            hidden=options.hidden,
            layers=options.layers,
            window=options.window,
            features=features.VERSION,
            weights_sha256="",
            ranges=self._ranges(),
            data=_plain(spec) | {"learned_from": len(self.seen.rows), "judged_on": len(self.unseen.rows)},
            training={"command": command, "seconds": round(sum(epoch.seconds for epoch in self.log), 1)}
            | _plain(options),
            scores={
                name: round(getattr(last, name), 6)
                for name in ("unseen_loss", "time_error", "time_error_mean", "time_error_p95")
            },
            date=datetime.now(UTC).isoformat(timespec="seconds"),
            version=__version__,
        )
        return save_model(self.folder, card, self._weights())

    def _ranges(self) -> dict[str, tuple[float, float]]:
        """Return the range of each number without dimension that was learned from, by the start's training too."""
        numbers = self.seen.labels.numbers
        if self.started is not None:
            numbers = np.concatenate([numbers, np.array(list(self.started.ranges.values())).T])
        return {
            name: (round(float(low), 6), round(float(high), 6))
            for name, low, high in zip(features.NUMBERS, numbers.min(axis=0), numbers.max(axis=0), strict=True)
        }

    def _learn(self, number: int) -> float:
        options = self.options
        rows = np.tile(np.arange(len(self.seen.rows)), options.windows)
        rows = np.random.default_rng([options.seed, _DATA, number]).permutation(rows)
        rows = rows[self.rank :: self.world][: self.batches * self.batch]
        chunk = max(1, CHUNK // self.batch) * self.batch
        total, done = torch.zeros((), device=self.place), 0
        self.parallel.train()
        for first in range(0, len(rows), chunk):
            windows = self._windows(self.seen, rows[first : first + chunk], _DATA, number, self.rank, first)
            for begin in range(0, len(windows[0]), self.batch):
                inputs, targets, weights, times = (part[begin : begin + self.batch] for part in windows)
                for group in self.optimiser.param_groups:
                    group["lr"] = self._rate((number - 1) * self.batches + done)
                value, _ = loss(self.parallel(inputs, targets), targets, weights, times)
                self.optimiser.zero_grad()
                value.backward()
                torch.nn.utils.clip_grad_norm_(self.network.parameters(), CLIP)
                self.optimiser.step()
                total += value.detach()
                done += 1
        mean = float(total) / done
        if not np.isfinite(mean):
            raise InputError(f"the loss of epoch {number} is not a number", where="training", hint="try a lower --rate")
        return mean

    def _windows(self, training_set: TrainingSet, rows: NDArray, *stream: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        random = np.random.default_rng([self.options.seed, *stream])
        labels = training_set.labels
        batch = draw(labels, rows, self.options.window, random)
        if self.options.epsilon > 0.0 and training_set is self.seen:
            other = draw(
                self._noisy(stream[1]), rows, self.options.window,
                np.random.default_rng([self.options.seed, *stream]),
            )  # fmt: skip
            batch.inputs[::2] = other.inputs[::2]
        parts = [torch.from_numpy(values).to(self.place) for values in batch]
        return parts[0], parts[1], parts[2], parts[3]

    def _noisy(self, number: int) -> Labels:
        """Return the labels on perturbed paths, perturbed anew every few epochs."""
        age = (number - 1) // NOISE_EPOCHS
        if self.noise is None or self.noise[0] != age:
            seed = np.random.SeedSequence([self.options.seed, _NOISE, age])
            self.noise = age, self.seen.noisy(self.options.epsilon, seed)
        return self.noise[1]

    def _rate(self, step: int) -> float:
        progress = (step + 1) / (self.options.epochs * self.batches)
        rise = min(1.0, progress / WARM_UP)
        fall = 0.5 * (1.0 + np.cos(np.pi * max(0.0, progress - WARM_UP) / (1.0 - WARM_UP)))
        return float(self.options.rate * rise * fall)

    @torch.no_grad()
    def _unseen_loss(self) -> float:
        self.network.eval()
        inputs, targets, weights, times = self.unseen_windows
        return float(loss(self.network(inputs), targets, weights, times)[0])

    def _time_errors(self) -> NDArray:
        """Return the relative error of travel time on each complete unseen path, planned as for a flight."""
        network = inference.NETWORKS[str(self.options.architecture)](self._weights())
        unseen, window = self.unseen, self.options.window
        nodes, labels = unseen.spec.nodes, unseen.labels
        if nodes < window:
            return np.full(len(unseen.paths), np.nan)
        queries = [
            Query(
                path, known, nodes, track=None if chooses else YawSpline(yaw[0], yaw[1], yaw[2, :-1]),
                yaw_angle=float(yaw[0, 0]),
            )
            for path, known, chooses, yaw in zip(
                unseen.paths, unseen.scaled, labels.chooses, labels.yaw, strict=True
            )
        ]  # fmt: skip
        found = [
            travel_time(proposal.coefficients, query.path.end / nodes)
            for query, proposal in zip(queries, predict(queries, network, window), strict=True)
        ]
        return np.array(found) / unseen.travel_time - 1.0

    def _normalise(self) -> None:
        inputs = self._windows(self.seen, np.arange(len(self.seen.rows))[:CHUNK], _UNSEEN, 1)[0]
        spread = inputs.std(dim=(0, 1))
        self.network.mean.copy_(inputs.mean(dim=(0, 1)))
        self.network.scale.copy_(torch.where(spread > 1e-6, 1.0 / spread, torch.ones_like(spread)))

    def _start_from(self, folder: Path) -> Card:
        """Take over the weights of a model; return its card. Raises InputError if its network differs."""
        card, weights = load_weights(folder)
        for name in ("architecture", "hidden", "layers", "window"):
            there, here = getattr(card, name), getattr(self.options, name)
            if there != here:
                raise InputError(
                    f"{name} is {there} there, {here} here", where=str(folder), hint=f"give --{name} {there}"
                )
        self.network.load_state_dict({name: torch.from_numpy(values) for name, values in weights.items()})
        return card

    def _weights(self) -> dict[str, NDArray]:
        return {name: values.detach().cpu().numpy() for name, values in self.network.state_dict().items()}


def _plain(content: Any) -> dict[str, Any]:
    """Return a dataclass as the card stores it: JSON has no tuples, and a folder is stored by its name."""
    plain: dict[str, Any] = json.loads(json.dumps(asdict(content), default=lambda folder: folder.name))
    return plain


def loss(answers: Tensor, targets: Tensor, weights: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
    """Return the loss of B windows, and the relative error of the time of each, (B,); see training_set.Batch.

    To the errors of log √u are added those of its differences, on which accelerations and jerks depend, and the error
    of the window's time, which is what matters in the end.
    """
    error = answers[..., 0] - targets[..., 0]
    slope = error[:, 1:] - error[:, :-1]
    bend = slope[:, 1:] - slope[:, :-1]
    total = (
        _weighted_mean(error, weights)
        + SLOPES * _weighted_mean(slope, weights[:, 1:])
        + BENDS * _weighted_mean(bend, weights[:, 2:])
    )
    late = (times * (-error).exp()).sum(dim=1) - 1.0
    yaw = (answers[..., 1:] - targets[..., 1:]).square().sum(dim=2)
    return total + DURATION * late.square().mean() + YAW * yaw.mean(), late


def _weighted_mean(error: Tensor, weights: Tensor) -> Tensor:
    return (weights * error.square()).sum() / weights.sum()


@contextmanager
def processes(device: str) -> Iterator[tuple[int, int, torch.device]]:
    """Join the processes that torchrun started, if it did: yield rank, number of processes, and this one's device."""
    world = int(os.environ.get("WORLD_SIZE", "1"))
    local = int(os.environ.get("LOCAL_RANK", "0"))
    try:
        place = torch.device(f"{device}:{local}" if device == "cuda" else device)
        torch.zeros(1, device=place)
    except (RuntimeError, AssertionError) as error:
        raise InputError(
            f"no device {device!r}: {' '.join(str(error).split())[:120]}", where="--device", hint="cpu always works"
        ) from None
    if world == 1:
        yield 0, 1, place
        return
    distributed.init_process_group("nccl" if place.type == "cuda" else "gloo")
    try:
        yield distributed.get_rank(), distributed.get_world_size(), place
    finally:
        distributed.destroy_process_group()
