"""The command line flies waypoints from standard input, and programs steer, with the processes of a real flight."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import cfplan
from cfplan.air.requests import PathVerdict, Wish
from cfplan.recording.reader import read_record
from cfplan.steering.recertify import recertify

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


def says_that_it_landed(said: str) -> None:
    assert said.strip() == "landed"


def answers_each_line(said: str) -> None:
    document = json.loads(said)
    assert sorted(answer.split()[1] for answer in document["answers"]) == ["accepted:", "accepted:", "refused:"]
    assert document["max_deviation"] < 0.2


@pytest.mark.parametrize(
    ("command", "given", "tells"),
    [
        (("-c", PROGRAM), "", says_that_it_landed),
        (("-m", "cfplan", "fly", "--waypoints", "-", "--json"), "1 0 1\n0 1 1.2\nhello\n", answers_each_line),
    ],
    ids=["a program", "lines of standard input"],
)
def test_a_vehicle_is_steered_by(command, given, tells, tmp_path):
    (tmp_path / "safety.yaml").write_text(SAFETY.read_text())
    done = subprocess.run(
        [sys.executable, *command], cwd=tmp_path, input=given, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    tells(done.stdout)
    (folder,) = (tmp_path / "records").iterdir()
    record = read_record(folder)
    assert not record.status.motor[-1].any()
    np.testing.assert_allclose(record.estimates.position[-1], (0.0, 1.0, 0.0), atol=0.15)


WISHES = (*[Wish.REPLACE] * 12, Wish.EXTEND, Wish.STOP, Wish.SLOWER, Wish.FASTER)


def test_what_requests_in_bursts_lead_to_is_certified_again(limits, tmp_path):
    """A hundred a second with pauses: plans are made on plans that are simulated still."""
    chance, answers = np.random.default_rng(3), []
    patient = replace(limits, pose=replace(limits.pose, age_brake=0.5, age_land=1.5), lateness=1.0)
    low, high = (np.array(end) + side * (limits.space.margin + 0.4) for end, side in
                 ((limits.space.low, 1.0), (limits.space.high, -1.0)))  # fmt: skip
    with cfplan.connect("sim://0", safety=patient, records=tmp_path, keys=False) as vehicle:
        vehicle.take_off(0.8)
        ends = vehicle.time + 8.0
        while vehicle.time < ends:
            wish = WISHES[chance.integers(len(WISHES))]
            waypoints = chance.uniform(low, high, (3, 3)).tolist() if wish in (Wish.REPLACE, Wish.EXTEND) else ()
            vehicle.request(wish, waypoints)
            vehicle.sleep(0.01 if chance.random() < 0.97 else 0.4)
            answers += vehicle.answers()
        vehicle.wait()
        vehicle.land()
    accepted = sum(answer.verdict is PathVerdict.ACCEPTED for answer in answers)
    assert accepted > 20
    found = recertify(read_record(vehicle.record))
    assert found.plans > 20
    assert found.streamed > 800
