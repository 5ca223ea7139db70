"""What must hold at a point, by the spline coefficients of its interval, with derivatives; eight points at a time.

In an interval h is made of four coefficients of a cubic B-spline and yaw of three of a quadratic one, so everything
physical at a point follows from at most seven numbers (point_constraints.py). CasADi differentiates those expressions;
this module writes them out as C on vectors of eight doubles, computes what is the same at all points once, and divides
by each number once. Without a C compiler CasADi's virtual machine evaluates the same expressions, point by point.

Arrays hold a quantity a row and a point a column; columns are a multiple of LANES.
"""

import ctypes
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from pathlib import Path as FilePath
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from cfplan.planners.expert import point_constraints
from cfplan.planners.expert.compiled import Backend, shared_library
from cfplan.planners.solver import barrier
from cfplan.vehicle import airframe, flatness, trigonometry

LANES = 8
H_SPLINE = np.array([[1 / 6, 4 / 6, 1 / 6, 0], [-1 / 2, 0, 1 / 2, 0], [1, -2, 1, 0], [-1, 3, -3, 1]])
# x, x', x'', x''' at an interval's left end, from the four coefficients that matter there, in node units
YAW_SPLINE = np.array([[1 / 2, 1 / 2, 0], [-1, 1, 0], [1, -2, 1]])
# ψ, ψ', ψ'' likewise

_PREAMBLE = """
typedef double wide __attribute__((vector_size(64), aligned(8)));
typedef long long mask __attribute__((vector_size(64), aligned(8)));
static inline wide w_sqrt(wide x) { for (int i = 0; i < 8; ++i) x[i] = __builtin_sqrt(x[i]); return x; }
static inline wide w_max(wide x, double y) { for (int i = 0; i < 8; ++i) x[i] = x[i] > y ? x[i] : y; return x; }
static inline wide w_le(wide x, wide y) { for (int i = 0; i < 8; ++i) x[i] = x[i] <= y[i]; return x; }
static inline wide w_round(wide x) { return x + 0x1.8p52 - 0x1.8p52; }
static inline wide w_pick(mask m, wide x, wide y) { return (wide)(((mask)x & m) | ((mask)y & ~m)); }
"""


def _polynomial(coefficients: Sequence[float]) -> str:
    return "".join(f"{c!r} + z * (" for c in coefficients[:-1]) + repr(coefficients[-1]) + ")" * (len(coefficients) - 1)


_TRIGONOMETRY = f"""
/* as in trigonometry.py; rounding r - 3/8 is the floor where r is a multiple of 1/4 */
static inline wide wave(wide angle, double quarters) {{
  const wide turns = w_round(angle * {trigonometry.PER_QUARTER!r});
  const wide x = ((angle - turns * {trigonometry.QUARTER[0]!r}) - turns * {trigonometry.QUARTER[1]!r})
    - turns * {trigonometry.QUARTER[2]!r};
  const wide z = x * x;
  const wide sine = x + x * z * ({_polynomial(trigonometry.SINE)});
  const wide cosine = 1.0 - 0.5 * z + z * z * ({_polynomial(trigonometry.COSINE)});
  const wide all = turns + quarters;
  const wide quadrant = all - 4.0 * w_round(0.25 * all - 0.375);
  const wide value = w_pick((mask)((quadrant == 1.0) | (quadrant == 3.0)), cosine, sine);
  return w_pick((mask)(quadrant >= 2.0), -value, value);
}}
static inline wide w_sin(wide x) {{ return wave(x, 0.0); }}
static inline wide w_cos(wide x) {{ return wave(x, 1.0); }}
"""


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


def source() -> str:
    """The C source of all kernels."""
    return (
        _PREAMBLE
        + _TRIGONOMETRY
        + "\n".join(_c_function(f) for free_yaw in (False, True) for f in point_kernels(free_yaw))
    )


_BINARY = {casadi.OP_ADD: "+", casadi.OP_SUB: "-", casadi.OP_MUL: "*"}
_CALLS = {casadi.OP_SQRT: "w_sqrt", casadi.OP_COS: "w_cos", casadi.OP_SIN: "w_sin"}


