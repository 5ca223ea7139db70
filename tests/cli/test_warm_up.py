"""What is compiled ahead is all that a plan needs, and nothing that numba is slow at."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

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

    plan = "from cfplan.cli import main; sys.argv = ['cfplan', 'plan', 'flights/circle.yaml']; main()"
    compiled, done = run(plan, tmp_path)
    assert compiled == []
    assert "compiling" not in done.stderr  # there is nothing to wait for
    assert "Certificate: passed" in done.stdout


def test_stages_follow_one_another():
    assert Stage.PLAN < Stage.REHEARSAL < Stage.FLIGHT
