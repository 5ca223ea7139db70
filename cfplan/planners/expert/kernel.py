"""What must hold at a point, by the spline coefficients of its interval, with derivatives; eight points at a time.

In an interval h is made of four coefficients of a cubic B-spline and yaw of three of a quadratic one, so everything
physical at a point follows from at most seven numbers (point_constraints.py). CasADi differentiates those expressions,
llvm_emitter.py writes them out, and LLVM compiles them once a machine.

Arrays hold a quantity a row and a point a column; columns are a multiple of LANES.
"""

import ctypes
from collections.abc import Callable
from enum import StrEnum
from functools import lru_cache, partial
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from cfplan.machine_code import llvm_functions
from cfplan.planners.expert import llvm_emitter, point_constraints
from cfplan.planners.solver import barrier
from cfplan.vehicle.profile_spline import AT_NODE as H_SPLINE
from cfplan.vehicle.yaw_spline import AT_NODE as YAW_SPLINE

_KERNELS = ("values", "derivatives")


def coefficients(free_yaw: bool) -> int:
    """Number of spline coefficients that matter in an interval."""
    return 7 if free_yaw else 4


@lru_cache(maxsize=2)
def point_kernels(free_yaw: bool) -> tuple[casadi.Function, casadi.Function]:
    """Values and derivatives at one point, as CasADi functions; see Points for what they take and give."""
    w = casadi.SX.sym("w", coefficients(free_yaw))
    inputs, rows, penalty = point_constraints.point_expressions(free_yaw)
    z, place = inputs[0], inputs[1][12]
    of_z = casadi.Function("of_z", inputs, [rows, penalty])

    # Differentiated by what holds at the point itself, which is sparser, and led to the coefficients from there.
    here = casadi.SX.sym("here", w.numel())
    rows, penalty = of_z(here, _at_left_end(inputs[1]), *inputs[2:])
    pulls = [casadi.SX.sym(name, point_constraints.ROWS) for name in barrier.PULLS]
    stiffness, multipliers = pulls[:2]
    jacobian = casadi.jacobian(rows, here)
    gradients = casadi.horzcat(casadi.gradient(penalty, here), casadi.mtimes(jacobian.T, casadi.horzcat(*pulls[1:])))
    hessian = casadi.jacobian(casadi.gradient(penalty + casadi.dot(multipliers, rows), here), here)
    hessian += casadi.mtimes(jacobian.T, casadi.repmat(stiffness, 1, w.numel()) * jacobian)
    hessian = casadi.tril2symm(casadi.tril(hessian))  # what lies above is not computed
    by_here = casadi.Function(
        "by_here", [here, *inputs[1:], *pulls], [rows, penalty, jacobian, gradients, hessian]
    )  # fmt: skip
    led = casadi.jacobian(casadi.vertcat(*_local(z, free_yaw, place)), z)
    led = casadi.mtimes(led, casadi.DM(_spline(free_yaw)))
    rows, penalty, jacobian, gradients, hessian = by_here(casadi.mtimes(led, w), *inputs[1:], *pulls)
    inputs[0] = w
    jacobian, gradients = casadi.mtimes(jacobian, led), casadi.mtimes(led.T, gradients)
    hessian = casadi.mtimes(led.T, casadi.mtimes(hessian, led))
    size = range(w.numel())
    lower = casadi.vertcat(*(hessian[i, j] for j in size for i in size if i >= j))

    def function(title: str, arguments: list[casadi.SX], results: list[casadi.SX]) -> casadi.Function:
        dense = [casadi.densify(result) for result in results]
        return casadi.Function(f"{point_constraints.family(free_yaw)}_{title}", arguments, casadi.cse(dense))

    return (
        function("values", inputs, [rows, penalty]),
        function(
            "derivatives",
            [*inputs, *pulls],
            [casadi.vec(jacobian), casadi.vec(gradients), lower],
        ),
    )


def _at_left_end(point: casadi.SX) -> casadi.SX:
    """A point's data as if it lay where its interval begins: there z is what holds at the point."""
    return casadi.vertcat(point[:12], 0, point[13:])


def _local(z: casadi.SX, free_yaw: bool, place: casadi.SX) -> list[casadi.SX]:
    """z of an interval that begins at the place."""
    x, yaw = point_constraints.local_variables(z, free_yaw, place)
    return [*x[:3], *yaw[:2], x[3], *yaw[2:]]


def _spline(free_yaw: bool) -> NDArray:
    """z from the coefficients."""
    if not free_yaw:
        return H_SPLINE
    both = np.zeros((7, 7))
    both[:3, :4], both[5, :4] = H_SPLINE[:3], H_SPLINE[3]
    both[3:5, 4:], both[6, 4:] = YAW_SPLINE[:2], YAW_SPLINE[2]
    return both


