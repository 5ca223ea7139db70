"""From a network's answer to a smooth profile: the coefficients of a cubic B-spline, one window at a time.

A window's answers are joined to the three coefficients that are settled already, or to a rest, and smoothed by the
least sum of squared changes and squared third differences. Where the path rests, four coefficients are equal, so that h
stays constant over the first or last interval (see expert/reduced.py). For one length of window the answer is a fixed
matrix, made once.
"""

from enum import Enum
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.expert.yaw_track import YawTrack
from cfplan.vehicle.profile import SpeedProfile

STIFFNESS = 1.0
# of the squared third differences, against the squared changes of log √u


class Begin(Enum):
    """What holds at the first node of a window."""

    REST = "rest"
    KNOWN = "known"
    # u₋₁, u₀, u₁ are settled
    FREE = "free"


class Smoother(NamedTuple):
    """log √u at nodes -1 … W+1 from the answers at nodes 0 … W and what is settled."""

    answers: NDArray
    # (W+3, W+1)
    settled: NDArray
    # (W+3, 3)

    def __call__(self, answers: NDArray, settled: NDArray) -> NDArray:
        """(W+3,) from (W+1,) and (3,)."""
        return self.answers @ answers + self.settled @ settled


@lru_cache
def smoother(window: int, begin: Begin, rest_end: bool, stiffness: float = STIFFNESS) -> Smoother:
    """The matrices for a kind of window."""
    count = window + 3
    seen = np.eye(count)[1:-1]
    third = np.diff(np.eye(count), 3, axis=0)
    normal = seen.T @ seen + stiffness * third.T @ third
    column = np.arange(count)
    if begin is Begin.REST:
        column = np.maximum(column, 3) - 3
    if rest_end:
        column = np.minimum(column, column[-4])
    free = np.eye(column[-1] + 1)[column]
    held = np.zeros((count, 3))
    if begin is Begin.KNOWN:
        held[:3] = np.eye(3)
        free = free[:, 3:]
    solve = free @ np.linalg.solve(free.T @ normal @ free, free.T)
    return Smoother(np.ascontiguousarray(solve @ seen.T), held - solve @ normal @ held)


def profile_by(coefficients: NDArray, end: float, track: YawTrack) -> SpeedProfile:
    """The profile whose h has these coefficients, (N+3,), on N intervals."""
    nodes = len(coefficients) - 3
    step = end / nodes
    difference = np.diff(coefficients)
    second = np.diff(difference)
    return SpeedProfile(
        s=np.linspace(0.0, end, nodes + 1),
        h=coefficients[1:-1] + second / 6,
        dh=(difference[1:] + difference[:-1]) / (2 * step),
        ddh=second / step**2,
        dddh=np.diff(second) / step**3,
        yaw=track.yaw,
        dyaw=track.dyaw,
        ddyaw=track.ddyaw,
    )
