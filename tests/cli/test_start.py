"""Commands begin at once: what is heavy is imported by those that need it."""

import subprocess
import sys

import pytest

HEAVY = ("numpy", "numba", "scipy", "casadi", "torch", "cflib", "rerun", "pyarrow", "pydantic")


def loaded_after(statement: str) -> set[str]:
    """Which heavy packages a fresh interpreter has loaded after it."""
    script = f"import sys\n{statement}\nprint(*(set({HEAVY}) & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=120)
    return set(done.stdout.split())


@pytest.mark.parametrize("module", ["cfplan", "cfplan.cli"])
def test_the_command_line_loads_nothing_heavy(module):
    assert not loaded_after(f"import {module}")


def test_planning_does_not_load_torch():
    assert "torch" not in loaded_after("import cfplan.planning.plan, cfplan.learning.learned")
