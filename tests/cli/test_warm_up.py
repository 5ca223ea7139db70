"""What is compiled ahead is all that a plan needs, and nothing that numba is slow at."""

import os
import subprocess
import sys
from pathlib import Path

import psutil
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


# A command that begins two processes, says which, and ends once it may.
COMMAND = """
import sys
from pathlib import Path
from cfplan.cli.warm_up import Worker
from cfplan.preparation.compiled_calls import Stage
workers = [Worker(Stage.PLAN, Path("safety.yaml"), first) for first in ("0.5", "0.7")]
print(*(each.process.pid for each in workers), flush=True)
sys.stdin.readline()
"""


@pytest.mark.integration
def test_of_those_whose_command_has_ended_one_goes_on_at_the_lowest_priority(tmp_path):
    command = subprocess.Popen(
        [sys.executable, "-c", COMMAND], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT,
        env=os.environ | {"CFPLAN_CACHE": str(tmp_path)},
    )  # fmt: skip
    workers = [psutil.Process(int(each)) for each in command.stdout.readline().split()]

    def alive():
        return [each for each in workers if each.is_running() and each.status() != psutil.STATUS_ZOMBIE]

    try:
        assert until(lambda: list(tmp_path.glob("*.numba")))  # they compile
        assert len(alive()) == 2
        assert command.communicate("\n", timeout=60)[0] == ""
        assert until(lambda: len(alive()) < 2)
        compiled = len(list(tmp_path.glob("*.numba")))
        assert until(lambda: len(list(tmp_path.glob("*.numba"))) > compiled + 1)
        (alone,) = alive()
        assert alone.nice() == warm_up.LEAST_PRIORITY
    finally:
        for each in alive():
            each.kill()


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
    shutil.copy(machine_code.file_of(call), sys.argv[1])
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
    (ready,) = tmp_path.glob("ready-plan-*")
    ready.rename(tmp_path / ready.name.replace("plan", "rehearsal"))  # a later stage, with all that a plan needs
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
    assert "without machine code" not in done.stdout
    assert "compiling" not in done.stderr  # there is nothing to wait for
    assert "Certificate: passed" in done.stdout


def test_stages_follow_one_another():
    assert Stage.PLAN < Stage.REHEARSAL < Stage.FLIGHT
