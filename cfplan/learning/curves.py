"""A picture of how a training went."""

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol


class Point(Protocol):
    """What is drawn of an epoch."""

    @property
    def epoch(self) -> int: ...

    @property
    def loss(self) -> float: ...

    @property
    def unseen_loss(self) -> float: ...

    @property
    def time_error_mean(self) -> float: ...

    @property
    def time_error_p95(self) -> float: ...


def draw_curves(log: Sequence[Point], file: Path) -> None:
    """Losses, and errors of travel time on unseen paths, by epoch, as a PNG."""
    from matplotlib.figure import Figure

    epochs = [point.epoch for point in log]
    figure = Figure(figsize=(9, 3.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.semilogy(epochs, [point.loss for point in log], label="learned from")
    left.semilogy(epochs, [point.unseen_loss for point in log], label="unseen")
    left.set(xlabel="epoch", ylabel="loss")
    right.semilogy(epochs, [100 * point.time_error_mean for point in log], label="mean")
    right.semilogy(epochs, [100 * point.time_error_p95 for point in log], label="95th percentile")
    right.set(xlabel="epoch", ylabel="travel time, |error| on unseen paths, %")
    for axes in (left, right):
        axes.legend()
        axes.grid(alpha=0.3)
    figure.savefig(file, dpi=120)
