"""Generate numba code from a CasADi function that evaluates it at several points with each instruction.

Imported only when numba compiles.
"""

from collections.abc import Callable, Collection, Sequence
from typing import Any

import casadi
from llvmlite import ir
from numba.core import cgutils

from cfplan.vehicle.trigonometry import wave

_Value = Any  # an ir.Value of several points
_Operation = Callable[..., _Value]

_FREEDOM = ("nsz", "contract")  # products and sums may be fused; nothing else may be rearranged
_X = casadi.SX.sym("x")
_WAVES = {  # instead of the library's sine and cosine, which take one number
    casadi.OP_SIN: casadi.Function("sine", [_X], [wave(_X, 0.0, casadi.floor)]),
    casadi.OP_COS: casadi.Function("cosine", [_X], [wave(_X, 1.0, casadi.floor)]),
}


def generator(f: casadi.Function, uniform: Collection[int], width: int) -> _Operation:
    """Return a numba intrinsic's code generator, for arguments (..., first, points, inputs, results).

    It evaluates f at `width` points from the `first` on. `inputs` and `results` are tuples of arrays, one of each of
    the function's, with one quantity per row and one point per column; inputs numbered in `uniform` have one column.
    The generator raises NotImplementedError at an unknown instruction.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        _align_stack(builder)
        *_, first, points, inputs, results = arguments
        read, written = (
            [context.make_array(kind)(context, builder, array).data for kind, array in zip(
                kinds, cgutils.unpack_tuple(builder, arrays), strict=True
            )] for kinds, arrays in zip(signature.args[-2:], (inputs, results), strict=True)
        )  # fmt: skip
        vector = ir.VectorType(ir.DoubleType(), width)

        def place(array: Any, row: int) -> Any:
            index = builder.add(builder.mul(points, points.type(row)), first)
            return builder.bitcast(builder.gep(array, [index]), vector.as_pointer())

        def load(argument: int, row: int) -> _Value:
            if argument not in uniform:
                return builder.load(place(read[argument], row), align=8)
            number = builder.load(builder.gep(read[argument], [points.type(row)]))
            one = builder.insert_element(vector(ir.Undefined), number, ir.IntType(32)(0))
            return builder.shuffle_vector(one, vector(ir.Undefined), ir.VectorType(ir.IntType(32), width)([0] * width))

        def store(argument: int, row: int, value: _Value) -> None:
            builder.store(value, place(written[argument], row), align=8)

        _evaluate(builder, vector, f, load, store)
        return context.get_dummy_value()

    return generate


def _align_stack(builder: Any) -> None:
    """Align vectors on the stack with lines of the processor's cache; otherwise they take a quarter more time."""
    builder.function.attributes.add("noinline")
    builder.function.attributes.alignstack = 64


def _evaluate(
    builder: Any, vector: Any, f: casadi.Function, load: Callable[[int, int], _Value],
    store: Callable[[int, int, _Value], None],
) -> None:  # fmt: skip
    """Translate the instructions of CasADi's virtual machine; each writes to one of its registers."""
    operations = _operations(builder, vector)
    registers: dict[int, _Value] = {}
    for k in range(f.n_instructions()):
        operation, to, of = f.instruction_id(k), f.instruction_output(k), f.instruction_input(k)
        if operation == casadi.OP_INPUT:
            registers[to[0]] = load(*of)
        elif operation == casadi.OP_OUTPUT:
            store(to[0], to[1], registers[of[0]])
        elif operation == casadi.OP_CONST:
            registers[to[0]] = vector([f.instruction_constant(k)] * vector.count)
        elif operation in _WAVES:
            registers[to[0]] = _evaluate_one(builder, vector, _WAVES[operation], registers[of[0]])
        elif operation in operations:
            registers[to[0]] = operations[operation](*(registers[register] for register in of))
        else:
            raise NotImplementedError(f"{f.name()}: instruction {operation}")


def _evaluate_one(builder: Any, vector: Any, f: casadi.Function, argument: _Value) -> _Value:
    """Return the result of a function of one number."""
    results: list[_Value] = []
    _evaluate(builder, vector, f, lambda _argument, _row: argument, lambda _result, _row, value: results.append(value))
    return results[0]


def _operations(b: Any, vector: Any) -> dict[int, _Operation]:
    def call(name: str) -> _Operation:
        kind = ir.FunctionType(vector, [vector])
        return lambda x: b.call(cgutils.get_or_insert_function(b.module, kind, f"{name}.v{vector.count}f64"), [x])

    def inverse(x: _Value) -> _Value:  # one division for all that is divided by x
        return b.fdiv(vector([1.0] * vector.count), x, flags=_FREEDOM)

    return {
        casadi.OP_ADD: lambda x, y: b.fadd(x, y, flags=_FREEDOM),
        casadi.OP_SUB: lambda x, y: b.fsub(x, y, flags=_FREEDOM),
        casadi.OP_MUL: lambda x, y: b.fmul(x, y, flags=_FREEDOM),
        casadi.OP_DIV: lambda x, y: b.fmul(x, inverse(y), flags=_FREEDOM),
        casadi.OP_INV: inverse,
        casadi.OP_TWICE: lambda x: b.fadd(x, x, flags=_FREEDOM),
        casadi.OP_SQ: lambda x: b.fmul(x, x, flags=_FREEDOM),
        casadi.OP_NEG: b.fneg,
        casadi.OP_SQRT: call("llvm.sqrt"),
        casadi.OP_FLOOR: call("llvm.floor"),
        casadi.OP_FMAX: lambda x, y: b.select(b.fcmp_ordered(">", x, y), x, y),  # y where x is no number
        casadi.OP_LE: lambda x, y: b.uitofp(b.fcmp_ordered("<=", x, y), vector),
    }
