"""Minimisation by L-BFGS of a cost that may fail, in a few dozen evaluations, until a deadline."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.deadline import Deadline
from cfplan.machine_code import njit

_REMEMBERED = 12  # steps, and changes of the gradient over them
_ARMIJO = 1e-4
_HALVINGS = 6
_LONGEST = 1.0  # largest change of a variable in a step

Cost = Callable[[NDArray], tuple[float, NDArray]]  # of x, (n,): the cost, infinite if it fails, and its gradient


class Descended(NamedTuple):
    """Where a descent ended."""

    x: NDArray  # (n,)
    cost: float
    finished: bool  # before the deadline


def descend(cost: Cost, x: NDArray, deadline: Deadline, *, tolerance: float, iterations: int) -> Descended:
    """Descend from x, (n,), until two steps in a row improve the cost by less than a fraction, `tolerance`."""
    value, gradient = cost(x)
    steps = changes = np.empty((0, len(x)))
    small = 0
    for _ in range(iterations if value < math.inf else 0):
        direction = _direction(gradient, steps, changes)
        if not direction @ gradient < 0.0:
            steps, changes, direction = steps[:0], changes[:0], -gradient
        largest = float(np.abs(direction).max(initial=0.0))
        if largest == 0.0:
            break
        share = min(1.0, _LONGEST / largest) if len(steps) else 0.5 * _LONGEST / largest
        for _ in range(_HALVINGS):
            if deadline.passed:
                return Descended(x, value, False)
            there = x + share * direction
            value_there, gradient_there = cost(there)
            if value_there <= value + _ARMIJO * share * float(direction @ gradient):
                break
            share *= 0.3
        else:
            if not len(steps):
                break
            steps, changes = steps[:0], changes[:0]  # restart with the gradient itself
            continue
        step, change = there - x, gradient_there - gradient
        if step @ change > 1e-10 * float(np.linalg.norm(step) * np.linalg.norm(change)):
            steps, changes = (np.vstack(each)[-_REMEMBERED:] for each in ((steps, step), (changes, change)))
        small = small + 1 if value - value_there < tolerance * value else 0
        x, value, gradient = there, value_there, gradient_there
        if small == 2:
            break
    return Descended(x, value, not deadline.passed)


@njit(error_model="numpy")
def _direction(gradient: NDArray, steps: NDArray, changes: NDArray) -> NDArray:
    """Return the direction of the next step (Nocedal and Wright, "Numerical Optimization", algorithm 7.4).

    `steps`, (K, n), are the last steps, the oldest first, and `changes` those of the gradient over them.
    """
    direction, count = -gradient, len(steps)
    shares, curvatures = np.empty(count), (steps * changes).sum(axis=1)
    for k in range(count - 1, -1, -1):
        shares[k] = (steps[k] * direction).sum() / curvatures[k]
        direction -= shares[k] * changes[k]
    if count:
        direction *= curvatures[-1] / (changes[-1] ** 2).sum()
    for k in range(count):
        direction += steps[k] * (shares[k] - (changes[k] * direction).sum() / curvatures[k])
    return direction
