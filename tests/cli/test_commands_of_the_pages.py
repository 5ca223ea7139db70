"""Commands that README and docs/ show end well as they stand there, in a new folder.

Those that fly, measure or need a record, a lab or a dataset have tests of their own; that every option exists holds
tests/test_docs.py.
"""

import re
import shlex
import shutil
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
PAGES = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").glob("*.md"))]
SHOWN = re.compile(r"(?:^ {4}(?:\$ )?|`)(cfplan (?:init|plan|check|sim|export) [^`#\n]*)", re.MULTILINE)
ELSEWHERE = ("…", "records/", "models/mine", "PATH", "/scan.yaml", "/circle.yaml --to")  # named by a word, or slow
LINES = sorted({" ".join(line.split()) for page in PAGES for line in SHOWN.findall(page.read_text(encoding="utf-8"))})
RUN = [line for line in LINES if len(line.split()) > 3 or "/" in line]
RUN = [line for line in RUN if not any(part in line for part in ELSEWHERE)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A new folder with what the repository brings."""
    folder = tmp_path_factory.mktemp("shown")
    shutil.copytree(REPOSITORY / "flights", folder / "flights")
    shutil.copy(REPOSITORY / "safety.yaml", folder)
    return folder


@pytest.mark.parametrize("line", RUN)
def test_a_command_ends_well_as_it_is_shown(cfplan, folder, tmp_path, monkeypatch, line):
    words = shlex.split(line)[1:]
    monkeypatch.chdir(tmp_path if words[0] == "init" else folder)
    if "mylab/first.yaml" in words and not (folder / "mylab").is_dir():
        assert cfplan("init", "mylab", "--room", "4x6x2.5").code == 0
    if "-o" in words or "--figure" in words:
        words.append("--force")
    ended = cfplan(*words)
    assert ended.code == 0, ended.err


def test_the_commands_of_the_first_hour_are_among_them():
    assert {line.split()[1] for line in RUN} == {"init", "plan", "check", "sim", "export"}
    assert len(RUN) > 8
