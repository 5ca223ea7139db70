"""README and docs/ are true in what a machine can check: links lead somewhere, commands and their options exist."""

import re
import shlex
from pathlib import Path

import click
import pytest

from cfplan.cli import cfplan

REPOSITORY = Path(__file__).parent.parent
PAGES = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").rglob("*.md"))]
COMMANDS = sorted(
    {line for page in PAGES for line in re.findall(r"^ {4}(?:\$ )?(cfplan [^#\n]*)", page.read_text(), re.MULTILINE)}
    | {span for page in PAGES for span in re.findall(r"`(cfplan [^`\n]+)`", page.read_text())}
)


def anchor(heading: str) -> str:
    """Return the anchor that Markdown viewers give a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_links_lead_somewhere(page):
    for target, _, place in re.findall(r"\]\(([^)#\s]*)(#([^)]+))?\)", page.read_text()):
        if target.startswith("http"):
            continue
        linked = page.parent / target if target else page
        assert linked.exists(), target
        if place:
            headings = re.findall(r"^#+ (.*)$", linked.read_text(), re.MULTILINE)
            assert place in map(anchor, headings), f"{target}#{place}"


@pytest.mark.parametrize("line", COMMANDS)
def test_commands_and_their_options_exist(line):
    command: click.Command | None = cfplan
    words = shlex.split(line.replace("…", " ").rstrip("\\"))[1:]
    while isinstance(command, click.Group) and words and re.fullmatch(r"[a-z-]+", words[0]):
        name, words = words[0], words[1:]
        command = command.get_command(click.Context(command), name)
        assert command is not None, f"no command {name!r}"
    assert command is not None
    known = {option for parameter in command.params for option in parameter.opts} | {"--help", "--version"}
    assert {word for word in words if re.match(r"-{1,2}[a-z]", word)} <= known
