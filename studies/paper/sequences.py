"""Sequences: the paths of a dataset in the form of the paper's networks, [γ, γ', γ''] and [h, cos ψ] at each node.

Unlike the features of cfplan's own networks, they are not scaled by limits or relative to a position: the paper's
networks are trained for one vehicle, one set of limits and one box.
"""

from contextlib import suppress
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path as FilePath

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import CfplanError, InputError
from cfplan.geometry.path import Path
from cfplan.geometry.random_paths import perturbed
from cfplan.learning.dataset import read_dataset
from cfplan.learning.dataset_spec import DatasetSpec, Relabel
from cfplan.learning.labels import solve
from cfplan.planners.solution import Status

MAX_LENGTH = 60.0  # m: the few longer paths are min-snap paths that swing far out of the box


class Inputs(StrEnum):
    """The inputs of a network, named as in the paper's table of inputs."""

    ALL = "pos/vel/acc"
    VELOCITY = "pos/vel"
    ACCELERATION = "pos/acc"
    POSITION = "pos"

    @property
    def orders(self) -> list[int]:
        """Return the orders of the derivatives with respect to s."""
        return [["pos", "vel", "acc"].index(name) for name in self.value.split("/")]

    @property
    def width(self) -> int:
        """Return the number of inputs per node."""
        return 3 * len(self.orders)


@dataclass(frozen=True, slots=True, eq=False)
class Sequences:
    """R paths with their labels at N nodes."""

    spec: DatasetSpec
    rows: NDArray  # (R,) row numbers in the dataset
    paths: tuple[Path, ...]
    inputs: NDArray  # (R, N, 9) float32
    answers: NDArray  # (R, N, 2) float32, h and cos ψ
    end: NDArray  # (R,) path parameter s at each path's end
    length: NDArray  # (R,) m
    travel_time: NDArray  # (R,) s

    def part(self, chosen: NDArray | slice) -> "Sequences":
        """Return the selected rows, by index."""
        numbers = np.arange(len(self.rows))[chosen]
        paths = tuple(self.paths[k] for k in numbers)
        return Sequences(
            self.spec, self.rows[chosen], paths, self.inputs[chosen], self.answers[chosen], self.end[chosen],
            self.length[chosen], self.travel_time[chosen],
        )  # fmt: skip

    def tested(self, count: int) -> "Sequences":
        """Return the rows with number below `count`, which are reserved for testing."""
        return self.part(self.rows < count)

    def learned_from(self, first: int) -> "Sequences":
        """Return the rows from number `first` on, without those longer than MAX_LENGTH."""
        return self.part((self.rows >= first) & (self.length <= MAX_LENGTH))

    def perturbed_by(
        self, epsilon: float, seed: np.random.SeedSequence, relabel: Relabel = Relabel.KEEP
    ) -> "Sequences":
        """Return every path perturbed by at most `epsilon`, m, with the clean path's label or the perturbed path's own.

        A perturbed path without a solution keeps the clean path's label. Lengths and times are the clean path's.
        """
        noisy = tuple(
            perturbed(path, epsilon, own) for path, own in zip(self.paths, seed.spawn(len(self.paths)), strict=True)
        )
        inputs = np.stack([path_inputs(path, self.inputs.shape[1]) for path in noisy])
        answers = self.answers if relabel is Relabel.KEEP else self._solved(noisy)
        return replace(self, paths=noisy, inputs=inputs, answers=answers)

    def _solved(self, paths: tuple[Path, ...]) -> NDArray:
        """Return the solutions of other paths, (R, N, 2), solved with the dataset's options."""
        answers = self.answers.copy()
        for k, path in enumerate(paths):
            with suppress(CfplanError):  # a perturbed path may have too many pieces for the nodes
                profile = solve(self.spec, int(self.rows[k]) // (1 + self.spec.copies), path).profile
                if profile is not None:
                    answers[k] = np.stack([profile.h, np.cos(profile.yaw)], axis=1)
        return answers


def path_inputs(path: Path, nodes: int) -> NDArray:
    """Return γ, γ' and γ'' at N nodes including both ends, (N, 9) float32."""
    s = np.linspace(0.0, path.end, nodes)
    return np.concatenate([path(s, order) for order in range(3)], axis=1).astype(np.float32)


def select_inputs(inputs: NDArray, chosen: Inputs) -> NDArray:
    """Return the chosen inputs, (..., N, I), of (..., N, 9)."""
    return inputs[..., [3 * order + axis for order in chosen.orders for axis in range(3)]]


def read_sequences(folder: FilePath, *, most: int | None = None) -> Sequences:
    """Read the solved paths among the first `most` rows of a dataset.

    Raises InputError if the folder is not a dataset, is damaged, or holds no solved path.
    """
    spec, rows = read_dataset(folder)
    solved = [row for row in rows.slice(0, most).to_pylist() if row["status"] == Status.SOLVED.name]
    if not solved:
        raise InputError("no solved path", where=str(folder), hint="make another with `cfplan dataset make`")
    try:
        paths = tuple(
            Path(np.array(row["breaks"]), np.array(row["coefficients"]).reshape(len(row["breaks"]) - 1, -1, 3))
            for row in solved
        )
        h, yaw = (np.array([row[name] for row in solved], dtype=float) for name in ("h", "yaw"))
        lengths, times = (np.array([row[name] for row in solved], dtype=float) for name in ("length", "travel_time"))
        if not (np.isfinite(h).all() and np.isfinite(yaw).all() and (h >= 0.0).all() and (times > 0.0).all()):
            raise ValueError("h, yaw or travel time is not that of a flight")
    except (CfplanError, ValueError, TypeError) as error:
        raise InputError(f"damaged: {error}", where=str(folder), hint="make the dataset again") from None
    answers = np.stack([h, np.cos(yaw)], axis=2).astype(np.float32)
    inputs = np.stack([path_inputs(path, spec.nodes + 1) for path in paths])
    numbers, ends = np.array([row["row"] for row in solved]), np.array([path.end for path in paths])
    return Sequences(spec, numbers, paths, inputs, answers, ends, lengths, times)
