"""`cfplan virtual` as a room to rehearse in: another terminal flies a vehicle of it as it would fly one in a lab."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
COMMAND = (sys.executable, "-c", "from cfplan.cli import main; main()")

pytestmark = [pytest.mark.integration, pytest.mark.slow]


def test_a_second_terminal_flies_one_of_two_vehicles_by_its_own_poses(tmp_path, patient_safety_file):
    room = [*COMMAND, "virtual", "--port", "19870", "--count", "2", "--vicon", "19869"]
    with subprocess.Popen(room, cwd=REPOSITORY, stderr=subprocess.PIPE, text=True, stdin=subprocess.DEVNULL) as served:
        try:
            said = ""
            while "Ctrl-C" not in said:
                said = served.stderr.readline()
                assert said, "it has ended"
                if "cf2" in said:
                    where = said.split(": ", 1)[1].split()
            words = ["fly", "flights/line.yaml", "--safety", str(patient_safety_file), "--records", str(tmp_path)]
            ended = subprocess.run(
                [*COMMAND, *words, *where, "--yes", "--json"], cwd=REPOSITORY, capture_output=True, text=True,
                stdin=subprocess.DEVNULL, timeout=240, check=False,
            )  # fmt: skip
        finally:
            served.terminate()
    assert ended.returncode == 0, ended.stderr
    flight = json.loads(ended.stdout)
    assert flight["outcome"]["reason"] == "landed"
    assert flight["max_deviation"] < 0.08
