"""Runs the command line as a shell would, but in this process."""

import json
import re
from dataclasses import dataclass
from pathlib import Path

import pytest

from cfplan.cli import run_command

REPOSITORY = Path(__file__).parents[2]


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    code: int
    out: str
    err: str

    @property
    def json(self):
        return json.loads(self.out)


@pytest.fixture
def cfplan(monkeypatch, capsys):
    """Call it with the command's words."""

    def run(*words: object) -> Ended:
        monkeypatch.setattr("sys.argv", ["cfplan", *map(str, words)])
        with pytest.raises(SystemExit) as ending:
            run_command()
        printed = capsys.readouterr()
        return Ended(int(ending.value.code or 0), printed.out, printed.err)

    return run


@pytest.fixture
def safety_file(tmp_path):
    """The project's safety.yaml, copied where a test may change it; call it with (pattern, replacement) pairs."""

    def write(*changes: tuple[str, str]) -> Path:
        text = (REPOSITORY / "safety.yaml").read_text()
        for pattern, replacement in changes:
            text, count = re.subn(pattern, replacement, text, count=1, flags=re.MULTILINE)
            assert count == 1, f"{pattern} is not in safety.yaml"
        file = tmp_path / "safety.yaml"
        file.write_text(text)
        return file

    return write


@pytest.fixture
def path_file(tmp_path):
    """Write a path file."""

    def write(text: str) -> Path:
        file = tmp_path / "path.yaml"
        file.write_text(text)
        return file

    return write


PATIENT_AND_QUICK = {
    "age_brake": 0.5, "age_land": 1.5, "lateness": 0.1,  # for a busy computer
    "take_off_speed": 0.5, "go_to_speed": 1.0, "land_speed": 0.5,  # to be done sooner
}  # fmt: skip


@pytest.fixture(scope="session")
def patient_safety_file(tmp_path_factory):
    """A safety.yaml for flights in real time on a computer that may be busy."""
    text = (REPOSITORY / "safety.yaml").read_text()
    for key, value in PATIENT_AND_QUICK.items():
        text, count = re.subn(rf"^( *{key}): \S+", rf"\1: {value}", text, flags=re.MULTILINE)
        assert count == 1, f"{key} is not in safety.yaml"
    file = tmp_path_factory.mktemp("patient") / "safety.yaml"
    file.write_text(text)
    return file
