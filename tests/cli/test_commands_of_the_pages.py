"""Commands that README and docs/ show end well as they stand there, in a new folder, with records where they are shown.

Those that fly in real time, train, measure for long, or need a window, a lab or a dataset have tests of their own; that
every option exists holds tests/test_docs.py.
"""

import re
import shlex
import shutil
from pathlib import Path

import pytest
from stepped_flight import fly_stepped

from cfplan.cli import cfplan as command_line
from cfplan.cli.study import study
from cfplan.planning.plan_file import save_plan
from cfplan.preparation.prepare_flight import prepare_flight
from cfplan.recording.header import header_of_plan
from cfplan.recording.reader import read_record
from cfplan.recording.summary import summarise
from cfplan.recording.writer import RecordWriter, write_summary
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.lab.stepped_lab import SteppedLab

REPOSITORY = Path(__file__).parents[2]
PAGES = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").glob("*.md"))]
SHOWN = re.compile(r"(?:^ {4}(?:\$ )?|`)(cfplan [^`#\n]*)", re.MULTILINE)
LINES = sorted({" ".join(line.split()) for page in PAGES for line in SHOWN.findall(page.read_text(encoding="utf-8"))})
PLANNING = ("init", "plan", "check", "sim", "export")
OF_RECORDS = ("replay", "report", "identify")
RECORD = re.compile(r"records/[\w-]+")
ELSEWHERE = ("…", "<", "models/mine", "PATH", "vicon.csv", "--png")  # not files; a log; a driver for graphics
SLOW = ("/scan.yaml", "/circle.yaml --to", "--gif", "replay records/20261122-212927-figure-eight --figure")


def runs(line: str) -> bool:
    """Return whether a line is a whole command that needs no hardware, window, dataset or time."""
    words = line.split()
    if any(part in line for part in ELSEWHERE) or len(words) < 3:
        return False
    if "--help" in words:
        return True
    if words[1] in PLANNING:
        return len(words) > 3 or "/" in line
    if words[1] == "replay":  # alone it opens a window
        return words[2] == "records" or ("records/" in line and len(words) > 3)
    return words[1] in OF_RECORDS and "records/" in line


RUN = [line for line in LINES if runs(line)]


@pytest.fixture(scope="module")
def record(tmp_path_factory):
    """The record of a flight in the stepped lab, with its plan and summary as `cfplan fly` leaves them."""
    folder = tmp_path_factory.mktemp("flown") / "record"
    source = REPOSITORY / "flights" / "figure8.yaml"
    prepared = prepare_flight(source, load_limits(REPOSITORY / "safety.yaml"))
    lab = SteppedLab(prepared.mission.limits.airframe)
    header = header_of_plan(prepared.plan, name="figure8", uri="stepped://0", source=source, wall_time_at_zero=1.7e9)
    with RecordWriter(folder, header, clock=lab.clock) as writer:
        outcome = fly_stepped(prepared.mission, writer.write, lab=lab).outcome
    assert outcome.reason == "landed"
    save_plan(prepared.plan, folder / "plan.parquet", {"name": "figure8", "path file": str(source)})
    write_summary(folder, {"outcome": outcome.to_dict(), **summarise(read_record(folder)).to_json()})
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A new folder with what the repository brings."""
    folder = tmp_path_factory.mktemp("shown")
    shutil.copytree(REPOSITORY / "flights", folder / "flights")
    shutil.copy(REPOSITORY / "safety.yaml", folder)
    return folder


@pytest.mark.parametrize(
    "line", [pytest.param(line, marks=[pytest.mark.slow] * any(part in line for part in SLOW)) for line in RUN]
)
def test_a_command_ends_well_as_it_is_shown(cfplan, folder, tmp_path, monkeypatch, request, line):
    words = shlex.split(line)[1:]
    monkeypatch.chdir(tmp_path if words[0] == "init" else folder)
    if "mylab/first.yaml" in words and not (folder / "mylab").is_dir():
        assert cfplan("init", "mylab", "--room", "4x6x2.5").code == 0
    for name in RECORD.findall(line) or ["records/20261122-094221-figure8"] * ("records" in words):
        if not (folder / name).is_dir():
            shutil.copytree(request.getfixturevalue("record"), folder / name)
    if {"-o", "--figure", "--gif", "--save"} & set(words):
        words.append("--force")
    ended = cfplan(*words)
    assert ended.code == 0, ended.err


def test_the_commands_of_the_first_hour_and_after_a_flight_are_among_them():
    assert {*PLANNING, *OF_RECORDS} <= {line.split()[1] for line in RUN}
    assert len(RUN) > 20


@pytest.mark.parametrize(
    "words", [[name] for name in sorted(command_line.commands)] + [["study", name] for name in sorted(study.commands)]
)
def test_every_command_and_study_explains_itself(cfplan, words):
    ended = cfplan(*words, "--help")
    assert ended.code == 0
    assert ended.out.startswith(f"Usage: cfplan {' '.join(words)} ")


def test_a_computer_is_examined_as_json(cfplan, monkeypatch):
    monkeypatch.chdir(REPOSITORY)
    ended = cfplan("doctor", "--json")
    assert ended.json, ended.err
