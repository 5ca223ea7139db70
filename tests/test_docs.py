"""README and docs/ are true in what a machine can check: commands and their options exist, README's links lead on."""

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


def test_links_of_the_readme_lead_somewhere():
    """Those of docs/ are checked as the site is built: `mkdocs build --strict`."""
    for target, _, place in re.findall(r"\]\(([^)#\s]*)(#([^)]+))?\)", (REPOSITORY / "README.md").read_text()):
        assert target.startswith("http") or (REPOSITORY / target).exists(), target
        if place and not target.startswith("http"):
            headings = re.findall(r"^#+ (.*)$", (REPOSITORY / (target or "README.md")).read_text(), re.MULTILINE)
            assert place in {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}, place


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


@pytest.mark.parametrize("name", ["architecture", "contributing"])
def test_every_file_and_folder_that_a_page_about_the_code_names_exists(name):
    page, package = (REPOSITORY / "docs" / f"{name}.md").read_text(), REPOSITORY / "cfplan"
    named = set(re.findall(r"`((?:tests/)?[\w/]+(?:\.py|\.yaml|/))`", page))
    roots = (REPOSITORY, package, *package.iterdir(), *package.glob("*/*"))
    assert not [file for file in named if not any((root / file).exists() for root in roots)]
