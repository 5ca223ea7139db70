"""`cfplan virtual` as a room to rehearse in: another terminal flies a vehicle of it as it would fly one in a lab.

All commands are those that README and docs/ show; for a vehicle and a Vicon of a lab they get those of the room.
"""

import json
import re
import shlex
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pages
import pytest
from pages import ROOM

REPOSITORY = Path(__file__).parents[2]
COMMAND = (sys.executable, "-c", "from cfplan.cli import main; main()")
SERVED = "cfplan virtual --count 2 --vicon 8010"
ALONE = "cfplan virtual"
IN_A_LAB = (("radio://0/80/2M/E7E7E7E7E7", "udp://127.0.0.1:19850"), ("192.168.1.2", "127.0.0.1:8010"))

pytestmark = [pytest.mark.integration, pytest.mark.slow]


@contextmanager
def serving(line):
    """Run it until the block ends; yield what it says of the vehicles."""
    words = [*COMMAND, *shlex.split(line)[1:]]
    with subprocess.Popen(words, cwd=REPOSITORY, stderr=subprocess.PIPE, text=True, stdin=subprocess.DEVNULL) as served:
        try:
            said = ""
            while "Ctrl-C" not in said:
                read = served.stderr.readline()
                assert read, f"it has ended: {said}"
                said += read
            yield said
        finally:
            served.terminate()


def run(line, *more):
    """Run it in another process; return what it printed."""
    ended = subprocess.run(
        [*COMMAND, *shlex.split(line)[1:], *more], cwd=REPOSITORY, capture_output=True, text=True,
        stdin=subprocess.DEVNULL, timeout=240, check=False,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


def test_a_second_terminal_flies_one_of_two_vehicles_by_its_own_poses(tmp_path, patient_safety_file):
    lines = pages.lines_for(ROOM)
    (flown,) = [line for line in lines if line.startswith("cfplan fly")]
    looked = [line for line in lines if line.startswith(("cfplan mocap", "cfplan doctor"))]
    assert sorted([ALONE, SERVED, flown, *looked]) == lines
    with serving(ALONE) as said:
        assert "--uri udp://127.0.0.1:19850" in said
    with serving(SERVED) as said:
        assert re.search(r"cf2: (.*)", said)[1] in flown
        for line in looked:
            for lab, virtual in IN_A_LAB:
                line = line.replace(lab, virtual)
            document = json.loads(run(line, "--json"))
            assert "mocap" not in line or {"cf1", "cf2"} <= {body["name"] for body in document["bodies"]}
        flight = json.loads(
            run(flown, "--safety", str(patient_safety_file), "--records", str(tmp_path), "--yes", "--json")
        )
    assert flight["outcome"]["reason"] == "landed"
    assert flight["max_deviation"] < 0.08
