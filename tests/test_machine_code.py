"""Compiled functions are kept where no stale code can come from, and by two processes at once."""

import gc
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

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
    return sorted(file.name for file in cache.iterdir() if file.suffix == ".numba")


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
    assert not machine_code.kept()
    assert doubling()(2) == 4


def test_a_damaged_file_is_compiled_anew(cache):
    doubling()(2)
    (name,) = files(cache)
    (cache / name).write_bytes(b"half a file")
    assert doubling()(2) == 4
    assert doubling()(3) == 6
    assert files(cache) == [name]


KEYS = "from cfplan.machine_code import *; print(*(key(f'cfplan.{n}') for n in ('upper', 'lower', 'lowest', 'other')))"


def test_a_change_in_an_imported_module_changes_the_key(tmp_path):
    copy = tmp_path / "cfplan"
    copy.mkdir()
    shutil.copy(machine_code.__file__, copy)
    for name, text in {
        "__init__": "",
        "upper": "from cfplan.lower import (\n    G,\n    H,\n)\n",
        "lower": "from cfplan.lowest import G\n",
        "lowest": "G = 9.81\n",
        "other": "G = 9.81\n",
    }.items():
        (copy / f"{name}.py").write_text(text)

    def keys():
        return subprocess.run(
            [sys.executable, "-c", KEYS], cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(tmp_path)},
            capture_output=True, text=True, check=True, timeout=100,
        ).stdout.split()  # fmt: skip

    before = keys()
    (copy / "lowest.py").write_text("G = 9.80665\n")
    assert [old != new for old, new in zip(before, keys(), strict=True)] == [True, True, True, False]


def start(folder, code):
    """Start a process that can import from the folder, and goes on after a line on its standard input."""
    return subprocess.Popen(
        [sys.executable, "-c", code], cwd=folder, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
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


FAILING = """
from cfplan.machine_code import njit
from numba.core.errors import NumbaError

@njit
def fails(x):
    return x.nothing_of_this_name

try:
    fails(1.0)
except NumbaError:
    print("raised", flush=True)
input()
"""


def test_a_process_that_fails_to_compile_lets_others_try(cache, tmp_path):
    (tmp_path / "failing.py").write_text(FAILING)
    first = start(tmp_path, "import failing")
    assert first.stdout.readline() == "raised\n"
    assert start(tmp_path, "import failing").communicate("\n", timeout=60)[0] == "raised\n"  # while the first is there
    first.communicate("\n", timeout=60)


def test_what_fails_to_be_made_leaves_the_collector_on_and_lets_others_make_it(cache, tmp_path):
    def fail():
        raise MemoryError

    with pytest.raises(MemoryError):
        machine_code.kept_or_made("something", "cfplan.errors", fail)
    assert gc.isenabled()
    assert not machine_code.compiles()
    code = "from cfplan.machine_code import *; print(kept_or_made('something', 'cfplan.errors', lambda: b'made'))"
    assert start(tmp_path, code).communicate(timeout=60)[0] == "b'made'\n"


SLOWLY = """
import sys, time
from cfplan import machine_code
from numba.core import event

class Slowly(event.Listener):
    def on_start(self, event):
        name = event.data["dispatcher"].__name__
        print("compiling", name, flush=True)
        if name == "matrix_of":
            time.sleep(1.0)
    def on_end(self, event): ...

event.register("numba:compile", Slowly())
from cfplan.vehicle.rotations import matrix_of
import numpy as np
print("ready", flush=True)
sys.stdin.readline()
print(matrix_of(np.array([0.0, 0.0, 0.0, 1.0])).tolist(), flush=True)
"""


def test_of_two_processes_one_compiles_and_the_other_waits(cache):
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", SLOWLY], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=os.environ
        )
        for _ in range(3)
    ]
    for process in processes:
        assert process.stdout.readline() == "ready\n"
    for process in processes:
        process.stdin.write("\n")
        process.stdin.flush()
    outputs = [process.communicate(timeout=120)[0].splitlines() for process in processes]
    assert all(process.returncode == 0 for process in processes)
    assert {lines[-1] for lines in outputs} == {str(np.eye(3).tolist())}
    assert sum("compiling matrix_of" in lines for lines in outputs) == 1


def test_no_module_takes_njit_past_the_cache():
    for file in PACKAGE.rglob("*.py"):
        if file.name != "machine_code.py":
            assert not re.search(r"from numba import .*\bnjit\b|numba\.njit", file.read_text()), file
