"""Constraints and penalty of points by the spline coefficients of their intervals, with derivatives, as machine code.

In an interval h is made of four coefficients of a cubic B-spline and yaw of three of a quadratic one, so everything
physical at a point follows from at most seven numbers. CasADi differentiates those expressions (derivatives.py),
llvm_emitter.py writes them out, and LLVM compiles them once a machine; both are imported only then.

Arrays hold a quantity a row and a point a column; columns are a multiple of LANES.
"""

import ctypes
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from cfplan.machine_code import interprets, llvm_functions, vector_width
from cfplan.planners.expert.point_constraints import LANES, ROWS, family, variables
from cfplan.planners.solver.barrier import TERMS

UNIFORM = (2, 3)  # arguments that are the same at all points
_TITLES = ("values", "derivatives")


def source() -> str:
    """Return the LLVM source of all kernels."""
    from cfplan.planners.expert import derivatives, llvm_emitter

    functions = [f for free_yaw in (False, True) for f in derivatives.point_kernels(free_yaw)]
    return llvm_emitter.source(functions, UNIFORM, min(LANES, vector_width()))


@lru_cache(maxsize=1)
def machine_code() -> dict[str, Any]:
    """Return the compiled kernels by name; compiles them if that was never done."""
    names = tuple(f"{family(free_yaw)}_{title}" for free_yaw in (False, True) for title in _TITLES)
    functions = llvm_functions("kernels", __name__, source, names)
    for name, function in functions.items():
        arrays = 6 if name.endswith(_TITLES[0]) else 7 + len(TERMS)
        function.argtypes = [ctypes.c_long, *[ctypes.c_void_p] * arrays]
    return functions


class Kernels(Protocol):
    """The kernels at the points of a problem; each call writes into the same arrays."""

    coefficients: NDArray
    """(k, P) of the points' intervals, from which both calls compute: to be filled in before."""
    work: NDArray
    """(derivative_rows(k), P), which differentiate() fills in.

    It begins with gradients, k rows each: that of the penalty, and of rows · each of the terms but the first. Behind
    them lies the Hessian of penalty + multipliers · rows, plus J'ΣJ: its lower triangle, column by column.
    """

    def __init__(self, free_yaw: bool, data: NDArray, common: NDArray, weights: NDArray, spare: int) -> None:
        """Take `data`, (POINT_DATA, P), `common`, (COMMON_DATA,), and `weights`, (3,) those of the penalties.

        Arrays of constraints have `spare` more behind the rows of the points, of which the kernels know nothing.
        """

    def evaluate(self) -> tuple[NDArray, NDArray]:
        """Return (constraints, penalties (P,)), in arrays of their own: rows of all points, one after another."""

    def differentiate(self, terms: NDArray) -> NDArray:
        """Return the Jacobian, (k ROWS, P), all rows by the first coefficient first; `terms` are barrier.TERMS."""


def _work(k: int, points: int) -> NDArray:
    """Return the array that differentiate() fills in, by k coefficients an interval."""
    return np.empty((len(TERMS) * k + k * (k + 1) // 2, points))


class CompiledKernels:
    """The kernels as machine code, see Kernels."""

    def __init__(self, free_yaw: bool, data: NDArray, common: NDArray, weights: NDArray, spare: int) -> None:
        self._k, self._points, self._spare = variables(free_yaw), data.shape[1], spare
        self._values, self._derivatives = (machine_code()[f"{family(free_yaw)}_{title}"] for title in _TITLES)
        self.coefficients, self.work = np.empty((self._k, self._points)), _work(self._k, self._points)
        self._jacobian = np.empty((ROWS * self._k, self._points))
        self._given = [np.ascontiguousarray(each, dtype=float) for each in (data, common, weights)]  # kept alive
        self._inputs = tuple(_address(each) for each in (self.coefficients, *self._given))
        at = _address(self.work)
        self._outputs = _address(self._jacobian), at, at + 8 * len(TERMS) * self._k * self._points

    def evaluate(self) -> tuple[NDArray, NDArray]:
        rows = ROWS * self._points + self._spare
        result = np.empty(rows + self._points)
        at = _address(result)
        self._values(self._points, *self._inputs, at, at + 8 * rows)
        return result[:rows], result[rows:]

    def differentiate(self, terms: NDArray) -> NDArray:
        first, row = _address(terms), 8 * terms.shape[1]  # of one of four kinds
        by_kind = first, first + row, first + 2 * row, first + 3 * row
        self._derivatives(self._points, *self._inputs, *by_kind, *self._outputs)
        return self._jacobian


def _address(array: NDArray) -> int:
    """Return where a contiguous array begins in memory."""
    return ctypes.addressof(ctypes.c_char.from_buffer(array.data))


class InterpretedKernels:
    """The kernels by CasADi's virtual machine, point by point: ready at once, and a check of the other; see Kernels."""

    def __init__(self, free_yaw: bool, data: NDArray, common: NDArray, weights: NDArray, spare: int) -> None:
        from cfplan.planners.expert.derivatives import point_kernels

        points, self._spare = data.shape[1], spare
        self._values, self._derivatives = (kernel.map(points) for kernel in point_kernels(free_yaw))
        k = variables(free_yaw)
        self.coefficients, self.work = np.empty((k, points)), _work(k, points)
        self._given = data, *(np.tile(each[:, None], points) for each in (common, weights))

    def evaluate(self) -> tuple[NDArray, NDArray]:
        rows, penalty = (np.array(each) for each in self._values(self.coefficients, *self._given))
        return np.append(rows, np.empty(self._spare)), penalty[0]

    def differentiate(self, terms: NDArray) -> NDArray:
        at_points = terms[:, : ROWS * self.coefficients.shape[1]].reshape(len(terms), ROWS, -1)
        jacobian, gradients, hessian = self._derivatives(self.coefficients, *self._given, *at_points)
        self.work[: gradients.shape[0]], self.work[gradients.shape[0] :] = np.array(gradients), np.array(hessian)
        return np.array(jacobian)


def kernels_at_hand() -> type[Kernels]:
    """Return the kernels as machine code; where nothing is compiled now, by CasADi's virtual machine."""
    return InterpretedKernels if interprets() else CompiledKernels
