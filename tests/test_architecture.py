"""docs/architecture.md is true: its files exist, and searching for an idea's name finds its file first."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest
from sources import tree

REPOSITORY = Path(__file__).parent.parent
PACKAGE = REPOSITORY / "cfplan"
PAGE = (REPOSITORY / "docs" / "architecture.md").read_text()
_START = PAGE.index("## Where each idea is")
IDEAS = re.findall(r"^\| ([^|*]+) \| `([^`|]+\.py)` \|", PAGE[_START : PAGE.index("\n## ", _START)], re.MULTILINE)


def plain(text: str) -> str:
    """Lower case, with one space where words are apart or joined by a hyphen or an underscore."""
    return re.sub(r"[-_\s]+", " ", text.lower())


@cache
def announced(file: Path) -> tuple[str, str]:
    """The name of a module with its docstring's first line, and the whole docstring."""
    docstring = ast.get_docstring(tree(file)) or ""
    return plain(f"{file.stem} {docstring.partition(chr(10))[0]}"), plain(docstring)


def rank(file: Path, idea: str) -> int:
    """0 where the name or first line of a module has the idea, 1 where its docstring has, else 2."""
    head, docstring = announced(file)
    return 0 if plain(idea) in head else 1 if plain(idea) in docstring else 2


def test_there_are_enough_ideas_each_once():
    names = [idea for idea, _ in IDEAS]
    assert len(names) == len(set(names)) >= 30


@pytest.mark.parametrize(("idea", "name"), IDEAS, ids=[idea for idea, _ in IDEAS])
def test_an_idea_is_found_in_its_file_first(idea, name):
    own = rank((REPOSITORY if name.startswith("studies/") else PACKAGE) / name, idea)
    assert own < 2, f"{name} does not say {idea!r} in its docstring"
    louder = [file for file in PACKAGE.rglob("*.py") if file.stem != "__init__" and rank(file, idea) < own]
    assert not louder, f"{idea!r} is announced more prominently by {louder}"


def test_every_file_and_folder_that_the_page_names_exists():
    named = set(re.findall(r"`((?:tests/)?[\w/]+(?:\.py|\.yaml|/))`", PAGE))
    roots = (REPOSITORY, PACKAGE, *PACKAGE.iterdir(), *PACKAGE.glob("*/*"), *(REPOSITORY / "studies").glob("**"))
    missing = [name for name in named if not any((root / name).exists() for root in roots)]
    assert not missing
