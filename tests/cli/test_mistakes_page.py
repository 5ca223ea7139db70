"""docs/mistakes.md has the message of cfplan for every mistake; computed numbers may round differently."""

import re
from pathlib import Path

import pytest

from tests.cli.test_bad_input import BAD_PATHS, BAD_SAFETY, LINE
from tests.texts import same_text

PAGE = (Path(__file__).parents[2] / "docs" / "mistakes.md").read_text()
COMMANDS = {
    "a path file that is not there": ("plan", "no.yaml"),
    "a mistyped command": ("fyl", "path.yaml"),
    "a mistyped option": ("plan", "path.yaml", "--sped", "0.5"),
    "a mistyped planner": ("plan", "path.yaml", "--planner", "exprt"),
    "no path at all": ("plan",),
    "an example that is not there": ("plan", "--example", "figure9"),
    "hardware without motion capture": ("fly", "path.yaml", "--uri", "radio://0/80/2M/E7E7E7E7E7"),
    "an address of no kind": ("fly", "path.yaml", "--uri", "tcp://somewhere"),
    "another body than the virtual one": ("fly", "path.yaml", "--mocap", "vicon://lab/cf2"),
    "a plan that is no Parquet file": ("plan", "path.yaml", "-o", "line.csv"),
    "a folder that is no record": ("replay", "."),
    "a picture that is no PNG": ("replay", ".", "--png", "flight.jpg"),
    "a folder of records, to be checked": ("check", "."),
    "speed in m/s on the command line": ("plan", "path.yaml", "--speed", "2"),
}


def said(ended) -> str:
    """Return the last line of what was printed as an error."""
    return re.sub(r"\S*/(?=(?:path|safety)\.yaml)", "", ended.err.splitlines()[-1])


def assert_on_page(mistake: str, ended) -> None:
    assert ended.code in (2, 3)
    on_page = re.search(rf"^\| {re.escape(mistake)} \| (?:`` (.*) ``|`(.*)`) \|$", PAGE, re.MULTILINE)
    assert on_page, f"the page does not have {mistake!r}"
    assert same_text(said(ended), on_page[1] or on_page[2]), said(ended)


@pytest.fixture
def folder(path_file, safety_file, tmp_path, monkeypatch):
    """A folder with a path and limits, to work in."""
    path_file(LINE)
    safety_file()
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("mistake", BAD_PATHS)
def test_a_mistake_in_a_path_file(cfplan, folder, path_file, mistake):
    path_file(BAD_PATHS[mistake][0])
    assert_on_page(mistake, cfplan("check", "path.yaml"))


@pytest.mark.parametrize("mistake", BAD_SAFETY)
def test_a_mistake_in_safety_yaml(cfplan, folder, safety_file, mistake):
    safety_file(BAD_SAFETY[mistake][:2])
    assert_on_page(f"{mistake}, in safety.yaml", cfplan("check", "path.yaml"))


@pytest.mark.parametrize("mistake", COMMANDS)
def test_a_mistake_on_the_command_line(cfplan, folder, mistake):
    assert_on_page(mistake, cfplan(*COMMANDS[mistake]))
