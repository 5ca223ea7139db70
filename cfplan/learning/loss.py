"""What training minimises, and what it reports."""

from torch import Tensor

SLOPES = 2.0
# weight of squared errors of the first difference between nodes, against those of the values
BENDS = 5.0
# likewise of the second difference
DURATION = 1.0
# weight of the squared relative error of a window's time
YAW = 0.01
# weight of the squared errors of the yaw's cosine and sine


def loss(answers: Tensor, targets: Tensor, weights: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
    """The loss of B windows, and the relative error of the time of each, (B,); see sampling.Batch.

    Beside the errors of log √u stand those of its differences, on which accelerations and jerks depend, and the time
    of the window, which is what matters in the end.
    """
    error = answers[..., 0] - targets[..., 0]
    slope = error[:, 1:] - error[:, :-1]
    bend = slope[:, 1:] - slope[:, :-1]
    total = _mean(error, weights) + SLOPES * _mean(slope, weights[:, 1:]) + BENDS * _mean(bend, weights[:, 2:])
    late = (times * (-error).exp()).sum(dim=1) - 1.0
    yaw = (answers[..., 1:] - targets[..., 1:]).square().sum(dim=2)
    return total + DURATION * late.square().mean() + YAW * yaw.mean(), late


def _mean(error: Tensor, weights: Tensor) -> Tensor:
    return (weights * error.square()).sum() / weights.sum()