def _c_function(f: casadi.Function) -> str:
    """One loop over all points around the function's instructions; what is uniform is computed before it."""
    before: list[str] = []
    inside: list[str] = []
    slot: dict[int, str] = {}  # what each of the virtual machine's registers holds
    uniform: set[str] = set()
    reciprocals: dict[str, str] = {}

    def emit(expression: str, *operands: str, varies: bool = False) -> str:
        name = f"t{len(before) + len(inside)}"
        if varies or any(operand not in uniform for operand in operands):
            inside.append(f"const wide {name} = {expression};")
        else:
            uniform.add(name)
            before.append(f"const double {name} = {expression.replace('w_', '__builtin_')};")
        return name

    def inverse(name: str) -> str:
        if name not in reciprocals:
            reciprocals[name] = emit(f"1.0 / {name}", name)
        return reciprocals[name]

    for k in range(f.n_instructions()):
        operation, outputs = f.instruction_id(k), f.instruction_output(k)
        arguments = f.instruction_input(k)
        if operation == casadi.OP_INPUT:
            argument, row = arguments
            if argument in UNIFORM:
                value = emit(f"in{argument}[{row}]")
            else:
                value = emit(f"*(const wide *)(in{argument} + {row} * stride + p)", varies=True)
        elif operation == casadi.OP_OUTPUT:
            result, row = outputs
            inside.append(f"*(wide *)(out{result} + {row} * stride + p) = {slot[arguments[0]]} + (wide){{0}};")
            continue
        elif operation == casadi.OP_CONST:
            value = emit(repr(float(f.instruction_constant(k))))
        else:
            a, *rest = (slot[register] for register in arguments)
            b = rest[0] if rest else ""
            if operation in _BINARY:
                value = emit(f"{a} {_BINARY[operation]} {b}", a, b)
            elif operation == casadi.OP_DIV:
                b = inverse(b)
                value = emit(f"{a} * {b}", a, b)
            elif operation == casadi.OP_INV:
                value = inverse(a)
            elif operation == casadi.OP_TWICE:
                value = emit(f"2.0 * {a}", a)
            elif operation == casadi.OP_SQ:
                value = emit(f"{a} * {a}", a)
            elif operation == casadi.OP_NEG:
                value = emit(f"-{a}", a)
            elif operation in _CALLS:
                value = emit(f"{_CALLS[operation]}({a})", a)
            elif operation == casadi.OP_FMAX:
                a, b = (a, b) if b in uniform else (b, a)
                value = emit(f"w_max({a}, {b})", a, b)
            elif operation == casadi.OP_LE:
                value = emit(f"w_le({a} + (wide){{0}}, {b} + (wide){{0}})", a, b, varies=True)
            else:
                raise NotImplementedError(f"{f.name()}: instruction {operation}")
        slot[outputs[0]] = value
    inputs = "".join(f", const double *in{i}" for i in range(f.n_in()))
    results = "".join(f", double *restrict out{i}" for i in range(f.n_out()))
    body = "\n  ".join(before) + "\n  for (long p = 0; p < stride; p += 8) {\n    " + "\n    ".join(inside)
    return f"void {f.name()}(long stride{inputs}{results}) {{\n  {body}\n  }}\n}}\n"


@lru_cache(maxsize=1)
def machine_code() -> FilePath | None:
    """The compiled kernels, or None where that is not possible."""
    modules = (barrier, point_constraints, flatness, airframe, trigonometry)
    files = [FilePath(__file__), *(FilePath(str(module.__file__)) for module in modules)]
    return shared_library("kernels", files, source)


def backend() -> Backend:
    """What evaluates kernels here; compiles if that was never done."""
    return Backend.COMPILED if machine_code() else Backend.VIRTUAL_MACHINE


_Bind = Callable[[list[NDArray], list[NDArray]], Callable[[], None]]
# settles the arrays that a function reads and those that it writes


def _functions(free_yaw: bool, points: int, chosen: Backend | None) -> tuple[_Bind, _Bind]:
    """Values and derivatives at that many points."""
    kernels = point_kernels(free_yaw) if chosen == Backend.VIRTUAL_MACHINE or not machine_code() else None
    if kernels:
        return _interpreted(kernels[0], points), _interpreted(kernels[1], points)
    values, derivatives = _loaded(point_constraints.family(free_yaw))
    return _compiled(values, points), _compiled(derivatives, points)


@lru_cache(maxsize=2)
def _loaded(family: str) -> tuple[Any, Any]:
    library = ctypes.CDLL(str(machine_code()))
    return library[f"{family}_values"], library[f"{family}_derivatives"]


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
