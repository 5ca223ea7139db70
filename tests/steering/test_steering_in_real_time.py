"""The command line flies waypoints from standard input, and programs steer, with the processes of a real flight."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.integration, pytest.mark.slow]

SAFETY = Path(__file__).parents[2] / "safety.yaml"
PROGRAM = """
import cfplan
vehicle = cfplan.connect("sim://0", records="records")
with vehicle:  # and no main guard, as in the README
    vehicle.take_off(0.8)
    vehicle.fly([[1, 0, 1], [0, 1, 1.2]])
    vehicle.wait()
    vehicle.land()
print(vehicle.outcome.reason)
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "safety.yaml").write_text(SAFETY.read_text())
    return tmp_path


def test_waypoints_of_standard_input_are_flown(folder):
    done = subprocess.run(
        [sys.executable, "-m", "cfplan", "fly", "--waypoints", "-", "--json"],
        cwd=folder, input="1 0 1\n0 1 1.2\nhello\n", capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert sorted(answer.split()[1] for answer in document["answers"]) == ["accepted:", "accepted:", "refused:"]
    assert document["max_deviation"] < 0.2


def test_a_program_steers(folder):
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], cwd=folder, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.stdout.strip() == "landed", done.stderr
