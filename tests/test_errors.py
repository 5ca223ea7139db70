"""Errors for people: each says what to do about it."""

import ast
import inspect
from pathlib import Path

import pytest

import cfplan
from cfplan import errors
from cfplan.learning.dataset import SchedulerError

KINDS = {name for name, kind in inspect.getmembers(errors, inspect.isclass) if issubclass(kind, errors.CfplanError)} | {
    SchedulerError.__name__
}
FILES = sorted(Path(cfplan.__file__).parent.rglob("*.py"))


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_every_error_has_a_hint(file):
    for call in ast.walk(ast.parse(file.read_text())):
        if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id in KINDS:
            given = {keyword.arg: keyword.value for keyword in call.keywords}
            assert "hint" in given, f"{file}:{call.lineno}"
            assert not (isinstance(given["hint"], ast.Constant) and not given["hint"].value), f"{file}:{call.lineno}"
