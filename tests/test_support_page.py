"""docs/support.md: each "yes" names a test that there is, and nothing is claimed of hardware."""

import ast
import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[1] / "docs" / "support.md"
LINES = PAGE.read_text().splitlines()
YES = sorted(set(re.findall(r'\[yes\]\((\S+) "(\w+)"\)', PAGE.read_text())))
TABLES = [line for line in LINES if line.startswith("|") and not line.startswith("|---")]


def test_there_are_as_many_proofs_as_claims():
    assert len(YES) > 15
    assert len(re.findall(r"(?i)\| *\[?yes", PAGE.read_text())) == len(re.findall(r"\[yes\]\(", PAGE.read_text()))


@pytest.mark.parametrize(("file", "test"), YES, ids=lambda value: value.rsplit("/", 1)[-1])
def test_a_yes_names_a_test_that_exists(file, test):
    tree = ast.parse((PAGE.parent / file).read_text())
    assert test in {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}


def test_no_hardware_is_claimed_to_have_flown():
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in TABLES]
    last = {row[-1] for row in rows if len(row) > 2} - {"hardware", "a real system"}
    assert last == {"not flown", "not tried"}
