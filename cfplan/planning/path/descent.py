"""Minimisation by L-BFGS of a cost that may fail, in a few dozen evaluations, until a deadline."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.deadline import Deadline

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
    steps: list[NDArray] = []
    changes: list[NDArray] = []
    small = 0
    for _ in range(iterations if value < math.inf else 0):
        direction = _direction(gradient, steps, changes)
        if not direction @ gradient < 0.0:
            steps, changes, direction = [], [], -gradient
        largest = float(np.abs(direction).max(initial=0.0))
        if largest == 0.0:
            break
        share = min(1.0, _LONGEST / largest) if steps else 0.5 * _LONGEST / largest
        for _ in range(_HALVINGS):
            if deadline.passed:
                return Descended(x, value, False)
            there = x + share * direction
            value_there, gradient_there = cost(there)
            if value_there <= value + _ARMIJO * share * float(direction @ gradient):
                break
            share *= 0.3
        else:
            if not steps:
                break
            steps, changes = [], []  # restart with the gradient itself
            continue
        step, change = there - x, gradient_there - gradient
        if step @ change > 1e-10 * float(np.linalg.norm(step) * np.linalg.norm(change)):
            steps, changes = [*steps, step][-_REMEMBERED:], [*changes, change][-_REMEMBERED:]
        small = small + 1 if value - value_there < tolerance * value else 0
        x, value, gradient = there, value_there, gradient_there
        if small == 2:
            break
    return Descended(x, value, not deadline.passed)


def _direction(gradient: NDArray, steps: list[NDArray], changes: list[NDArray]) -> NDArray:
    """Return the direction of the next step (Nocedal and Wright, "Numerical Optimization", algorithm 7.4)."""
    direction = -gradient
    shares = []
    for step, change in zip(reversed(steps), reversed(changes), strict=True):
        share = (step @ direction) / (step @ change)
        direction = direction - share * change
        shares.append(share)
    if steps:
        direction = direction * ((steps[-1] @ changes[-1]) / (changes[-1] @ changes[-1]))
    for step, change, share in zip(steps, changes, reversed(shares), strict=True):
        direction = direction + step * (share - (change @ direction) / (step @ change))
    return np.asarray(direction)
