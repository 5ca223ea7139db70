"""What README and docs/ show of datasets, training, benchmarks and studies ends well, as it stands but for its size.

Appended options make it small (the last of an option counts), and of many paths the first is kept. That a command is
taken as it stands holds tests/cli/test_commands_of_the_pages.py.
"""

import re
import shlex
import shutil
import subprocess
import sys
from glob import glob
from pathlib import Path

import pages
import pytest
from pages import MEASURED

REPOSITORY = Path(__file__).parents[2]
QUICK = "--quick"
SMALL = {  # of a command, by its beginning: what is appended
    "bench": "--paths 1",
    "robustness": "--draws 2",
    "dataset make datasets/paper": "--count 4 --workers 1",
    "dataset make": "--count 120 --workers 1",
    "dataset info": "",
    "train": "--epochs 1 --hidden 4 --layers 1 --batch 8",
    "study ablation": "--rows 100 --epochs 1 --paths 1",
    "study architectures": QUICK,
    "study baselines": QUICK,
    "study docs": "",
    "study dry-runs": "",
    "study exports": "",
    "study faults": "--only radio",
    "study feasibility": "--paths 4",
    "study flights": "--repeats 1",
    "study giving-way": "--random 1",
    "study hard-paths": "--paths 6",
    "study hardware": QUICK,
    "study horizon": "--paths 1 --waypoints 5",
    "study identification": "--vehicles 1",
    "study inputs": QUICK,
    "study latency": "--requests 2 --seconds 3",
    "study lateness": "--seconds 2",
    "study learned": "--paths 1",
    "study link-loss": "",
    "study long": "--paths 1 --length 20",
    "study paper": QUICK,
    "study physics": "",
    "study proposals": "--paths 1",
    "study random-faults": "--flights 2 --random-paths 0",
    "study robustness": QUICK,
    "study scaling": "--repeats 1",
    "study steering": "--flights 1 --requests 5 --seconds 10",
    "study simulators": QUICK,
    "study stops": "",
    "study unseen-limits": "--paths 1",
    "study yaw-consistency": "--pairs 1",
}
DATASET = "cfplan dataset make datasets/any --count 50000 --seed 1 --workers 2"  # which others read

pytestmark = [pytest.mark.slow, pytest.mark.integration, pytest.mark.timeout(900)]


def small(line: str) -> list[str]:
    """Return the words of a command, made small."""
    beginning = next(key for key in SMALL if line.removeprefix("cfplan ").startswith(key))
    asked = re.sub(r" --add \S+", "", line)  # results of other seeds, which only their owner has
    words = [word for part in shlex.split(asked)[1:] for word in sorted(glob(part)) or [part]]
    paths = [word for word in words if word.startswith("flights/")]
    left_out = paths[1:] if len(paths) > 2 else []  # one path and the next, of identification, are both needed
    return [word for word in words if word not in left_out] + SMALL[beginning].split()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A copy of what the repository brings."""
    folder = tmp_path_factory.mktemp("shown")
    brought = subprocess.run(["git", "ls-files"], cwd=REPOSITORY, capture_output=True, text=True, check=True).stdout
    for name in brought.splitlines():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(REPOSITORY / name, folder / name)
    return folder


def run(folder: Path, words: list[str]) -> str:
    """Run it as another process, as studies set the threads of theirs; return what it printed."""
    done = subprocess.run(
        [sys.executable, "-m", "cfplan", *words], cwd=folder, capture_output=True, text=True,
        stdin=subprocess.DEVNULL, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.parametrize("line", pages.lines_for(MEASURED))
def test_what_takes_long_ends_well_in_small(folder, monkeypatch, line):
    monkeypatch.chdir(folder)
    if "datasets/any" in line and line != DATASET and not Path("datasets/any").exists():
        run(folder, small(DATASET))
    words = small(line)
    if "dataset make" in line:  # two commands make one folder, from other planners
        shutil.rmtree(words[2], ignore_errors=True)
    output = folder / words[words.index("-o") + 1] if "-o" in words else folder
    kept = output.read_bytes() if output.is_file() else None
    if kept is not None:
        output.unlink()
    before = [page.read_text() for page in sorted(folder.rglob("*.md"))]
    run(folder, words)
    assert output.exists()
    assert line != "cfplan study docs" or [page.read_text() for page in sorted(folder.rglob("*.md"))] == before
    if kept is not None:
        output.write_bytes(kept)  # as `study docs` reads it


def test_every_size_is_of_a_command_that_is_shown():
    lines = [line.removeprefix("cfplan ") for line in pages.lines_for(MEASURED)]
    assert all(any(line.startswith(key) for line in lines) for key in SMALL)
