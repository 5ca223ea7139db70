"""Compiled constraints and penalty at points, as functions of spline coefficients, with derivatives.

In an interval h depends on four coefficients of a cubic B-spline and yaw on three of a quadratic one, so every physical
quantity at a point follows from at most seven numbers. CasADi differentiates those expressions (derivatives.py), and
numba compiles the result (vector_code.py); both are imported only when something is compiled.

Arrays hold one quantity per row and one point per column; the number of columns is a multiple of LANES.
"""

from typing import Any

import numpy as np
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from cfplan.machine_code import njit, vector_width
from cfplan.planners.expert.point_constraints import LANES, ROWS, variables
from cfplan.planners.solver.barrier import TERMS

_UNIFORM = (2, 3)  # inputs that are the same at all points
_WIDTH = min(LANES, vector_width())  # points at once
_VALUES, _DERIVATIVES = 0, 1  # of derivatives.point_kernels()


def _compute(  # numba asks for each argument of _evaluate by itself
    _context: Any, free_yaw: Any, which: Any, first: Any, points: Any, inputs: Any, results: Any
) -> Any:
    """Evaluate one of derivatives.point_kernels(free_yaw) at _WIDTH of the points, from the `first` on."""
    from cfplan.planners.expert import derivatives, vector_code

    kernel = derivatives.point_kernels(bool(free_yaw.literal_value))[which.literal_value]
    signature = types.void(free_yaw, which, first, points, inputs, results)
    return signature, vector_code.generator(kernel, _UNIFORM, _WIDTH)


_evaluate: Any = intrinsic(prefer_literal=True)(_compute)


@njit(allocates=False)
def _given_values(points, inputs, results):
    for first in range(0, points, _WIDTH):
        _evaluate(False, _VALUES, first, points, inputs, results)


@njit(allocates=False)
def _given_derivatives(points, inputs, results):
    for first in range(0, points, _WIDTH):
        _evaluate(False, _DERIVATIVES, first, points, inputs, results)


@njit(allocates=False)
def _free_values(points, inputs, results):
    for first in range(0, points, _WIDTH):
        _evaluate(True, _VALUES, first, points, inputs, results)


@njit(allocates=False)
def _free_derivatives(points, inputs, results):
    for first in range(0, points, _WIDTH):
        _evaluate(True, _DERIVATIVES, first, points, inputs, results)


class Kernels:
    """The kernels at the points of a problem; each call writes into the same arrays."""

    def __init__(self, free_yaw: bool, data: NDArray, common: NDArray, weights: NDArray, spare: int) -> None:
        """Take `data`, (POINT_DATA, P), `common`, (COMMON_DATA,), and `weights`, (3,) those of the penalties.

        Arrays of constraints have `spare` more entries behind the rows of the points, which the kernels leave alone.
        """
        k, self._points, self._spare = variables(free_yaw), data.shape[1], spare
        self._values = _free_values if free_yaw else _given_values
        self._derivatives = _free_derivatives if free_yaw else _given_derivatives
        self.coefficients = np.empty((k, self._points))
        """(k, P) of the points' intervals, the inputs of both calls: fill them in first."""
        self.work = np.empty((len(TERMS) * k + k * (k + 1) // 2, self._points))
        """The output of differentiate().

        It begins with gradients, k rows each: that of the penalty, and of rows · each of the terms but the first.
        Behind them lies the Hessian of penalty + multipliers · rows, plus J'ΣJ: its lower triangle, column by column.
        """
        self._inputs = self.coefficients, *(np.ascontiguousarray(each, dtype=float) for each in (data, common, weights))
        self._results = np.empty((ROWS * k, self._points)), self.work[: len(TERMS) * k], self.work[len(TERMS) * k :]

    def evaluate(self) -> tuple[NDArray, NDArray]:
        """Return (constraints, penalties (P,)), in arrays of their own: rows of all points, one after another."""
        rows, penalties = np.empty(ROWS * self._points + self._spare), np.empty(self._points)
        self._values(self._points, self._inputs, (rows, penalties))
        return rows, penalties

    def differentiate(self, terms: NDArray) -> NDArray:
        """Return the Jacobian, (k ROWS, P), all rows by the first coefficient first; `terms` are barrier.TERMS."""
        self._derivatives(self._points, (*self._inputs, *terms), self._results)
        return self._results[0]
