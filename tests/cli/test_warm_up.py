"""What is compiled ahead is all that plans and flights need, and nothing that numba is slow at."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cfplan.cli.output import Steps
from cfplan.cli.warm_up import warm_up
from cfplan.errors import InputError
from cfplan.machine_code import code_folder

ROOT = Path(__file__).parent.parent.parent
LISTENING = """
import sys
from cfplan import machine_code
from numba.core import event

class Names(event.Listener):
    def on_start(self, event):
        print("compiles", event.data["dispatcher"].py_func.__qualname__, file=sys.stderr, flush=True)
    def on_end(self, event): ...

event.register("numba:compile", Names())
"""
COMMAND = "from cfplan.cli import main; sys.argv[0] = 'cfplan'; main()"


def run(code, cache, *arguments):
    """Return the names of what was compiled, and the process."""
    done = subprocess.run(
        [sys.executable, "-c", LISTENING + code, *arguments],
        cwd=ROOT, env=os.environ | {"CFPLAN_CACHE": str(cache)}, capture_output=True, text=True, timeout=900,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return [line.split()[1] for line in done.stderr.splitlines() if line.startswith("compiles ")], done


@pytest.mark.slow  # it compiles all that a flight needs, for a minute or two
@pytest.mark.timeout(1200)
def test_after_compiling_ahead_nothing_is_compiled(tmp_path):
    _, done = run(COMMAND, tmp_path, "doctor", "--warm-up", "--json")
    assert "functions so far" not in done.stdout  # JSON alone is printed
    code = list(tmp_path.rglob("*.nbc"))
    assert len(code) > 100
    # An array assigned to a slice makes numba compile this, for seconds: write a loop.
    assert not [file for file in code if b"raise_with_shape_context" in file.read_bytes()]
    for arguments in (
        ("plan", "flights/circle.yaml"), ("plan", "flights/loop3d.yaml", "--planner", "expert"),
        ("sim", "flights/line.yaml"), ("doctor", "--warm-up"),
    ):  # fmt: skip
        compiled, done = run(COMMAND, tmp_path, *arguments)
        assert compiled == []
        assert "functions so far" not in done.stdout
    records = str(tmp_path / "records")
    for arguments in (("line.yaml",), ("circle.yaml", "--on-board")):
        assert run(COMMAND, tmp_path, "fly", f"flights/{arguments[0]}", *arguments[1:], "--records", records)
    missing = [file.name for file in tmp_path.rglob("*.nbc") if file not in code]
    assert all(name.startswith("path_distance.") for name in missing), missing  # for the summary, after the landing


@pytest.mark.integration
def test_a_part_that_fails_to_compile_is_reported(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("CFPLAN_CACHE", str(tmp_path))
    with pytest.raises(InputError, match=r"compiling failed.*no-such-file"):
        warm_up(tmp_path / "no-such-file.yaml", Steps(as_json=False))
    assert "machine code" in capsys.readouterr().out
    assert not (code_folder() / "ready").exists()


def test_what_is_compiled_already_is_left_alone(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("CFPLAN_CACHE", str(tmp_path))
    code_folder().mkdir(parents=True)
    (code_folder() / "ready").touch()
    warm_up(tmp_path / "no-such-file.yaml", Steps(as_json=False))
    assert capsys.readouterr().out == ""


def test_where_nothing_can_be_kept_nothing_is_compiled_ahead(tmp_path, monkeypatch, capsys):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("CFPLAN_CACHE", str(tmp_path / "file" / "below"))
    warm_up(tmp_path / "no-such-file.yaml", Steps(as_json=False))
    assert capsys.readouterr().out == ""
