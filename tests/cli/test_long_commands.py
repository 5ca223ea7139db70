"""What README and docs/ show of datasets, training and studies ends well, as it stands but for its size.

Appended options make it small (the last of an option counts). That a command is taken as it stands holds
tests/cli/test_commands_of_the_pages.py.
"""

import shlex
import shutil
import subprocess
import sys
from glob import glob
from pathlib import Path

import pages
import pytest
from pages import MEASURED

from cfplan.version import REPOSITORY
from studies import STUDIES
from studies.runner.result import read_result

SMALL = {  # of a command, by its beginning: what is appended
    "cfplan bench": "--planner expert",
    "cfplan robustness": "--draws 2",
    "cfplan dataset make": "--count 120 --workers 1",
    "cfplan dataset info": "",
    "cfplan train": "--epochs 1 --hidden 4 --layers 1 --batch 8",
    "python -m studies paper": "--quick",
    "python -m studies": "",
}
DATASET = "cfplan dataset make datasets/any --count 50000 --seed 1 --workers 2"  # which others read
LINE, QUICK = "flights/line.yaml", "--quick"
SMALL_STUDIES = {
    "architectures": QUICK,
    "baselines": QUICK,
    "blind-link-loss": f"{LINE} --moments 2 --draws 2",
    "dry-runs": LINE,
    "exports": LINE,
    "faults": f"{LINE} --only radio",
    "fleet-faults": "flights/fleets/two.yaml --flights 2",
    "fleet-flights": "flights/fleets/two.yaml --flights 2",
    "fleets": "--fleets 1 --size 2 --moments 2",
    "flights": f"{LINE} --repeats 1",
    "giving-way": f"{LINE} --random 1",
    "hardware": QUICK,
    "horizon": "--paths 1 --waypoints 5",
    "identification": "flights/identify.yaml flights/figure8.yaml --vehicles 1",
    "inputs": QUICK,
    "labels": QUICK,
    "latency": "--requests 2 --seconds 3",
    "lateness": f"{LINE} --seconds 2",
    "link-loss": LINE,
    "physics": LINE,
    "planners": "--paths 1",
    "random-faults": f"{LINE} --flights 2",
    "robustness": QUICK,
    "search": QUICK,
    "simulators": QUICK,
    "steering": "--flights 1 --requests 5 --seconds 10",
    "stops": "",
    "waypoints": "--sets 1 --rooms 1",
    "yaw-consistency": "--pairs 1",
}
OF_PUBLIC_FLIGHTS = {"real-flights", "second-flights"}  # their own tests run these, where the flights are
OF_TROUBLE = {"bad", "left-out", "not-landed", "refused"}  # tables that are made only where something went wrong

pytestmark = [pytest.mark.slow, pytest.mark.integration, pytest.mark.timeout(900)]


def small(line: str) -> list[str]:
    """Return the words of a command, made small."""
    beginning = next(key for key in SMALL if line.startswith(key))
    words = [word for part in shlex.split(line) for word in sorted(glob(part)) or [part]]
    return words + SMALL[beginning].split()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A copy of what the repository brings."""
    folder = tmp_path_factory.mktemp("shown")
    brought = subprocess.run(["git", "ls-files"], cwd=REPOSITORY, capture_output=True, text=True, check=True).stdout
    for name in brought.splitlines():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(REPOSITORY / name, folder / name)
    return folder


def run(folder: Path, words: list[str]) -> None:
    """Run it as another process, as studies set the threads of theirs."""
    command = [sys.executable, *({"cfplan": ["-m", "cfplan"], "python": []}[words[0]]), *words[1:]]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, stdin=subprocess.DEVNULL, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("line", [line for line in pages.lines_for(MEASURED) if not line.endswith(".json")])
def test_what_takes_long_ends_well_in_small(folder, monkeypatch, line):
    monkeypatch.chdir(folder)
    if "datasets/any" in line and line != DATASET and not Path("datasets/any").exists():
        run(folder, small(DATASET))
    run(folder, small(line))


@pytest.mark.parametrize("name", sorted({*STUDIES} - OF_PUBLIC_FLIGHTS))
def test_a_small_study_makes_the_tables_that_the_pages_show(folder, tmp_path, name):
    run(folder, ["python", "-m", "studies", name, *SMALL_STUDIES[name].split(), "-o", str(tmp_path / "r.json")])
    made = {table.name for table in read_result(tmp_path / "r.json").tables}
    for file in (REPOSITORY / "results").glob("*.json"):
        shown = read_result(file)
        if shown.study == name and (name != "planners" or file.stem == "planners-random"):
            assert {table.name for table in shown.tables} - OF_TROUBLE <= made, file.name


def test_a_study_that_a_page_shows_is_one():
    lines = [line for line in pages.lines_for(MEASURED) if line.startswith("python -m studies ")]
    assert {line.split()[3] for line in lines} <= {*STUDIES, "pages", "paper", "figures"}
