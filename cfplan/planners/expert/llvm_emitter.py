"""Writes CasADi functions out as LLVM source that evaluates them at many points, several with one instruction.

Arrays hold a quantity a row and a point a column. What is the same at all points is computed once, before the loop over
the points; each number is divided by once, and multiplied with the reciprocal from then on.
"""

import struct
from collections.abc import Collection, Sequence

import casadi

from cfplan.vehicle import trigonometry

_FREELY = "nsz contract"  # products and sums may be fused; nothing else may be rearranged
_OPERATIONS = {casadi.OP_ADD: "fadd", casadi.OP_SUB: "fsub", casadi.OP_MUL: "fmul"}
_READ, _WRITTEN = "!alias.scope !1, !noalias !2", "!alias.scope !2, !noalias !1"  # results overlap no argument
# Vectors that do not fit the registers go to the stack, and must not lie across two lines of the cache there.
_ENDING = """
!0 = !{!0}
!3 = !{!3, !0}
!4 = !{!4, !0}
!1 = !{!3}
!2 = !{!4}
attributes #0 = { alignstack=64 "min-legal-vector-width"="512" "prefer-vector-width"="512" }
"""


def source(functions: Sequence[casadi.Function], uniform: Collection[int], lanes: int) -> str:
    """Return LLVM source of void f(points, inputs…, results…); the inputs numbered in `uniform` are one column.

    `lanes` points are taken with one instruction, and `points` must be a multiple of that. Raises NotImplementedError
    for an instruction that is not known here.
    """
    return _preamble(lanes) + "\n".join(_function(each, uniform, lanes) for each in functions) + _ENDING


def _number(value: float) -> str:
    return f"0x{struct.unpack('>Q', struct.pack('>d', float(value)))[0]:016X}"


def _vector_type(lanes: int) -> str:
    return f"<{lanes} x double>"


def _vector(number: str, lanes: int) -> str:
    return f"<{', '.join([f'double {number}'] * lanes)}>"


def _preamble(lanes: int) -> str:
    """Return sine and cosine as in trigonometry.py; rounding r - 3/8 is the floor where r is a multiple of 1/4."""
    lines: list[str] = []
    wide, mask = _vector_type(lanes), f"<{lanes} x i1>"

    def constant(value: float) -> str:
        return _vector(_number(value), lanes)

    def emit(text: str) -> str:
        lines.append(f"  %v{len(lines)} = {text}")
        return f"%v{len(lines) - 1}"

    def op(name: str, a: str, b: str) -> str:
        return emit(f"{name} {_FREELY} {wide} {a}, {b}")

    def rounded(a: str) -> str:
        return emit(f"call {wide} @llvm.rint.v{lanes}f64({wide} {a})")

    def polynomial(z: str, coefficients: Sequence[float]) -> str:
        total = constant(coefficients[-1])
        for coefficient in coefficients[-2::-1]:
            total = op("fadd", constant(coefficient), op("fmul", z, total))
        return total

    def equals(a: str, value: float) -> str:
        return emit(f"fcmp oeq {wide} {a}, {constant(value)}")

    turns = rounded(op("fmul", "%angle", constant(trigonometry.PER_QUARTER)))
    x = "%angle"
    for part in trigonometry.QUARTER:
        x = op("fsub", x, op("fmul", turns, constant(part)))
    z = op("fmul", x, x)
    sine = op("fadd", x, op("fmul", op("fmul", x, z), polynomial(z, trigonometry.SINE)))
    cosine = op("fmul", op("fmul", z, z), polynomial(z, trigonometry.COSINE))
    cosine = op("fadd", op("fsub", constant(1.0), op("fmul", constant(0.5), z)), cosine)
    total = op("fadd", turns, "%quarters")
    whole = rounded(op("fsub", op("fmul", constant(0.25), total), constant(0.375)))
    quadrant = op("fsub", total, op("fmul", constant(4.0), whole))
    odd = emit(f"or {mask} {equals(quadrant, 1.0)}, {equals(quadrant, 3.0)}")
    value = emit(f"select {mask} {odd}, {wide} {cosine}, {wide} {sine}")
    negative = emit(f"fcmp oge {wide} {quadrant}, {constant(2.0)}")
    opposite = emit(f"fneg {wide} {value}")
    result = emit(f"select {mask} {negative}, {wide} {opposite}, {wide} {value}")
    body = "\n".join(lines)
    return f"""declare {wide} @llvm.sqrt.v{lanes}f64({wide})
declare double @llvm.sqrt.f64(double)
declare {wide} @llvm.rint.v{lanes}f64({wide})
define internal {wide} @wave({wide} %angle, {wide} %quarters) alwaysinline {{
{body}
  ret {wide} {result}
}}
"""


def _function(f: casadi.Function, uniform: Collection[int], lanes: int) -> str:
    writer = _Writer(uniform, lanes)
    for k in range(f.n_instructions()):
        writer.add(f, k)
    inputs = "".join(f", ptr nocapture readonly %in{i}" for i in range(f.n_in()))
    results = "".join(f", ptr noalias nocapture %out{i}" for i in range(f.n_out()))
    before, inside = ("\n".join(f"  {line}" for line in lines) for lines in (writer.before, writer.inside))
    return f"""define void @{f.name()}(i64 %points{inputs}{results}) #0 {{
entry:
{before}
  %any = icmp sgt i64 %points, 0
  br i1 %any, label %loop, label %end
loop:
  %p = phi i64 [0, %entry], [%next, %loop]
{inside}
  %next = add i64 %p, {lanes}
  %more = icmp slt i64 %next, %points
  br i1 %more, label %loop, label %end
end:
  ret void
}}
"""


