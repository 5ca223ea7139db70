"""What is compiled ahead is all that a plan needs, and nothing that numba is slow at."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from waiting import until

from cfplan import machine_code
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
    assert until(lambda: list(tmp_path.glob("ready-plan-*")), 900.0)  # behind whatever else the computer does
    compiled, done = run(PLAN, tmp_path)
    assert compiled == []
    assert "without machine code" not in done.stdout


GOING_ON = """
import os
from cfplan import machine_code
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


WORK = "from cfplan.cli.warm_up import *; work(Stage.PLAN, Path('safety.yaml'), 'last')"
# Into a folder of its own goes what is compiled ahead, and nothing that it needs besides.
KEPT_ALONE = """
import shutil, sys
from cfplan import machine_code
from cfplan.preparation.compiled_calls import Stage, find_calls
from pathlib import Path
for call in find_calls(Path("safety.yaml"), Stage.PLAN):
    while not machine_code.is_compiled(call):
        machine_code.compile_call(call)
    shutil.copy(machine_code.cache_folder() / machine_code._file_of(call), sys.argv[1])
"""


@pytest.mark.integration
def test_what_is_compiled_ahead_is_all_that_a_plan_needs(tmp_path):
    run(KEPT_ALONE, machine_code.cache_folder(), str(tmp_path))
    code = [file.read_bytes() for file in tmp_path.iterdir()]
    assert len(code) > 20
    # An array assigned to a slice makes numba compile this, for seconds: write a loop.
    assert not [each for each in code if b"raise_with_shape_context" in each]

    compiled, done = run(WORK, tmp_path)
    assert compiled == []
    assert done.stdout.split() == [str(len(code))] * 2
    assert_a_plan_compiles_nothing(tmp_path)


@pytest.mark.slow  # it compiles all that a plan needs, for a minute
def test_after_compiling_ahead_a_plan_compiles_nothing(tmp_path):
    compiled, done = run(WORK, tmp_path)
    counts = [tuple(map(int, line.split())) for line in done.stdout.splitlines()]
    assert counts == sorted(counts)
    assert counts[-1][0] == counts[-1][1] > 20
    assert "_search" in compiled
    assert not [name for name in compiled if "raise_with_shape_context" in name]
    assert_a_plan_compiles_nothing(tmp_path)


def assert_a_plan_compiles_nothing(cache):
    compiled, done = run(PLAN, cache)
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
