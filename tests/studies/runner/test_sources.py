"""The digest of a study's sources: it changes with imported code, not with comments and docstrings."""

import subprocess
import sys
from pathlib import Path

import pytest

from cfplan.version import REPOSITORY
from studies.runner.provenance import Provenance, provenance
from studies.runner.sources import sources_digest


def digest_of_copy(folder: Path) -> str:
    program = "from studies.runner.sources import sources_digest; print(sources_digest('studies.dry_runs'))"
    done = subprocess.run([sys.executable, "-c", program], cwd=folder, capture_output=True, text=True, check=True,
                          env={"PYTHONPATH": str(folder)})  # fmt: skip
    return done.stdout.strip()


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    """Return a copy of all sources, which tests change."""
    folder = tmp_path_factory.mktemp("sources")
    names = subprocess.run(["git", "ls-files", "cfplan", "studies", "models", "safety.yaml"], cwd=REPOSITORY,
                           capture_output=True, text=True, check=True).stdout.split()  # fmt: skip
    for name in names:
        if (REPOSITORY / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes((REPOSITORY / name).read_bytes())
    return folder


@pytest.fixture(scope="module")
def unchanged(copy):
    return digest_of_copy(copy)


@pytest.mark.parametrize(
    ("file", "old", "new", "changes"),
    [
        ("cfplan/simulation/dry_run.py", "", "\n_UNUSED = 1\n", True),  # imported by the study
        ("cfplan/vehicle/flatness.py", "", "\n_UNUSED = 1\n", True),  # imported by what the study imports
        ("cfplan/simulation/dry_run.py", "", "\n# a word\n", False),
        pytest.param("safety.yaml", "", "\n# a word\n", True, marks=pytest.mark.slow),
        pytest.param("studies/dry_runs.py", '"""Fly', '"""Do fly', False, marks=pytest.mark.slow),
        # It lists what programs may ask for.
        pytest.param("cfplan/__init__.py", "", "\n_UNUSED = 1\n", False, marks=pytest.mark.slow),
        pytest.param(
            "cfplan/preparation/plan_flight.py",
            "if TYPE_CHECKING:\n",
            "if TYPE_CHECKING:\n    import cfplan.cli\n",
            False,
            marks=pytest.mark.slow,
        ),
        ("studies/steering.py", "", "\n_UNUSED = 1\n", False),  # another study
    ],
)
def test_the_digest_changes_with_the_code_that_a_study_imports_alone(copy, unchanged, file, old, new, changes):
    text = (copy / file).read_text()
    (copy / file).write_text(text.replace(old, new, 1) if old else text + new)
    try:
        assert (digest_of_copy(copy) != unchanged) == changes
    finally:
        (copy / file).write_text(text)


def test_a_provenance_is_fresh_as_long_as_its_sources_are_the_present_ones():
    made = provenance("studies.dry_runs")
    assert made.fresh
    assert made.sources == sources_digest("studies.dry_runs")
    assert not Provenance(made.command, made.date, made.commit, made.modified, made.machine).fresh
