"""docs/errors.md has every error that the sources can raise, each with its cure, and none that they cannot."""

import ast
import re
from collections import Counter
from functools import cache
from pathlib import Path

import pytest
from sources import FILES, PACKAGE, nodes

from cfplan.errors import ExitCode
from cfplan.studies.error_tables import ErrorRow, error_table, read_meanings, rows_of
from cfplan.studies.error_texts import GAP, all_errors, modules_with_errors

pytestmark = pytest.mark.unit
REPOSITORY = Path(__file__).parents[2]
PAGE = (REPOSITORY / "docs" / "errors.md").read_text(encoding="utf-8")
PLACED = [module for named in re.findall(r"<!-- errors: ([^>]+) -->", PAGE) for module in named.split()]
MEANINGS = read_meanings(REPOSITORY)


@cache
def rows() -> list[ErrorRow]:
    return [row for module in modules_with_errors() for row in rows_of(module, MEANINGS)]


def pattern(message: str) -> str:
    """A message with gaps as a regular expression."""
    return "".join(".*" if part == GAP else re.escape(part) for part in re.split(f"({GAP})", message))


def test_each_module_that_can_raise_an_error_is_at_one_place_of_the_page():
    assert Counter(PLACED) == Counter(modules_with_errors())


@pytest.mark.parametrize("kind", ["InputError", "InfeasibleError", "NotCertifiedError", "PreflightError", "LinkError"])
def test_each_place_in_the_sources_that_makes_an_error_is_read(kind):
    read = {(text.module, text.line) for text in all_errors()}
    for file in FILES:
        for node in nodes(file):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == kind:
                assert (str(file.relative_to(PACKAGE)), node.lineno) in read


def test_each_error_has_a_cure_and_a_message():
    for row in rows():
        assert row.cures, f"{row.module}: {row.messages}: say the cure in docs/error-meanings.yaml"
        assert all(re.search(r"\w{2}", message) for message in row.messages), row


def test_where_an_error_comes_from_elsewhere_the_page_says_what_it_may_be():
    for text in all_errors():
        if text.says_nothing:
            assert text.module in MEANINGS, f"{text.module}:{text.line}: name what it passes on"


def test_no_meaning_is_of_a_message_that_is_gone():
    for module, told in MEANINGS.items():
        texts = [text for text in all_errors() if text.module == module]
        assert texts, module
        said = {message for text in texts for message in text.messages}
        if not any(text.says_nothing for text in texts):
            assert {meaning.says for meaning in told} <= said, module


def test_what_ends_a_flight_is_explained():
    """A message in the air has no hint beside it, so the page must say what it means, and what to do."""
    for row in rows():
        if row.code in (ExitCode.ENDED_BY_SAFETY, ExitCode.ENDED_BY_OPERATOR, ExitCode.PREFLIGHT):
            assert row.means, row.messages


@pytest.mark.parametrize("line", re.findall(r"^    error: (.*)$", (REPOSITORY / "docs/mistakes.md").read_text(), re.M))
def test_what_is_printed_is_found_on_the_page(line):
    """Messages as commands print them, which another test compares, have their row."""
    said = re.sub(r" \(hint: .*\)$", "", line)
    known = [message for row in rows() for message in row.messages if len(re.findall(r"[^\W\d_]", message)) > 3]
    assert any(re.fullmatch(f"(?:.*: )?{pattern(message)}", said) for message in known)


def test_a_row_is_what_the_source_says():
    titles, cells = error_table(["geometry/min_snap.py"], {})
    assert len(titles) == 3
    row = next(row for row in cells if "m apart, less than" in row[0])
    assert row == ["`waypoints … and … are … m apart, less than … m`", "**Cure:** remove one of them", "2"]


def test_constants_of_other_modules_stand_as_they_are_printed():
    messages = [message for text in all_errors() for message in text.messages]
    assert "'…' is not a channel: 0 to 125" in messages
    assert "coordinates must be numbers within 100000 m of the origin, not …" in messages


def test_no_meaning_is_said_twice():
    for line in PAGE.splitlines():
        sentences = [sentence for sentence in line.split(". ") if len(sentence) > 40]
        assert len(sentences) == len(set(sentences)), line[:100]
