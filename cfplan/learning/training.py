"""Train a model by imitation: from a dataset of the expert's profiles to a model folder.

Every epoch draws its windows by a seed of its own and is followed by a checkpoint, so that a training that was killed
goes on as if it had not been. Under torchrun each process takes its share of the windows, and the first one writes.
"""

import json
import time
from collections.abc import Callable, Iterator
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
from cfplan.learning.checkpoints import Epoch, resume, save_checkpoint
from cfplan.learning.learned import predict
from cfplan.learning.loss import loss
from cfplan.learning.model_files import Card, save_model
from cfplan.learning.networks import Architecture, build
from cfplan.learning.processes import processes
from cfplan.learning.sampling import Labels, Material, draw, read_material, split
from cfplan.learning.smooth import travel_time
from cfplan.learning.windows import WINDOW
from cfplan.safety.limit_sets import LIMIT_SETS

CURVES = "curves.png"
CHUNK = 4096
# windows drawn at a time
WARM_UP = 0.05
# of the steps, over which the learning rate rises; then it falls to nothing along a cosine
CLIP = 1.0
# norm of the gradient, at most
NOISE_EPOCHS = 5
# after which paths are perturbed anew
_DATA, _NOISE, _JUDGED = 1, 2, 3
# streams of random numbers of one seed


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """What decides a training, beside the dataset and the machine."""

    architecture: Architecture = Architecture.BILSTM
    hidden: int = 32
    layers: int = 2
    window: int = WINDOW
    epochs: int = 40
    windows: int = 2
    # of each path, an epoch
    batch: int = 64
    rate: float = 2e-3
    # of learning, at its highest
    epsilon: float = 0.0
    # m, by which the paths of half the windows are perturbed, with the clean path's answers
    seed: int = 0

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
            ("seed", self.seed < 0, "at least 0"),
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
    """Train, or go on with the training that the folder holds, and write the model. None in all processes but one.

    Raises:
        InputError: a dataset without usable rows, another training in the folder, a device that is not there, or
            a loss that is not a number.
    """
    material = read_material(dataset)
    with processes(device) as (rank, world, place):
        run = _Run(material, folder, options, rank, world, place)
        try:
            for epoch in run.epochs():
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
        self, material: Material, folder: Path, options: Options, rank: int, world: int, place: torch.device
    ) -> None:
        self.folder, self.options, self.rank, self.world, self.place = folder, options, rank, world, place
        self.identity: dict[str, Any] = {
            "options": _plain(options),
            "data": _plain(material.spec),
            "features": features.VERSION,
        }
        self.seen, self.unseen = split(material, options.seed)
        self.noise: tuple[int, Labels] | None = None
        torch.manual_seed(options.seed)
        self.network = build(options.architecture, options.hidden, options.layers)
        self._normalise()
        self.network.to(place)
        self.parallel: Any = DistributedDataParallel(self.network) if world > 1 else self.network
        self.optimiser = torch.optim.AdamW(self.network.parameters(), lr=options.rate, weight_decay=1e-4)
        per_process = len(self.seen.rows) * options.windows // world
        self.batch = max(1, min(options.batch // world, per_process))
        self.batches = per_process // self.batch
        self.unseen_windows = self._windows(self.unseen, np.tile(np.arange(len(self.unseen.rows)), 2), _JUDGED, 0)
        self.log = resume(folder, self.identity, self.network, self.optimiser, place)

    def epochs(self) -> Iterator[Epoch]:
        """Train, an epoch at a time."""
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

    def finish(self, command: str) -> Card:
        """Write the model, the log and its picture."""
        from cfplan.learning.curves import draw_curves

        spec, last, options = self.seen.spec, self.log[-1], self.options
        chosen = LIMIT_SETS[spec.limits]
        card = Card(
            name=self.folder.name,
            architecture=str(options.architecture),
            hidden=options.hidden,
            layers=options.layers,
            window=options.window,
            features=features.VERSION,
            weights_sha256="",
            airframe=chosen.airframe,
            limits=chosen.limits,
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
        card = save_model(self.folder, card, self._weights())
        draw_curves(self.log, self.folder / CURVES)
        return card

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

    def _windows(self, material: Material, rows: NDArray, *stream: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        random = np.random.default_rng([self.options.seed, *stream])
        labels = material.labels
        batch = draw(labels, material.bound, rows, self.options.window, random)
        if self.options.epsilon > 0.0 and material is self.seen:
            other = draw(
                self._noisy(stream[1]), material.bound, rows, self.options.window,
                np.random.default_rng([self.options.seed, *stream]),
            )  # fmt: skip
            batch.inputs[::2] = other.inputs[::2]
        parts = [torch.from_numpy(values).to(self.place) for values in batch]
        return parts[0], parts[1], parts[2], parts[3]

    def _noisy(self, number: int) -> Labels:
        """The paths perturbed, anew every few epochs."""
        age = (number - 1) // NOISE_EPOCHS
        if self.noise is None or self.noise[0] != age:
            seed = np.random.SeedSequence([self.options.seed, _NOISE, age])
            self.noise = age, self.seen.noisy(self.options.epsilon, seed)
        return self.noise[1]

    def _rate(self, step: int) -> float:
        share = (step + 1) / (self.options.epochs * self.batches)
        rise = min(1.0, share / WARM_UP)
        fall = 0.5 * (1.0 + np.cos(np.pi * max(0.0, share - WARM_UP) / (1.0 - WARM_UP)))
        return float(self.options.rate * rise * fall)

    @torch.no_grad()
    def _unseen_loss(self) -> float:
        self.network.eval()
        inputs, targets, weights, times = self.unseen_windows
        return float(loss(self.network(inputs), targets, weights, times)[0])

    def _time_errors(self) -> NDArray:
        """Relative error of the travel time of each unseen path, as flights would have it."""
        network = inference.NETWORKS[str(self.options.architecture)](self._weights())
        unseen, window = self.unseen, self.options.window
        nodes = max(window, unseen.spec.nodes)
        found = [
            travel_time(predict(path, network, unseen.bound, nodes, window, yaw_angle=yaw)[0], path.end / nodes)
            for path, yaw in zip(unseen.paths, unseen.labels.yaw[:, 0, 0], strict=True)
        ]
        return np.array(found) / unseen.travel_time - 1.0

    def _normalise(self) -> None:
        inputs = self._windows(self.seen, np.arange(len(self.seen.rows))[:CHUNK], _JUDGED, 1)[0]
        spread = inputs.std(dim=(0, 1))
        self.network.mean.copy_(inputs.mean(dim=(0, 1)))
        self.network.scale.copy_(torch.where(spread > 1e-6, 1.0 / spread, torch.ones_like(spread)))

    def _weights(self) -> dict[str, NDArray]:
        return {name: values.detach().cpu().numpy() for name, values in self.network.state_dict().items()}


def _plain(content: Any) -> dict[str, Any]:
    """As a card has it: JSON knows no tuples."""
    plain: dict[str, Any] = json.loads(json.dumps(asdict(content)))
    return plain
