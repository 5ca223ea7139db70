"""Error texts: read from the sources what cfplan can say, with … for what only the moment knows.

docs/errors.md is made of them, so that it lists each error which the code can raise, and none that it cannot.
"""

import ast
import inspect
import itertools
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from cfplan import errors
from cfplan.errors import CfplanError, ExitCode
from cfplan.numbers import coordinates

_KINDS = Path(errors.__file__)
PACKAGE = _KINDS.parent
GAP = "…"  # what is not in the sources
_GAPS = re.compile(rf"{GAP}(?:\.{{3}}|[{GAP} ]*{GAP})")
_MOST = 8  # texts of one place in the sources; more than these are one with gaps
_DEEPEST = 8  # calls and names that are followed
_Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True, slots=True)
class ErrorText:
    """One place in the sources that says what is wrong."""

    module: str  # as "geometry/path_file.py"
    line: int
    messages: tuple[str, ...]  # what may be said there
    hints: tuple[str, ...]
    code: ExitCode | None  # None where that depends on what led to it

    @property
    def says_nothing(self) -> bool:
        """Return whether all of it comes from elsewhere, as where an error is passed on with its place."""
        return all(not re.search(r"[^\W\d_]{2}", re.sub(r"\(.*\)", "", text)) for text in self.messages)


def modules_with_errors() -> list[str]:
    """Return the modules that make errors, ascending."""
    return sorted({text.module for text in all_errors()})


@cache
def all_errors() -> tuple[ErrorText, ...]:
    """Return every place in cfplan that makes an error of a user's, or refuses a take-off, or ends a flight."""
    return tuple(text for file in _files() for text in _errors_of(file))


@cache
def _files() -> list[Path]:
    """Return the modules that may make errors, by their text: to parse all of them takes seconds."""
    likely = re.compile(rf"Error\(|\b(?:{'|'.join(_READERS)})\(")
    files = [file for file in sorted(PACKAGE.rglob("*.py")) if file != _KINDS]
    return [file for file in files if likely.search(file.read_text(encoding="utf-8"))]


def _errors_of(file: Path) -> Iterator[ErrorText]:
    source = _source(file)
    for scope, call in source.calls:
        read = _error if _called(call) in _exit_codes() else _READERS.get(_called(call))
        for messages, hints, code in read(source, scope, call) if read else ():
            yield ErrorText(str(file.relative_to(PACKAGE)), call.lineno, messages, hints, code)


@cache
def _exit_codes() -> Mapping[str, ExitCode | None]:
    """Return the exit code of each kind of error by its name; None where the code is that of the flight."""
    kinds = inspect.getmembers(errors, inspect.isclass)
    codes: dict[str, ExitCode | None] = {n: kind.exit_code for n, kind in kinds if issubclass(kind, CfplanError)}
    codes["FlightEndedError"] = None
    classes = [node for file in _files() for node in _source(file).tree.body if isinstance(node, ast.ClassDef)]
    for node in classes:  # those that a room adds are of these kinds
        for base in node.bases:
            if isinstance(base, ast.Name) and base.id in codes:
                codes[node.name] = codes[base.id]
    return codes


class _Source:
    """A module's syntax tree, with the functions around each call."""

    def __init__(self, file: Path):
        self.file = file
        self.tree = ast.parse(file.read_text(encoding="utf-8"))
        self.calls: list[tuple[tuple[_Function, ...], ast.Call]] = []
        self.functions: dict[str, _Function] = {}
        self._walk(self.tree, ())

    def _walk(self, node: ast.AST, scope: tuple[_Function, ...]) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.Call):
                self.calls.append((scope, child))
            if isinstance(child, _Function):
                self.functions.setdefault(child.name, child)
                self._walk(child, (*scope, child))
            else:
                self._walk(child, scope)


@cache
def _source(file: Path) -> _Source:
    return _Source(file)


def _called(call: ast.Call) -> str:
    return call.func.id if isinstance(call.func, ast.Name) else getattr(call.func, "attr", "")


# What a call says ---------------------------------------------------------------------------------------------------

_Said = tuple[tuple[str, ...], tuple[str, ...], ExitCode | None]
_Reader = Callable[["_Source", tuple[_Function, ...], ast.Call], list[_Said]]


def _error(source: _Source, scope: tuple[_Function, ...], call: ast.Call) -> list[_Said]:
    """Read an error with its hint."""
    hint = next((word.value for word in call.keywords if word.arg == "hint"), None)
    if not call.args or hint is None:
        return []
    code = _exit_codes()[_called(call)]
    return [(*said, code) for said in _Words(source, scope).pairs(call.args[0], hint)]


