"""Learned correction of an on-board reference: it subtracts the deviation of a dry run, ahead of time.

The lead of reference.py assumes that attitude and thrust are those that the controller commands. With motor lag they
are late, most where both change fast: at the top of a loop the vehicle deviates by 5 cm at a motor lag of 0.1 s.
Streamed setpoints send thrust and rates ahead of time; polynomials have only positions. Therefore one step of iterative
learning control (Bristow, Tharayil and Alleyne, "A survey of iterative learning control", 2006) shifts the reference by
the deviation, as a spline too slow to excite the controller: with knots 0.2 s apart a second step makes it worse.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

_LEAD = 0.1  # s, lead of the shift over the deviation: about the delay with which the vehicle follows it
_SPACING = 0.25  # s between knots
_DEGREE = 7  # for four smooth derivatives
_REST = 5  # zero coefficients at each end, for a zero shift with four derivatives


@dataclass(frozen=True, slots=True)
class Correction:
    """A shift of the reference over the time of a flight that lasts `duration`; longer flights stretch it."""

    shift: BSpline  # m, (3,) of s
    duration: float  # s

    def at(self, times: NDArray, duration: float) -> NDArray:
        """Return the shift and four derivatives, (N, 5, 3), at times of a flight that lasts `duration`, s."""
        stretch = duration / self.duration
        out = np.zeros((len(times), 5, 3))
        flying = (times >= 0.0) & (times <= duration)
        own = times[flying] / stretch
        for order in range(5):
            out[flying, order] = self.shift(own, nu=order) / stretch**order
        return out


def correct(times: NDArray, deviation: NDArray, duration: float) -> Correction:
    """Return the correction of a deviation, (N, 3) m at times, (N,) s, in a flight of `duration`, s, that flew without
    one.
    """
    rows = np.arange(0.0, duration, times[1] - times[0])
    wanted = -np.stack([np.interp(rows + _LEAD, times, along) for along in deviation.T], axis=1)
    inner = np.linspace(0.0, duration, max(int(duration / _SPACING), 1) + 1)
    knots = np.concatenate([np.zeros(_DEGREE), inner, np.full(_DEGREE, duration)])
    matrix = BSpline.design_matrix(rows, knots, _DEGREE)
    free = slice(_REST, matrix.shape[1] - _REST)
    coefficients = np.zeros((matrix.shape[1], 3))
    normal = (matrix.T @ matrix).toarray()[free, free]
    coefficients[free] = np.linalg.solve(normal, (matrix.T @ wanted)[free])
    return Correction(BSpline(knots, coefficients, _DEGREE), duration)
