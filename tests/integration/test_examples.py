"""cflib's own examples, unmodified, on the virtual Crazyflie over UDP, each a process of its own.

They are the files that its wheel brings along, byte for byte: the wheel's own list of checksums is held against them.
"""

import base64
import hashlib
import os
import re
import subprocess
import sys
from importlib.metadata import files
from pathlib import Path

import cflib
import numpy as np
import pytest

from cfplan.errors import InputError
from cfplan.simulation.lab.lab import start_lab
from cfplan.simulation.lab.room import RoomSettings
from cfplan.vehicle.airframes import AIRFRAMES

EXAMPLES = Path(cflib.__file__).parents[1] / "examples"
AIRFRAME = AIRFRAMES["crazyflie-2.1+"]
SEQUENCE = [(0.0, 0.0, 1.2), (0.5, -0.5, 1.2), (0.5, 0.5, 1.2), (-0.5, 0.5, 1.2), (-0.5, -0.5, 1.2), (0.0, 0.0, 0.4)]

pytestmark = pytest.mark.integration


@pytest.fixture
def served():
    with start_lab(AIRFRAME, room=RoomSettings(on_board=True), number=6) as lab:
        yield lab


def unmodified(example: str) -> Path:
    """The example, if it is as cflib was published."""
    (listed,) = [file for file in files("cflib") if file.as_posix() == f"examples/{example}"]
    digest = hashlib.new(listed.hash.mode, (EXAMPLES / example).read_bytes()).digest()
    assert base64.urlsafe_b64encode(digest).rstrip(b"=").decode() == listed.hash.value
    return EXAMPLES / example


def run(example: str, lab, folder: Path) -> str:
    ended = subprocess.run(
        [sys.executable, str(unmodified(example))],
        cwd=folder,
        env=os.environ | {"CFLIB_URI": f"udp://127.0.0.1:{lab.port}"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


def passes(lab, place) -> float:
    """m, how near the vehicle came."""
    return float(np.linalg.norm(lab.truth().position - place, axis=1).min())


def test_the_parameter_example_writes_and_reads_back(served, tmp_path):
    assert "Read back: pid_attitude.pitch_kd=0.1234" in run("parameters/basicparam.py", served, tmp_path)


@pytest.mark.slow
def test_the_logging_example_prints_a_standing_vehicle(served, tmp_path):
    said = run("logging/basiclog.py", served, tmp_path)
    heights = [float(value) for value in re.findall(r"stateEstimate\.z: (-?[\d.]+)", said)]
    assert len(heights) > 20
    assert np.abs(heights).max() < 0.05


@pytest.mark.slow
def test_the_autonomous_sequence_goes_to_each_of_its_places_and_lands(served, tmp_path):
    run("autonomy/autonomous_sequence.py", served, tmp_path)
    for place in SEQUENCE:
        assert passes(served, place) < 0.1
    truth = served.truth()
    assert truth.position[-1, 2] < 0.05
    assert not truth.locked


@pytest.mark.slow
def test_the_high_level_sequence_flies_its_figure_and_lands(served, tmp_path):
    run("autonomy/autonomous_sequence_high_level.py", served, tmp_path)
    truth = served.truth()
    assert truth.position[:, 2].max() == pytest.approx(1.0, abs=0.1)
    assert np.ptp(truth.position[:, 0]) > 1.5
    assert truth.position[-1, 2] < 0.05
    assert truth.off_in_air[-1] == 0
    assert not truth.locked


def test_a_port_that_is_taken_is_an_error_with_a_hint(served):
    with pytest.raises(InputError, match=f"port {served.port}") as caught:
        start_lab(AIRFRAME, number=7, port=served.port)
    assert "--port" in caught.value.hint