def _check(source: _Source, scope: tuple[_Function, ...], call: ast.Call) -> list[_Said]:
    """Read a check of preflight; one that cannot fail has no hint."""
    if len(call.args) < 5:
        return []
    words = _Words(source, scope)
    names, limits = words.of(call.args[0]), words.of(call.args[2])
    said = tuple(f"{name}: {GAP}, must be {limit}" for name, limit in itertools.product(names, limits))
    return [(said, words.of(call.args[4]), ExitCode.PREFLIGHT)]


def _reason(position: int) -> _Reader:
    """Return a reader of a reason to end a flight, which is an argument at that position."""

    def read(source: _Source, scope: tuple[_Function, ...], call: ast.Call) -> list[_Said]:
        given = call.args[position] if len(call.args) > position else None
        around = [argument.arg for function in scope for argument in function.args.args]
        if given is None or isinstance(given, ast.Attribute | ast.Call) or getattr(given, "id", "") in around:
            return []  # passed on
        said = tuple(re.sub(r"\{[^}]*\}", GAP, text) for text in _Words(source, scope).of(given))
        operator = any("ENDED_BY_OPERATOR" in ast.unparse(argument) for argument in call.args)
        code = ExitCode.ENDED_BY_OPERATOR if operator else ExitCode.ENDED_BY_SAFETY
        return [(said, (), code)] if any(said) else []

    return read


def _usage(source: _Source, scope: tuple[_Function, ...], call: ast.Call) -> list[_Said]:
    """Read an error of click, which has no hint."""
    return [(_Words(source, scope).of(call.args[0]), (), ExitCode.USAGE)] if call.args else []


_READERS: Mapping[str, _Reader] = {
    "Check": _check,
    "safety_abort": _reason(1),
    "Abort": _reason(2),
    "_rung": _reason(2),
    "BadParameter": _usage,
    "ClickException": _usage,
}


# What an expression reads like --------------------------------------------------------------------------------------


