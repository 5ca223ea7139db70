"""The pages show what the code defines: exit codes, abort reasons, time-outs and what preflight requires."""

import re
from pathlib import Path

import pytest

from cfplan.errors import ExitCode
from cfplan.flight.pilot.abort_reasons import AbortReason
from cfplan.flight.pilot.vehicle_rules import PARAMETER_RULES
from docs.code_tables import LIMITS, MARKER, TABLES, TIME_OUTS, grid, rendered

pytestmark = pytest.mark.unit
REPOSITORY = Path(__file__).parents[1]
PAGES = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").rglob("*.md"))]


def page(name):
    """A page of docs/ as the site shows it."""
    return rendered((REPOSITORY / "docs" / name).read_text(encoding="utf-8"))


def test_each_table_is_on_a_page_and_each_marker_names_a_table():
    assert {name for file in PAGES for name in MARKER.findall(file.read_text(encoding="utf-8"))} == set(TABLES)


def test_a_marker_without_a_table_fails_the_build():
    with pytest.raises(KeyError, match="nothing"):
        rendered("<!-- render: nothing -->")


def test_a_cell_may_hold_a_bar():
    assert grid(["a"], [["x | y"]]).endswith("| x \\| y |")


def test_the_errors_page_has_every_exit_code_and_every_reason_with_its_cure():
    text = page("errors.md")
    for code in ExitCode:
        assert f"| {int(code)} | {code.meaning} |" in text
    for reason in AbortReason:
        assert reason.meaning in text
        assert reason.cure in text


def test_the_preflight_page_has_every_parameter():
    text = page("preflight.md")
    for rule in PARAMETER_RULES:
        assert f"| `{rule.name}` |" in text


def test_the_page_on_time_outs_has_the_times_that_are_in_force():
    text = page("what-breaks.md")
    assert f"| {LIMITS.pose.age_brake:g} s |" in text
    drawn = re.findall(r">([^<>]*)</text>", text)
    assert f"{LIMITS.pose.age_land:g}" in drawn
    assert "poses stop" in drawn


def test_each_key_of_a_time_out_is_one_of_safety_yaml_or_of_the_firmware():
    safety = (REPOSITORY / "safety.yaml").read_text(encoding="utf-8")
    for row in (row for rows in TIME_OUTS.values() for row in rows):
        key = row.key.partition(":")[0].rpartition(".")[2]
        assert not key or row.key.startswith("supervisor.") or re.search(rf"^ *{key}:", safety, re.MULTILINE), row.key
