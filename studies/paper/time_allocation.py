"""Segment times learned from corridors, like AllocNet: an LSTM over the boxes, trained on the least times.

AllocNet learns through its quadratic program, without labels. Here a search finds each corridor's label: the segment
times for which the motion keeps SPEED and ACCELERATION in the least total time (corridors.py beside this file).
"""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from cfplan.errors import InfeasibleError, InputError
from studies.paper.corridors import BOXES, Corridor, least_time, min_jerk

WIDTH, EPOCHS, BATCH, RATE = 64, 100, 50, 3e-3
FEATURES = 12  # per box: its middle and the goal relative to the start, and its shape
EVENNESS = 0.02  # relative penalty on times that differ by a factor e, which makes labels unique
_SEARCH = {"maxfev": 50, "xatol": 0.02, "fatol": 0.005}


class TimeNetwork(nn.Module):
    """A network from the boxes of corridors, (R, B, FEATURES), to the logarithms of the segment times, (R, B)."""

    def __init__(self) -> None:
        super().__init__()
        self.mean, self.scale = nn.Buffer(torch.zeros(FEATURES)), nn.Buffer(torch.ones(FEATURES))
        self.lstm = nn.LSTM(FEATURES, WIDTH, batch_first=True, bidirectional=True)
        self.head = nn.Linear(2 * WIDTH, 1)

    def forward(self, boxes: torch.Tensor) -> torch.Tensor:
        """See the class."""
        answers: torch.Tensor = self.head(self.lstm((boxes - self.mean) / self.scale)[0])
        return answers[..., 0]


def box_features(corridor: Corridor) -> NDArray:
    """Return (B, FEATURES); a box's shape is R diag(half) Rᵀ, which does not depend on the signs of its axes."""
    half, middle = (corridor.high - corridor.low) / 2, (corridor.high + corridor.low) / 2
    centres = np.einsum("bij,bj->bi", corridor.axes, middle) - corridor.start
    shapes = np.einsum("bij,bj,bkj->bik", corridor.axes, half, corridor.axes)[:, *np.triu_indices(3)]
    goal = np.broadcast_to(corridor.goal - corridor.start, centres.shape)
    return np.concatenate([centres, shapes, goal], axis=1).astype(np.float32)


def fastest_times(corridor: Corridor) -> NDArray:
    """Return the segment times, (B,) s, with the least sum, by a Nelder-Mead search over their ratios.

    Raises InfeasibleError if no motion found in the search stays in the boxes.
    """
    from scipy.optimize import minimize

    def times_of(x: NDArray) -> NDArray:
        ratios = np.exp([0.0, *x])
        return ratios / ratios.sum()

    def total(x: NDArray) -> float:
        try:
            times = times_of(x)
            return least_time(min_jerk(corridor, times), times) * (1.0 + EVENNESS * float(x @ x))
        except InfeasibleError:
            return 1e3

    simplex = np.concatenate([np.zeros((1, BOXES - 1)), 0.4 * np.eye(BOXES - 1)])
    found = minimize(total, simplex[0], method="Nelder-Mead", options=_SEARCH | {"initial_simplex": simplex})
    if found.fun >= 1e3:
        raise InfeasibleError("no motion stays in the boxes", hint="give another path")
    times = times_of(found.x)
    return least_time(min_jerk(corridor, times), times) * times


def time_label(corridor: Corridor) -> NDArray | None:
    """Return the logarithms of a corridor's fastest times, (B,), or None if no motion stays in its boxes."""
    try:
        return np.log(fastest_times(corridor))
    except InfeasibleError:
        return None


def train_times(
    corridors: Sequence[Corridor], labels: Sequence[NDArray | None], *, epochs: int = EPOCHS, seed: int = 0
) -> TimeNetwork:
    """Train a network on the corridors that have a label. Raises InputError if fewer than two have one."""
    seen = [box_features(each) for each, label in zip(corridors, labels, strict=True) if label is not None]
    wanted = [label for label in labels if label is not None]
    if len(seen) < 2:
        raise InputError("too few corridors can be flown through", where="corridors", hint="give more")
    torch.manual_seed(seed)
    network, random = TimeNetwork(), np.random.default_rng(seed)
    inputs, answers = torch.from_numpy(np.array(seen)), torch.from_numpy(np.array(wanted, dtype=np.float32))
    network.mean.copy_(inputs.mean((0, 1)))
    network.scale.copy_(inputs.std((0, 1)).clamp_min(1e-6))
    steps = epochs * -(-len(inputs) // BATCH)
    optimiser = torch.optim.Adam(network.parameters(), lr=RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(epochs):
        for chosen in torch.split(torch.from_numpy(random.permutation(len(inputs))), BATCH):
            loss = (network(inputs[chosen]) - answers[chosen]).square().mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
    network.eval()
    return network


def allotted_times(network: TimeNetwork, corridor: Corridor) -> NDArray:
    """Return the network's segment times, (B,) s."""
    with torch.inference_mode():
        return np.exp(network(torch.from_numpy(box_features(corridor))[None])[0].numpy().astype(float))