class _Words:
    """Reads expressions of one place in a module as the texts that they may be."""

    def __init__(self, source: _Source, scope: tuple[_Function, ...], depth: int = 0):
        self._source, self._scope, self._depth = source, scope, depth

    def of(self, node: ast.expr) -> tuple[str, ...]:
        """Return the texts that an expression may be, each once."""
        texts = dict.fromkeys(_GAPS.sub(GAP, text).strip() for text in self._texts(node))
        found = tuple(text for text in texts if text)
        return found if len(found) <= _MOST else (GAP,)

    def pairs(self, what: ast.expr, hint: ast.expr) -> list[tuple[tuple[str, ...], tuple[str, ...]]]:
        """Return the texts of a message with those of its hint, one pair for each at which both are set together."""
        if isinstance(what, ast.Name) and isinstance(hint, ast.Name) and self._scope and self._depth < _DEEPEST:
            assigned = _assigned(self._scope[-1])
            whats, hints = assigned.get(what.id, ()), assigned.get(hint.id, ())
            both = [(w, h) for w in whats for h in hints if w.node is h.node and w.part is not None]
            if both and len(both) == len(whats) == len(hints):
                return [
                    pair
                    for one, other in both
                    for words, row in self._in(self._scope)._rows(one)
                    for pair in words.pairs(row.elts[one.part or 0], row.elts[other.part or 0])
                ]
        return [(self.of(what), self.of(hint))]

    def _rows(self, value: "_Value") -> Iterator[tuple["_Words", ast.Tuple]]:
        """Go through what sets several names at once, where that is written out in this module."""
        node: ast.expr | None = value.node
        words, rows = self, [node]
        if isinstance(node, ast.Call) and (function := self._function(node)) is not None:
            words, rows = self._in((function,)), [*_returned(function)]
        elif value.each:
            node = _module_value(self._source, node.id) if isinstance(node, ast.Name) else node
            rows = [*node.elts] if isinstance(node, ast.Tuple | ast.List) else []
        yield from ((words, row) for row in rows if isinstance(row, ast.Tuple))

    def _texts(self, node: ast.expr) -> list[str]:
        if self._depth > _DEEPEST:
            return [GAP]
        constant = _constant(self._source.file, node)
        if constant is not None:
            return [constant] if isinstance(constant, str) else [GAP]
        match node:
            case ast.JoinedStr():
                return _joined([self._texts(part) for part in node.values])
            case ast.FormattedValue():
                return self._formatted(node)
            case ast.BinOp(op=ast.Add()) if _is_text(node):
                return _joined([self._texts(node.left), self._texts(node.right)])
            case ast.BinOp(op=ast.Mult()) if _is_text(node):
                return ["", *(self._texts(node.left))]
            case ast.IfExp():
                return self._texts(node.body) + self._texts(node.orelse)
            case ast.BoolOp(op=ast.Or()):
                return [text for value in node.values for text in self._texts(value)]
            case ast.Name():
                return self._named(node.id)
            case ast.Call():
                return self._call(node)
            case ast.Subscript(value=ast.Name(id=name)):
                return self._chosen(name)
        return [GAP]

    def _formatted(self, node: ast.FormattedValue) -> list[str]:
        constant = _constant(self._source.file, node.value)
        spec = _constant(self._source.file, node.format_spec) if node.format_spec else ""
        if constant is not None and isinstance(spec, str):
            return [repr(constant) if node.conversion == ord("r") else format(constant, spec)]
        texts = self._texts(node.value)
        return [f"'{text}'" for text in texts] if node.conversion == ord("r") else texts

    def _named(self, name: str) -> list[str]:
        """Return what a variable may be: what is assigned to it, or what callers give."""
        for depth in reversed(range(len(self._scope))):
            function, outer = self._scope[depth], self._scope[: depth + 1]
            found = [text for value in _assigned(function).get(name, ()) for text in self._in(outer)._part(value)]
            if found:
                return [text for text in found if text != GAP] + [GAP] * (GAP in found)
            arguments = [a.arg for a in (*function.args.posonlyargs, *function.args.args)]
            if name in arguments or name in [a.arg for a in function.args.kwonlyargs]:
                return self._given(function, name, arguments)
        return [GAP]

    def _part(self, value: "_Value") -> list[str]:
        """Return what a value may be, or its part of that number where it is one of several."""
        if value.part is None:
            return self._texts(value.node)
        rows = list(self._rows(value))
        return [text for words, row in rows for text in words._texts(row.elts[value.part])] or [GAP]

    def _function(self, node: ast.Call) -> _Function | None:
        """Return the function of this module that is called, where it is one and not this one."""
        function = self._source.functions.get(_called(node)) if isinstance(node.func, ast.Name) else None
        return None if function is None or function in self._scope else function

    def _given(self, function: _Function, name: str, arguments: list[str]) -> list[str]:
        """Return what the callers in this module give a function for one of its parameters."""
        found = []
        method = arguments[:1] == ["self"]
        for scope, call in self._source.calls:
            if _called(call) != function.name or (function in scope):
                continue
            place = arguments.index(name) - method if name in arguments else len(call.args)
            values = [word.value for word in call.keywords if word.arg == name]
            values += [call.args[place]] if 0 <= place < len(call.args) else []
            found += [text for value in values for text in self._in(scope)._texts(value)]
        return found or [GAP]

    def _call(self, node: ast.Call) -> list[str]:
        """Return what a function of this module returns, or what a method of a text makes of it."""
        if isinstance(node.func, ast.Attribute) and node.func.attr == "format":
            return [re.sub(r"\{[^}]*\}", GAP, text) for text in self._texts(node.func.value)]
        if isinstance(node.func, ast.Attribute) and node.func.attr == "replace":
            return self._texts(node.func.value)
        if isinstance(node.func, ast.Attribute) and node.func.attr == "get" and isinstance(node.func.value, ast.Name):
            default = self._texts(node.args[1]) if len(node.args) > 1 else []
            return [*self._chosen(node.func.value.id), *default]
        if isinstance(node.func, ast.Name) and node.func.id in ("str", "printable") and node.args:
            return self._texts(node.args[0])
        if _called(node) == coordinates.__name__:
            return [coordinates((0.0, 0.0, 0.0), "g").replace("0", GAP)]
        function = self._function(node)
        if function is None:
            return [GAP]
        return [text for value in _returned(function) for text in self._in((function,))._texts(value)] or [GAP]

    def _chosen(self, name: str) -> list[str]:
        """Return the texts of a mapping that is written out here or in the module."""
        places: list[ast.AST] = [*reversed(self._scope), self._source.tree]
        for place in places:
            for value in _assigned(place).get(name, ()):
                if isinstance(value.node, ast.Dict) and value.part is None:
                    return [text for each in value.node.values for text in self._texts(each)]
        return [GAP]

    def _in(self, scope: tuple[_Function, ...]) -> "_Words":
        return _Words(self._source, scope, self._depth + 1)


def _joined(parts: list[list[str]]) -> list[str]:
    """Return every way to choose one text of each part, one after another."""
    while math.prod(map(len, parts)) > _MOST:
        widest = max(parts, key=len)
        parts = [[GAP] if part is widest else part for part in parts]
    return ["".join(chosen) for chosen in itertools.product(*parts)]


def _is_text(node: ast.expr) -> bool:
    """Return whether an expression adds or repeats texts, not numbers."""
    match node:
        case ast.BinOp(op=ast.Add()):
            return _is_text(node.left) or _is_text(node.right)
        case ast.BinOp(op=ast.Mult()):
            return _is_text(node.left)
        case ast.IfExp():
            return _is_text(node.body)
    return isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Constant) and isinstance(node.value, str))


def _returned(function: _Function) -> list[ast.expr]:
    return [each.value for each in ast.walk(function) if isinstance(each, ast.Return) and each.value]


