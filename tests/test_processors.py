"""Tests run as on other processors, and what is compiled for one processor is not loaded on another."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.processors import settings, unset

ROOT = Path(__file__).parents[1]
SETTINGS = re.findall(r"^PROCESSORS := (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)[0].split()
SEEN = """
import json, math
import numpy as np
from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__
from cfplan import machine_code
from numba.core.registry import cpu_target

@machine_code.njit
def doubled(x):
    return 2 * x

assert doubled(21) == 42
print(json.dumps({
    "name": cpu_target.target_context.codegen().magic_tuple()[1], "width": machine_code.vector_width(),
    "numpy": [name for name in __cpu_dispatch__ if __cpu_features__[name]],
    "compiled": doubled.stats.cache_misses != {},
}))
"""


def seen(setting, cache):
    (script := cache / "seen.py").write_text(SEEN)
    done = subprocess.run(
        [sys.executable, "-W", "error", "-m", "tests.processors", setting, sys.executable, "-W", "error", str(script)],
        cwd=ROOT, env=unset(dict(os.environ)) | {"CFPLAN_CACHE": str(cache), "PYTHONPATH": str(ROOT)},
        capture_output=True, text=True, check=False, timeout=100,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_the_makefile_names_four_settings():
    assert set(SETTINGS) == set(settings())
    assert len({json.dumps(variables) for variables in settings().values()}) == 4


@pytest.mark.integration
def test_each_setting_is_seen_by_numpy_and_by_what_is_compiled(tmp_path):
    found = {setting: seen(setting, tmp_path) for setting in SETTINGS}
    assert found["plain"]["name"] == "generic"
    assert found["plain"]["width"] == 2
    assert found["plain"]["numpy"] == found["mixed"]["numpy"] == []
    assert found["mixed"]["name"] == found["own"]["name"]


@pytest.mark.integration
def test_what_is_compiled_for_one_processor_is_not_loaded_for_another(tmp_path):
    assert seen("own", tmp_path)["compiled"]
    assert seen("plain", tmp_path)["compiled"]
    assert not seen("own", tmp_path)["compiled"]
    assert not seen("plain", tmp_path)["compiled"]
    assert not seen("mixed", tmp_path)["compiled"]  # compiled functions see this computer's own
