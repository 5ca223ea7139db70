"""The command line only wires: what it calls lives in the other packages."""

import ast
from pathlib import Path

import pytest

COMMANDS = sorted((Path(__file__).parents[2] / "cfplan" / "cli").glob("*.py"))
MOST_LINES = 40  # of a function, from `def` on; click's decorators do not count


@pytest.mark.parametrize("file", COMMANDS, ids=lambda file: file.stem)
def test_no_function_of_the_command_line_is_longer_than_a_screen(file):
    long = {
        node.name: node.end_lineno - node.lineno + 1
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.end_lineno - node.lineno >= MOST_LINES
    }
    assert not long