@dataclass(frozen=True, slots=True)
class _Value:
    """What is assigned to a name."""

    node: ast.expr
    part: int | None = None  # which of the values at once, where it is one of several
    each: bool = False  # the name goes through it, in a loop


@cache
def _assigned(place: ast.AST) -> Mapping[str, Sequence[_Value]]:
    """Return what is assigned to each name of a function or module."""
    found: dict[str, list[_Value]] = {}
    for node in ast.walk(place):
        match node:
            case ast.Assign(targets=targets, value=value):
                pairs = [(target, value) for target in targets]
            case ast.AnnAssign(target=target, value=ast.expr() as value) | ast.NamedExpr(target=target, value=value):
                pairs = [(target, value)]
            case ast.For(target=target, iter=value) | ast.comprehension(target=target, iter=value):
                pairs = [(target, value)]
            case _:
                continue
        loop = isinstance(node, ast.For | ast.comprehension)
        for target, value in pairs:
            if isinstance(target, ast.Name) and not loop:
                found.setdefault(target.id, []).append(_Value(value))
            if isinstance(target, ast.Tuple):
                for number, name in enumerate(target.elts):
                    if isinstance(name, ast.Name):
                        found.setdefault(name.id, []).append(_Value(value, number, loop))
    return found


def _module_value(source: _Source, name: str) -> ast.expr | None:
    """Return what a module assigns to a name."""
    return next((value.node for value in _assigned(source.tree).get(name, ()) if value.part is None), None)


def _constant(file: Path, node: ast.expr | None, depth: int = 0) -> object | None:
    """Return the value of an expression that is the same always; None where it is not, or not to be told."""
    if node is None or depth > _DEEPEST:
        return None
    match node:
        case ast.Constant():
            return node.value
        case ast.Name():
            return module_constant(file, node.id, depth + 1)
        case ast.UnaryOp(op=ast.USub()) | ast.BinOp():
            return _number(file, node, depth + 1)
        case ast.JoinedStr():
            texts = [_formatted_constant(file, part, depth + 1) for part in node.values]
            return None if None in texts else "".join(map(str, texts))
        case ast.Tuple() | ast.List():
            values = [_constant(file, each, depth + 1) for each in node.elts]
            return None if None in values else tuple(values)
        case ast.Dict():
            keys = [_constant(file, each, depth + 1) for each in node.keys]
            return None if None in keys else tuple(keys)
        case ast.Call(func=ast.Attribute(attr="join", value=ast.Constant(value=str(between))), args=[words]):
            listed = _constant(file, words, depth + 1)
            return between.join(map(str, listed)) if isinstance(listed, tuple) else None
        case ast.Call(func=ast.Name(id="MappingProxyType"), args=[inner]):
            return _constant(file, inner, depth + 1)
    return None


def _formatted_constant(file: Path, part: ast.expr, depth: int) -> object | None:
    if not isinstance(part, ast.FormattedValue):
        return _constant(file, part, depth)
    value = _constant(file, part.value, depth)
    spec = _constant(file, part.format_spec, depth) if part.format_spec else ""
    return None if value is None else repr(value) if part.conversion == ord("r") else format(value, str(spec))


def _number(file: Path, node: ast.expr, depth: int) -> object | None:
    """Return the value of arithmetic with constants."""
    if isinstance(node, ast.UnaryOp):
        value = _constant(file, node.operand, depth)
        return -value if isinstance(value, int | float) else None
    assert isinstance(node, ast.BinOp)
    left, right = _constant(file, node.left, depth), _constant(file, node.right, depth)
    if isinstance(left, str) and isinstance(right, str) and isinstance(node.op, ast.Add):
        return left + right
    if not isinstance(left, int | float) or not isinstance(right, int | float):
        return None
    match node.op:
        case ast.Add():
            return left + right
        case ast.Sub():
            return left - right
        case ast.Mult():
            return left * right
        case ast.Div():
            return left / right if right else None
        case ast.LShift():
            return left << right if isinstance(left, int) and isinstance(right, int) else None
        case ast.Pow():
            return left**right
    return None


def module_constant(file: Path, name: str, depth: int = 0) -> object | None:
    """Return the value of a name that a module defines, by itself or by importing it from cfplan."""
    for node in _source(file).tree.body:
        target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
        if isinstance(node, ast.Assign | ast.AnnAssign) and isinstance(target, ast.Name) and target.id == name:
            return _constant(file, node.value, depth)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("cfplan."):
            for alias in node.names:
                if (alias.asname or alias.name) == name:
                    place = PACKAGE.joinpath(*str(node.module).split(".")[1:])
                    other = place / "__init__.py" if place.is_dir() else place.with_suffix(".py")
                    return module_constant(other, alias.name, depth + 1)
    return None