class _Writer:
    """The lines before the loop over points, and those inside, as a function's instructions are added one by one."""

    def __init__(self, uniform: Collection[int], lanes: int):
        self.before: list[str] = []
        self.inside: list[str] = []
        self.uniform_inputs = uniform
        self.lanes, self.vector = lanes, _vector_type(lanes)
        self.narrow: set[str] = set()  # values that are one double, the same at all points
        self.slots: dict[int, str] = {}  # what each of the virtual machine's registers holds
        self.widened: dict[str, str] = {}
        self.reciprocals: dict[str, str] = {}

    def add(self, f: casadi.Function, number: int) -> None:
        """Write one instruction of the virtual machine."""
        operation, outputs, inputs = f.instruction_id(number), f.instruction_output(number), f.instruction_input(number)
        if operation == casadi.OP_INPUT:
            self.slots[outputs[0]] = self._load(*inputs)
        elif operation == casadi.OP_OUTPUT:
            place = self._place(f"%out{outputs[0]}", outputs[1])
            self.inside.append(
                f"store {self.vector} {self._wide(self.slots[inputs[0]])}, ptr {place}, align 8, {_WRITTEN}"
            )
        elif operation == casadi.OP_CONST:
            self.slots[outputs[0]] = _number(f.instruction_constant(number))
        else:
            result = self._compute(operation, [self.slots[register] for register in inputs])
            if result is None:
                raise NotImplementedError(f"{f.name()}: instruction {operation}")
            self.slots[outputs[0]] = result

    def _compute(self, operation: int, arguments: list[str]) -> str | None:
        a, b = arguments[0], arguments[-1]
        if operation in _OPERATIONS:
            return self._op(_OPERATIONS[operation], a, b)
        if operation == casadi.OP_DIV:
            return self._op("fmul", a, self._reciprocal(b))
        if operation == casadi.OP_INV:
            return self._reciprocal(a)
        if operation == casadi.OP_TWICE:
            return self._op("fmul", _number(2.0), a)
        if operation == casadi.OP_SQ:
            return self._op("fmul", a, a)
        if operation == casadi.OP_NEG:
            return self._emit(f"fneg {self._type(a)} {a}", not self._is_narrow(a))
        if operation == casadi.OP_SQRT:
            kind = "f64" if self._is_narrow(a) else f"v{self.lanes}f64"
            return self._emit(f"call {self._type(a)} @llvm.sqrt.{kind}({self._type(a)} {a})", not self._is_narrow(a))
        if operation in (casadi.OP_SIN, casadi.OP_COS):
            quarters = _vector(_number(0.0 if operation == casadi.OP_SIN else 1.0), self.lanes)
            return self._emit(
                f"call {self.vector} @wave({self.vector} {self._wide(a)}, {self.vector} {quarters})", True
            )
        if operation == casadi.OP_FMAX:  # the number that is the same everywhere where the other is none
            a, b = (self._wide(each) for each in ((a, b) if self._is_narrow(b) else (b, a)))
            larger = self._emit(f"fcmp ogt {self.vector} {a}, {b}", True)
            return self._emit(f"select <{self.lanes} x i1> {larger}, {self.vector} {a}, {self.vector} {b}", True)
        if operation == casadi.OP_LE:
            holds = self._emit(f"fcmp ole {self.vector} {self._wide(a)}, {self._wide(b)}", True)
            return self._emit(f"uitofp <{self.lanes} x i1> {holds} to {self.vector}", True)
        return None

    def _emit(self, text: str, varies: bool) -> str:
        name = f"%t{len(self.before) + len(self.inside)}"
        (self.inside if varies else self.before).append(f"{name} = {text}")
        if not varies:
            self.narrow.add(name)
        return name

    def _is_narrow(self, value: str) -> bool:
        return value in self.narrow or value.startswith("0x")

    def _type(self, value: str) -> str:
        return "double" if self._is_narrow(value) else self.vector

    def _wide(self, value: str) -> str:
        """Return the value as a vector, its own or one of equal numbers."""
        if not self._is_narrow(value):
            return value
        if value.startswith("0x"):
            return _vector(value, self.lanes)
        if value not in self.widened:
            one = self._emit(f"insertelement {self.vector} poison, double {value}, i32 0", False)
            all_lanes = f"shufflevector {self.vector} {one}, {self.vector} poison, <{self.lanes} x i32> zeroinitializer"
            self.widened[value] = self._emit(all_lanes, False)
        return self.widened[value]

    def _op(self, name: str, a: str, b: str) -> str:
        if self._is_narrow(a) and self._is_narrow(b):
            return self._emit(f"{name} {_FREELY} double {a}, {b}", False)
        return self._emit(f"{name} {_FREELY} {self.vector} {self._wide(a)}, {self._wide(b)}", True)

    def _reciprocal(self, value: str) -> str:
        if value not in self.reciprocals:
            self.reciprocals[value] = self._op("fdiv", _number(1.0), value)
        return self.reciprocals[value]

    def _place(self, array: str, row: int) -> str:
        """Return the address of a row's entries at the points at hand."""
        begin = self._emit(f"mul i64 %points, {row}", False)
        index = self._emit(f"add i64 {begin}, %p", True)
        return self._emit(f"getelementptr double, ptr {array}, i64 {index}", True)

    def _load(self, argument: int, row: int) -> str:
        if argument in self.uniform_inputs:
            place = self._emit(f"getelementptr double, ptr %in{argument}, i64 {row}", False)
            return self._emit(f"load double, ptr {place}, align 8, {_READ}", False)
        return self._emit(f"load {self.vector}, ptr {self._place(f'%in{argument}', row)}, align 8, {_READ}", True)
