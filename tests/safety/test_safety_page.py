"""docs/safety.md has every key of safety.yaml, with the default, the range and the unit that the reader has."""

import re
from pathlib import Path

import pytest
import yaml

from cfplan.safety.limits_file import DEFAULTS, Key, all_keys

PAGE = (Path(__file__).parents[2] / "docs" / "safety.md").read_text()
COLUMNS = ["key", "unit", "default", "allowed", "meaning and reason", "effect"]
ROWS = {
    cells[0].strip("`"): dict(zip(COLUMNS, cells, strict=True))
    for line in PAGE.splitlines()
    if len(cells := [cell.strip() for cell in line.strip("|").split("|")]) == len(COLUMNS) and cells[0].startswith("`")
}
KEYS = {key.name: key for key in all_keys()}
NEEDED = {"vehicle", "space.low", "space.high"}


def leaves(content, above=""):
    """Every key of a file with its section; a ladder is one."""
    for key, value in content.items():
        if isinstance(value, dict) and "brake" not in value:
            yield from leaves(value, f"{above}{key}.")
        else:
            yield f"{above}{key}"


def commented(text):
    """Every key of a file with the comment on its line."""
    section = ""
    for line in text.splitlines():
        if found := re.match(r"(?P<indent> *)(?P<key>\w+):.*?(?:#\s*(?P<comment>.*))?$", line):
            section = section if found["indent"] else found["key"]
            yield f"{section}.{found['key']}" if found["indent"] else section, found["comment"]


COMMENTS = dict(commented(DEFAULTS.read_text()))


def test_the_reader_names_every_key_of_a_whole_file():
    assert list(KEYS) == list(leaves(yaml.safe_load(DEFAULTS.read_text())))


def test_the_page_has_every_key_in_the_order_of_the_file():
    assert list(ROWS) == list(KEYS)


@pytest.mark.parametrize("key", KEYS.values(), ids=lambda key: key.name)
def test_a_row_says_what_the_reader_knows(key: Key):
    row = ROWS[key.name]
    assert row["allowed"] == key.range
    if key.name in NEEDED:
        assert key.default is None
        assert row["default"] == "needed"
    else:
        assert yaml.safe_load(row["default"]) == key.default
    assert row["meaning and reason"].endswith(".")
    assert row["effect"].endswith(".")


@pytest.mark.parametrize("name", [name for name in KEYS if name not in ("vehicle", "space.high")])
def test_the_unit_is_that_of_the_files_comment(name):
    unit = ROWS[name]["unit"]
    if name.endswith("_deg"):
        assert unit == "°"
    elif unit:
        assert re.match(rf"{re.escape(unit)}(?![\w/])", COMMENTS[name])


@pytest.mark.parametrize("section", dict.fromkeys(name.split(".")[0] for name in KEYS))
def test_each_section_has_a_heading(section):
    assert f"\n## {section}\n" in PAGE
