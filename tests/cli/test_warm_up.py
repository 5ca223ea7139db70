"""What is compiled ahead is all that a plan needs, and nothing that numba is slow at."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from waiting import until

from cfplan.cli import warm_up
from cfplan.preparation.compiled_calls import Stage

ROOT = Path(__file__).parent.parent.parent
LISTENING = """
import sys
from cfplan import machine_code
from numba.core import event

class Names(event.Listener):
    def on_start(self, event):
        print("compiles", event.data["dispatcher"].__qualname__ if hasattr(event.data["dispatcher"], "__qualname__")
              else event.data["dispatcher"].py_func.__qualname__, file=sys.stderr, flush=True)
    def on_end(self, event): ...

event.register("numba:compile", Names())
"""


def run(code, cache, *arguments):
    """Return the exit status, and the names of what was compiled."""
    done = subprocess.run(
        [sys.executable, "-c", LISTENING + code, *arguments],
        cwd=ROOT, env=os.environ | {"CFPLAN_CACHE": str(cache)}, capture_output=True, text=True, timeout=280,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return [line.split()[1] for line in done.stderr.splitlines() if line.startswith("compiles ")], done


PLAN = "from cfplan.cli import main; sys.argv = ['cfplan', 'plan', 'flights/circle.yaml']; main()"


@pytest.mark.integration
def test_a_first_plan_compiles_nothing(tmp_path):
    (tmp_path / "file").write_text("")
    compiled, done = run(PLAN, tmp_path / "file" / "below")  # cannot be written, so nothing is compiled behind it
    assert compiled == []
    assert "planning without machine code" in done.stdout
    assert "Certificate: passed" in done.stdout


@pytest.mark.slow
def test_what_a_first_plan_needed_is_compiled_behind_it(tmp_path):
    compiled, done = run(PLAN, tmp_path)
    assert compiled == []
    assert "planning without machine code, which is compiled meanwhile" in done.stdout
    assert until(lambda: list(tmp_path.glob("ready-plan-*")), 200.0)
    compiled, done = run(PLAN, tmp_path)
    assert compiled == []
    assert "without machine code" not in done.stdout


GOING_ON = """
import os
from cfplan.cli import warm_up
print(warm_up._may_go_on(os.getppid()), warm_up._may_go_on(-1), os.nice(0) == warm_up.LEAST_PRIORITY, flush=True)
warm_up._step_back_once_alone()
print(os.nice(0) == warm_up.LEAST_PRIORITY)
"""


def test_of_those_whose_command_has_ended_one_goes_on(tmp_path):
    def begin():
        return subprocess.Popen(
            [sys.executable, "-c", "import sys\n" + GOING_ON], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            env=os.environ | {"CFPLAN_CACHE": str(tmp_path)},
        )  # fmt: skip

    first = begin()
    assert first.stdout.readline() == "True True False\n"
    assert begin().communicate("\n", timeout=60)[0] == "True False False\nTrue\n"
    assert first.communicate("\n", timeout=60)[0] == "True\n"
    assert begin().communicate("\n", timeout=60)[0] == "True True False\nTrue\n"


@pytest.mark.integration
def test_after_compiling_ahead_a_plan_compiles_nothing(tmp_path):
    work = "from cfplan.cli.warm_up import *; work(Stage.PLAN, Path('safety.yaml'), 'last')"
    compiled, done = run(work, tmp_path)
    counts = [tuple(map(int, line.split())) for line in done.stdout.splitlines()]
    assert counts == sorted(counts)
    assert counts[-1][0] == counts[-1][1] > 20
    assert "_search" in compiled
    # An array assigned to a slice makes numba compile this, for seconds: write a loop.
    assert not [name for name in compiled if "raise_with_shape_context" in name]

    compiled, done = run(PLAN, tmp_path)
    assert compiled == []
    assert "compiling" not in done.stderr  # there is nothing to wait for
    assert "Certificate: passed" in done.stdout


def test_a_stage_is_ready_once_a_later_one_is(monkeypatch, tmp_path):
    monkeypatch.setenv("CFPLAN_CACHE", str(tmp_path))
    assert not warm_up._ready(Stage.PLAN)
    warm_up._ready_file(Stage.REHEARSAL).touch()
    assert [warm_up._ready(stage) for stage in Stage] == [True, True, False]


def test_stages_follow_one_another():
    assert Stage.PLAN < Stage.REHEARSAL < Stage.FLIGHT
