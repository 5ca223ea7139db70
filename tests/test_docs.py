"""README and docs/ are true in what a machine can check: commands with their options, files, numbers of the code."""

import re
import shlex
import tomllib
from pathlib import Path

import click
import pytest

import cfplan as top_level
from cfplan.cli import cfplan
from cfplan.flight.telemetry import Phase
from cfplan.learning import features
from cfplan.planning import plan_file
from cfplan.recording import topics
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.airframes import AIRFRAMES
from cfplan.version import __version__

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


def test_the_page_of_airframes_has_their_numbers():
    page = (REPOSITORY / "docs" / "airframes.md").read_text()
    rows = dict(re.findall(r"^\| `([\w.+-]+)` \| (\d.*) \|", page, re.MULTILINE))
    assert rows.keys() == AIRFRAMES.keys()
    for name, airframe in AIRFRAMES.items():
        mass, ratio, lag = re.findall(r"[\d.]+", " ".join(rows[name].split(" | ")[:3]))
        assert float(mass) == pytest.approx(1e3 * airframe.mass, abs=0.05)
        assert float(ratio) == pytest.approx(4 * airframe.motor_thrust_max / (airframe.mass * GRAVITY), abs=0.005)
        assert float(lag) == airframe.motor_time_constant


def test_the_page_of_records_has_the_versions_and_topics_of_the_code():
    page = (REPOSITORY / "docs" / "records.md").read_text()
    versions = re.findall(r"^\| [^|]*`(?:format|features)`[^|]*\| (\d+) \|", page, re.MULTILINE)
    assert versions == [topics.FORMAT, str(plan_file.FORMAT), str(features.VERSION)]
    assert set(re.findall(r"`(/\w+)`", page)) - {"/public"} == {topic.name for topic in topics.TOPICS}


def test_every_phase_of_the_pilot_is_in_its_diagram():
    page = (REPOSITORY / "docs" / "architecture.md").read_text()
    diagram = page[page.index("## The pilot") :].split("```")[1]
    assert all(re.search(rf"\b{phase}\b", diagram) for phase in Phase)


def test_the_version_is_the_same_wherever_it_is_written():
    assert tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]["version"] == __version__
    assert f"\nversion: {__version__}\n" in (REPOSITORY / "CITATION.cff").read_text()
    assert f"\n## {__version__}" in (REPOSITORY / "CHANGELOG.md").read_text()


def test_the_page_of_the_programming_interface_has_every_name_of_cfplan():
    page = (REPOSITORY / "docs" / "api.md").read_text()
    for name in set(top_level.__all__) - {"__version__"}:
        value = getattr(top_level, name)
        assert value.__module__ == "cfplan.errors" or f"::: {value.__module__}.{value.__name__}\n" in page
    assert "::: cfplan.errors\n" in page


@pytest.mark.parametrize("name", ["architecture", "contributing"])
def test_every_file_and_folder_that_a_page_about_the_code_names_exists(name):
    page, package = (REPOSITORY / "docs" / f"{name}.md").read_text(), REPOSITORY / "cfplan"
    named = set(re.findall(r"`((?:tests/)?[\w/]+(?:\.py|\.yaml|/))`", page))
    roots = (REPOSITORY, package, *package.iterdir(), *package.glob("*/*"))
    assert not [file for file in named if not any((root / file).exists() for root in roots)]
