"""The sources of cfplan and of the studies as syntax trees, each parsed once in a process; none is changed."""

import ast
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "cfplan"
FILES = sorted(PACKAGE.rglob("*.py"))
STUDIES = PACKAGE.parent / "studies"
STUDY_FILES = sorted(STUDIES.rglob("*.py"))


@cache
def tree(file: Path) -> ast.Module:
    """A file's syntax tree."""
    return ast.parse(file.read_text())


@cache
def nodes(file: Path) -> tuple[ast.AST, ...]:
    """All nodes of a file."""
    return tuple(ast.walk(tree(file)))
