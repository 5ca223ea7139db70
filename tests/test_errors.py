"""Errors for people: each says what to do about it."""

import ast
import inspect
from unicodedata import category

import pytest
from hypothesis import given
from hypothesis import strategies as st
from sources import FILES, nodes

from cfplan import errors
from cfplan.learning.workers import SchedulerError

KINDS = {name for name, kind in inspect.getmembers(errors, inspect.isclass) if issubclass(kind, errors.CfplanError)} | {
    SchedulerError.__name__
}


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_every_error_has_a_hint(file):
    for call in nodes(file):
        if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id in KINDS:
            given = {keyword.arg: keyword.value for keyword in call.keywords}
            assert "hint" in given, f"{file}:{call.lineno}"
            assert not (isinstance(given["hint"], ast.Constant) and not given["hint"].value), f"{file}:{call.lineno}"


@given(what=st.text(), where=st.text(), hint=st.text(), times=st.sampled_from([1, 10_000]))
def test_an_error_is_one_line_that_a_terminal_shows_whole(what, where, hint, times):
    text = str(errors.InputError(what * times, where=where * times, hint=hint * times))
    assert all(character.isprintable() or category(character) == "Zs" for character in text)
    assert len(text) < 20_000  # a control character is written as up to ten others


def test_a_long_error_keeps_its_line_and_its_hint():
    text = str(errors.InputError("x" * 10_000, where="/tmp/" + "y" * 10_000 + ":7", hint="remove it"))
    assert len(text) < 1500
    assert ":7: xxx" in text
    assert text.endswith("…" + " (hint: remove it)")
