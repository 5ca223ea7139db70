"""What planning computes without machine code is what it computes with it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from cfplan.geometry.path_file import load_path_file
from cfplan.planning.plan import plan
from cfplan.safety.limits_file import load_limits

ROOT = Path(__file__).parent.parent
BOTH_WAYS = """
import copy, json, sys
import numpy as np
from cfplan import machine_code

with_another_way, called = set(), set()

class Both(machine_code._Interpreted):
    # Runs the loops that are else compiled, and what stands for them, on the same arguments.
    def __init__(self, function, interpreted, options):
        super().__init__(function, interpreted, options)
        if interpreted is not function:
            with_another_way.add(self.name)

    @property
    def name(self):
        return f"{self.function.__module__}.{self.function.__qualname__}"

    def __call__(self, *arguments):
        if self.interpreted is self.function:
            return self.function(*arguments)
        called.add(self.name)
        for_loops = copy.deepcopy(arguments)
        by_loops, by_arrays = self.function(*for_loops), self.interpreted(*arguments)
        compare(self.name, (by_loops, for_loops), (by_arrays, arguments))
        return by_arrays

def compare(name, expected, found):
    if isinstance(expected, tuple):
        assert len(expected) == len(found), name
        for pair in zip(expected, found):
            compare(name, *pair)
    elif isinstance(expected, (np.ndarray, float)):
        tolerance = 1e-5 if getattr(expected, "dtype", None) == np.float32 else 1e-9
        finite = np.abs(np.where(np.isfinite(expected), expected, 0.0))
        np.testing.assert_allclose(found, expected, tolerance, tolerance * finite.max(initial=0.0), err_msg=name)
    else:
        assert expected is found or expected == found, name

machine_code._Interpreted = Both
with machine_code.without_compiling():
    from pathlib import Path
    from cfplan.geometry.min_snap import min_snap
    from cfplan.geometry.yaw import YawMode
    from cfplan.planning.plan import plan
    from cfplan.safety.limits_file import load_limits
    limits = load_limits(Path("safety.yaml"))
    path = min_snap([[0.0, 0.0, 1.0], [0.6, 0.5, 1.2], [0.0, 0.9, 0.8]])
    path.check()
    plan(path, limits.airframe, limits, planner="learned")
    plan(path, limits.airframe, limits, planner="expert", nodes=12, yaw=YawMode.FREE)
print(json.dumps([sorted(with_another_way), sorted(called)]))
"""
PLANS = """
import json, sys
from cfplan.machine_code import without_compiling
from numba.core import event

class Compiles(event.Listener):
    def on_start(self, event):
        raise AssertionError("something is compiled")
    def on_end(self, event): ...

event.register("numba:compile", Compiles())
with without_compiling():
    from pathlib import Path
    from cfplan.geometry.path_file import load_path_file
    from cfplan.planning.plan import plan
    from cfplan.safety.limits_file import load_limits
    limits = load_limits(Path("safety.yaml"))
    for name in sys.argv[1:]:
        file = load_path_file(Path(name))
        made = plan(file.path, limits.airframe, limits, yaw=file.yaw, yaw_angle=file.yaw_angle, speed_factor=file.speed)
        print(json.dumps([made.planner, made.trajectory.duration, made.certificate.to_dict()]))
"""


def run(code, cache, *arguments):
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], cwd=ROOT, env=os.environ | {"CFPLAN_CACHE": str(cache)},
        capture_output=True, text=True, timeout=280,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_numpy_computes_what_the_loops_do(tmp_path):
    ((with_another_way, called),) = run(BOTH_WAYS, tmp_path)
    assert called == with_another_way
    assert len(called) > 8


@pytest.mark.integration
def test_a_plan_is_the_same_without_machine_code(tmp_path):
    (tmp_path / "file").write_text("")
    flights = [f"flights/{name}.yaml" for name in ("line", "loop3d")]  # the second by the expert
    limits = load_limits(ROOT / "safety.yaml")
    for name, (planner, duration, certificate) in zip(
        flights, run(PLANS, tmp_path / "file" / "below", *flights), strict=True
    ):
        file = load_path_file(ROOT / name)
        compiled = plan(
            file.path, limits.airframe, limits, yaw=file.yaw, yaw_angle=file.yaw_angle, speed_factor=file.speed
        )
        assert certificate["passed"]
        assert planner == compiled.planner
        assert duration == pytest.approx(compiled.trajectory.duration, rel=1e-5)
        for margin, expected in zip(certificate["margins"], compiled.certificate.margins, strict=True):
            assert margin["share"] == pytest.approx(expected.share, abs=1e-3)
