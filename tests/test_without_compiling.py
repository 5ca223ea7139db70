"""What planning computes without machine code is what it computes with it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cfplan import machine_code
from cfplan.geometry.path_file import load_path_file
from cfplan.planning.plan import plan
from cfplan.safety.limits_file import load_limits

ROOT = Path(__file__).parent.parent
# Runs the loops that are else compiled, and what stands for them, on the same arguments.
BOTH_WAYS = """
import copy, json, sys
import numpy as np
from cfplan.machine_code import without_compiling

called = set()

def both_ways(stand_in):
    name = f"{stand_in.function.__module__}.{stand_in.function.__qualname__}"

    def run(*arguments):
        called.add(name)
        for_loops = copy.deepcopy(arguments)
        by_loops, by_arrays = stand_in.function(*for_loops), stand_in.interpreted(*arguments)
        compare(name, (by_loops, for_loops), (by_arrays, arguments))
        return by_arrays

    return name, run

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

with without_compiling():
    from pathlib import Path
    import cfplan.learning.learned, cfplan.planners.expert.expert, cfplan.planning.repair
    from cfplan.flight.setpoints.packets import FullStateSetpoints
    from cfplan.flight.setpoints.stops import stop_motion
    from cfplan.geometry.min_snap import min_snap
    from cfplan.geometry.yaw import YawMode
    from cfplan.planning.plan import plan
    from cfplan.safety.limits_file import load_limits

    with_another_way = {}
    for module in [each for name, each in sys.modules.items() if name.startswith("cfplan.")]:
        for name, value in list(vars(module).items()):
            if hasattr(value, "interpreted") and value.interpreted is not value.function:
                if value not in with_another_way:
                    with_another_way[value] = both_ways(value)
                setattr(module, name, with_another_way[value][1])
    limits = load_limits(Path("safety.yaml"))
    path = min_snap([[0.0, 0.0, 1.0], [0.6, 0.5, 1.2], [0.0, 0.9, 0.8]])
    path.check()
    made = plan(path, limits.airframe, limits, planner="learned")
    plan(path, limits.airframe, limits, planner="expert", nodes=12, yaw=YawMode.FREE)
    for rows in (1, 2, 40):
        state = made.trajectory.at(np.arange(rows) / 100.0)
        motion = FullStateSetpoints(*(getattr(state, name) for name in FullStateSetpoints.__slots__))
        stop_motion(motion, np.arange(rows), 100.0)
print(json.dumps([sorted(name for name, _ in with_another_way.values()), sorted(called)]))
"""
# No error, though compiled code takes in its stride what is one in Python: a motion at rest, or turned fast.
TRADES = """
import json, sys
import numpy as np
from cfplan.machine_code import without_compiling

def traded(quaternion, rate):
    from cfplan.flight.setpoints.packets import FullStateSetpoints
    from cfplan.flight.setpoints.rate_trade import harmless_rates, trade_rates
    none = np.zeros((2, 3))
    motion = FullStateSetpoints(none, none, none, np.array([quaternion] * 2), np.full((2, 3), rate))
    sent, harmless = trade_rates(motion, none), harmless_rates(motion, none)
    return [getattr(sent, name).tolist() for name in FullStateSetpoints.__slots__], harmless.tolist()

cases = [(q, rate) for q in ([0.0, 0.0, 0.0, 1.0], [0.0, 0.5**0.5, 0.0, 0.5**0.5]) for rate in (0.0, 30.0)]
with without_compiling():
    interpreted = [traded(*case) for case in cases]
print(json.dumps([interpreted, [traded(*case) for case in cases]]))
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
    assert any("setpoints.stops" in name for name in called)


def test_rates_are_traded_without_machine_code_as_with_it():
    """A new computer flies so while it compiles."""
    ((interpreted, compiled),) = run(TRADES, machine_code.cache_folder())
    for (sent, harmless), (sent_compiled, harmless_compiled) in zip(interpreted, compiled, strict=True):
        for found, expected in zip(sent, sent_compiled, strict=True):
            np.testing.assert_allclose(found, expected, atol=1e-12)
        np.testing.assert_allclose(harmless, harmless_compiled, atol=1e-12)


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