UNIFORM = (2, 3)
# arguments that are the same at all points


class Backend(StrEnum):
    """How the kernels are evaluated."""

    COMPILED = "compiled"
    VIRTUAL_MACHINE = "virtual machine"  # CasADi's, point by point: to check the other by


def source() -> str:
    """Return the LLVM source of all kernels."""
    return llvm_emitter.source([f for free_yaw in (False, True) for f in point_kernels(free_yaw)], UNIFORM)


@lru_cache(maxsize=1)
def machine_code() -> dict[str, Any]:
    """Return the compiled kernels by name; compiles them if that was never done."""
    names = tuple(f"{point_constraints.family(yaw)}_{what}" for yaw in (False, True) for what in _KERNELS)
    return llvm_functions("kernels", __name__, source, names)


_Bind = Callable[[list[NDArray], list[NDArray]], Callable[[], None]]
# settles the arrays that a function reads and those that it writes


def _functions(free_yaw: bool, points: int, chosen: Backend | None) -> tuple[_Bind, _Bind]:
    """Values and derivatives at that many points."""
    if chosen == Backend.VIRTUAL_MACHINE:
        values, derivatives = point_kernels(free_yaw)
        return _interpreted(values, points), _interpreted(derivatives, points)
    values, derivatives = (machine_code()[f"{point_constraints.family(free_yaw)}_{what}"] for what in _KERNELS)
    return _compiled(values, points), _compiled(derivatives, points)


def _compiled(function: Any, points: int) -> _Bind:
    def bind(reads: list[NDArray], writes: list[NDArray]) -> Callable[[], None]:
        pointers = [ctypes.byref(ctypes.c_char.from_buffer(each.data)) for each in (*reads, *writes)]  # holds them
        return partial(function, ctypes.c_long(points), *pointers)

    return bind


def _interpreted(function: casadi.Function, points: int) -> _Bind:
    everywhere = function.map(points)

    def bind(reads: list[NDArray], writes: list[NDArray]) -> Callable[[], None]:
        def run() -> None:
            wide = [np.tile(a[:, None], points) if i in UNIFORM else a for i, a in enumerate(reads)]
            for array, result in zip(writes, everywhere(*wide), strict=True):
                array[:] = np.array(result)

        return run

    return bind


class Points:
    """The kernels at the points of a problem, with the arrays that they read and write.

    Fill what they read, call evaluate() or differentiate(), and find the results in place.
    """

    def __init__(
        self, free_yaw: bool, data: NDArray, common: NDArray, weights: NDArray, chosen: Backend | None, spare: int = 0
    ) -> None:
        """`data` is (POINT_DATA, P), `common` (COMMON_DATA,), `weights` (3,) those of the penalties.

        Arrays of the rows have `spare` entries after those of the points, which the kernels leave alone.
        """
        k, points = coefficients(free_yaw), data.shape[1]
        self.coefficients = np.empty((k, points))
        # to read
        self.pulls = np.empty((len(barrier.PULLS), point_constraints.ROWS * points + spare))
        # to read, each row by row; differentiate() alone needs them
        self.rows = np.empty(point_constraints.ROWS * points + spare)
        # row by row; by evaluate() alone
        self.penalty = np.empty((1, points))
        # likewise
        self.jacobian = np.empty((point_constraints.ROWS * k, points))
        # all rows by the first coefficient first
        self.gradients = np.empty((len(barrier.PULLS) * k, points))
        # of the penalty, and of rows · each of the pulls but the first
        self.hessian = np.empty((k * (k + 1) // 2, points))
        # of penalty + multipliers · rows, plus Σ stiffness · (row of the Jacobian)² as an outer product: the lower
        # triangle, column by column
        given = [np.array(a, dtype=float, order="C") for a in (data, common, weights)]
        rows, *pulls = (
            array[: point_constraints.ROWS * points].reshape(point_constraints.ROWS, points)
            for array in (self.rows, *self.pulls)
        )
        reads = [self.coefficients, *given]
        values, derivatives = _functions(free_yaw, points, chosen)
        self._evaluate = values(reads, [rows, self.penalty])
        self._differentiate = derivatives([*reads, *pulls], [self.jacobian, self.gradients, self.hessian])

    def evaluate(self) -> None:
        """Rows and penalty."""
        self._evaluate()

    def differentiate(self) -> None:
        """The rows' Jacobian, gradients, and the Hessian."""
        self._differentiate()
