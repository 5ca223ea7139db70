"""Compiled functions are kept where no stale code can come from, and by several processes at once."""

import gc
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from numba.core.errors import NumbaError

from cfplan import machine_code
from cfplan.machine_code import njit

PACKAGE = Path(machine_code.__file__).parent


@pytest.fixture
def cache(monkeypatch, tmp_path):
    monkeypatch.setenv("CFPLAN_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def doubling():
    @njit
    def doubled(x):
        return 2 * x

    return doubled


def files(cache):
    """The code of each function and set of argument types."""
    return sorted(file.name for file in cache.rglob("*.nbc"))


def test_a_function_is_compiled_once_for_each_kind_of_argument(cache):
    function = doubling()
    assert function(2) == 4
    assert function(2.0) == 4.0
    assert len(files(cache)) == 2
    again = doubling()
    assert again(3) == 6
    assert sum(again.stats.cache_hits.values()) == 1
    assert len(files(cache)) == 2


KEPT_BEFORE = """
import sys
import numpy as np
from cfplan.machine_code import njit
from cfplan.vehicle.rotations import matrix_of

@njit
def squares(n):
    found = np.zeros(n)
    for k in range(n):
        if k > 99:
            raise ValueError("too many")
        found[k] = k * k
    return found

@njit
def total(n):
    return squares(n).sum() + matrix_of(np.array([0.0, 0.0, 0.0, 1.0]))[2, 2]

@njit
def same_text(a, b):
    return hash(a) == hash(b)
"""
USED = "assert list(squares(4)) == [0, 1, 4, 9], squares(4)"
RAISED = """
try:
    squares(100 + 1)
except ValueError as error:
    assert str(error) == "too many"
else:
    raise SystemExit("nothing was raised")
"""


def test_what_other_processes_kept_is_used_and_called_by_what_is_compiled_later(cache, tmp_path):
    (tmp_path / "kept.py").write_text(KEPT_BEFORE)

    def run(*lines):
        code = "\n".join(["from kept import *", *lines])
        done = subprocess.run(
            [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=100,
            env=os.environ | {"PYTHONPATH": os.pathsep.join((str(PACKAGE.parent), str(tmp_path)))},
        )  # fmt: skip
        assert not done.stderr

    loaded = "assert not any(each.stats.cache_misses for each in (squares, total, same_text))"
    run(USED, 'assert same_text("a path", "a path") and not same_text("a path", "another")')
    run(USED, RAISED, loaded, 'assert "numba.np.arrayobj" not in sys.modules')
    run(USED, "assert total(4) == 15.0", "assert total.stats.cache_misses")  # calls code that was kept
    run("assert total(4) == 15.0", USED, RAISED, loaded)
    run('assert same_text("a path", "a path") and not same_text("a path", "another")', loaded)


def test_where_nothing_can_be_written_functions_are_compiled_all_the_same(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("CFPLAN_CACHE", str(tmp_path / "file" / "below"))
    assert not machine_code.cache_writable()
    assert doubling()(2) == 4


@pytest.mark.parametrize("suffix", ["nbc", "nbi"])
def test_a_damaged_file_is_compiled_anew(cache, suffix):
    doubling()(2)
    names = files(cache)
    (damaged,) = cache.rglob(f"*.{suffix}")
    damaged.write_bytes(damaged.read_bytes()[:40])
    assert doubling()(2) == 4
    again = doubling()
    assert again(3) == 6
    assert sum(again.stats.cache_hits.values()) == 1
    assert files(cache) == names


KEY = "from cfplan.machine_code import KEY; print(KEY)"


def test_a_change_in_any_source_that_compiled_code_may_depend_on_changes_the_key(tmp_path):
    copy = tmp_path / "cfplan"
    for name, text in {"__init__": "", "vehicle/mass": "G = 9.81\n", "cli/plan": "TITLE = 1\n"}.items():
        file = copy / f"{name}.py"
        file.parent.mkdir(exist_ok=True, parents=True)
        file.write_text(text)
    shutil.copy(machine_code.__file__, copy)

    def key():
        return subprocess.run(
            [sys.executable, "-c", KEY], cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(tmp_path)},
            capture_output=True, text=True, check=True, timeout=100,
        ).stdout  # fmt: skip

    before = key()
    (copy / "cli" / "plan.py").write_text("TITLE = 2\n")
    assert key() == before
    (copy / "vehicle" / "mass.py").write_text("G = 9.80665\n")
    changed = key()
    assert changed != before
    (copy / "vehicle" / "mass.py").rename(copy / "vehicle" / "weight.py")
    assert key() not in (before, changed)


def test_no_compiled_function_depends_on_what_the_key_leaves_out():
    for file in PACKAGE.rglob("*.py"):
        room, text = file.relative_to(PACKAGE).parts[0], file.read_text()
        if "import njit" in text:
            assert room not in machine_code.LEAVES, file
            assert not re.search(rf"cfplan\.({'|'.join(machine_code.LEAVES)})\b", text), file


def test_code_is_not_kept_once_a_source_has_changed_under_the_process(cache, monkeypatch):
    monkeypatch.setattr(machine_code, "hash_of_sources", lambda: "another")
    assert doubling()(2) == 4
    assert files(cache) == []


def start(folder, code, *arguments):
    """Start a process that can import from the folder, and goes on after a line on its standard input."""
    return subprocess.Popen(
        [sys.executable, "-c", code, *arguments], cwd=folder, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join((str(PACKAGE.parent), str(folder)))},
    )  # fmt: skip


EDITED = "from cfplan.machine_code import njit\nfrom cfplan.vehicle.airframe import GRAVITY\n\n@njit\ndef height():\n"
IMPORTED = "from edited import height\nprint('ready', flush=True)\ninput()\nprint(height())"


def test_code_of_a_module_that_was_edited_after_its_import_is_not_kept_for_the_new_source(cache, tmp_path):
    (tmp_path / "edited.py").write_text(EDITED + "    return 1\n")
    before = start(tmp_path, IMPORTED)
    assert before.stdout.readline() == "ready\n"
    (tmp_path / "edited.py").write_text(EDITED + "    return 1000\n")
    after = start(tmp_path, IMPORTED)
    assert before.communicate("\n", timeout=100)[0] == "1\n"
    assert after.communicate("\n", timeout=100)[0] == "ready\n1000\n"
    again = start(tmp_path, IMPORTED + "\nprint(sum(height.stats.cache_hits.values()))")
    assert again.communicate("\n", timeout=100)[0] == "ready\n1000\n1\n"


def test_a_failure_to_compile_leaves_the_collector_on(cache):
    @njit
    def fails(x):
        return x.nothing_of_this_name

    with pytest.raises(NumbaError):
        fails(1.0)
    assert gc.isenabled()
    assert not machine_code.compiles()


# Compiles a function for one kind of argument each, when told to.
AT_ONCE = """
import sys
import numpy as np
from kept import squares, total
print("ready", flush=True)
sys.stdin.readline()
kind = getattr(np, sys.argv[1])
print(float(total(kind(5))), float(total(kind(3))), sum(total.stats.cache_hits.values()), flush=True)
"""
KINDS = ("int8", "int16", "int32", "int64")


@pytest.mark.slow
def test_of_processes_that_compile_at_once_each_keeps_its_own(cache, tmp_path):
    (tmp_path / "kept.py").write_text(KEPT_BEFORE)

    def answers():
        processes = [start(tmp_path, AT_ONCE, kind) for kind in KINDS]
        for process in processes:
            assert process.stdout.readline() == "ready\n"
        for process in processes:
            process.stdin.write("\n")
            process.stdin.flush()
        return [process.communicate(timeout=120)[0] for process in processes]

    assert answers() == ["31.0 6.0 0\n"] * len(KINDS)
    assert answers() == ["31.0 6.0 1\n"] * len(KINDS)


def test_no_module_takes_njit_past_the_cache():
    for file in PACKAGE.rglob("*.py"):
        if file.name != "machine_code.py":
            assert not re.search(r"from numba import .*\bnjit\b|numba\.njit", file.read_text()), file
