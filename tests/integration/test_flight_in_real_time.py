"""Flights with real processes in real time, and what happens where one of them dies."""

import os
import pickle
import re
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable

import numpy as np
import pytest
from stepped_flight import at_setpoint

from cfplan.errors import ExitCode
from cfplan.flight.clock import monotonic
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.setpoints.packets import decode
from cfplan.flight.telemetry import Estimate, Phase, PoseReceived, SetpointSent, VehicleStatus
from cfplan.simulation.lab.lab import Lab, Truth, start_lab

pytestmark = [pytest.mark.integration, pytest.mark.slow]


def interrupt() -> None:
    os.kill(os.getpid(), signal.SIGINT)


def wait_until(condition: Callable[[], bool], patience: float) -> None:
    end = time.monotonic() + patience
    while not condition() and time.monotonic() < end:
        time.sleep(0.2)
    assert condition()


def test_a_flight_goes_by_the_clock_and_ends_landed(lab, fly_in, patient_mission):
    flight = fly_in(lab)
    outcome, truth = flight.outcome, flight.truth
    assert (outcome.exit_code, outcome.reason) == (ExitCode.OK, "landed")
    assert flight.phases == [phase for phase in Phase if phase is not Phase.UPLOAD]
    assert all(check.passed for check in outcome.checks)
    assert outcome.telemetry_dropped == 0
    assert outcome.deviation.max < 0.08
    assert truth.position[-1, 2] < 0.02
    assert not truth.motor[-1].any()
    assert not truth.locked
    assert truth.off_in_air[-1] == 0

    planned = decode(patient_mission.payloads).position
    landing = dict(outcome.phases)[Phase.LAND]
    sent = [message for message in flight.of(SetpointSent) if outcome.first_setpoint <= message.time < landing]
    assert len({message.index for message in sent}) > 0.9 * len(planned)  # a busy computer may skip some
    # Each deadline was met, or passed altogether on a computer that stood still, and was counted then.
    moving = [message for message in sent if message.index < len(planned) - 1]
    assert len(moving) + outcome.lateness.skipped >= len(planned) - 2
    for message in sent:
        due = (message.time - outcome.first_setpoint) * 100.0
        assert message.index == min(round(due), len(planned) - 1)
        assert message.position == tuple(planned[message.index])

    begin, end = (outcome.phases[which][1] for which in (0, -1))
    for kind, least in ((Estimate, 500), (VehicleStatus, 250), (PoseReceived, 500)):
        messages = flight.of(kind)
        assert len(messages) > least
        assert all(begin - 0.1 <= message.time <= end for message in messages)


def landed_on_the_path(truth: Truth, pressed: float) -> bool:
    """Whether it stands less than 0.72 m ahead of where Ctrl-C met it at 1.3 m/s; the plan ends 0.8 m ahead."""
    (x, y, z), then = truth.position[-1], np.interp(pressed, truth.time, truth.position[:, 0])
    return z < 0.02 and 0.0 < x - then < 0.72 and abs(y) < 0.1 and truth.off_in_air[-1] == 0 and not truth.locked


@pytest.mark.parametrize(
    ("times", "rung", "ended"), [(1, Rung.LAND, landed_on_the_path), (2, Rung.CUT, lambda truth, _: truth.locked)]
)
def test_ctrl_c_at_full_speed_lands_and_twice_cuts_the_motors(limits, fly_in, times, rung, ended):
    handler, pressed = signal.getsignal(signal.SIGINT), []

    def press() -> None:
        pressed.append(monotonic())
        for _ in range(times):
            interrupt()

    with start_lab(limits.airframe, number=1) as lab:
        flight = fly_in(lab, at_setpoint(120, press))
        assert flight.outcome.exit_code is ExitCode.ENDED_BY_OPERATOR
        assert flight.outcome.rung is rung
        wait_until(lambda: not lab.truth().motor[-1].any(), 2.0)
        assert ended(lab.truth(), pressed[0])
    assert signal.getsignal(signal.SIGINT) is handler


_MAIN = """
import multiprocessing, pickle, sys
from cfplan.flight.mocap.source import pose_source
from cfplan.flight.pilot.process import fly
from cfplan.flight.telemetry import SetpointSent
from cfplan.simulation.lab.sim_driver import SimDriver

def show(message):
    if isinstance(message, SetpointSent) and message.index == 100:
        print(*[child.pid for child in multiprocessing.active_children() if child.name == "pilot"], flush=True)

if __name__ == "__main__":
    mission = pickle.load(open(sys.argv[1], "rb"))
    source = pose_source(sys.argv[2], mission.limits.pose, open_within=30.0)
    fly(mission, uri="sim://2", drivers=[SimDriver], pose_source=source, on_telemetry=show)
"""


def is_landed_by_the_pilot(lab: Lab, main: subprocess.Popen) -> None:
    wait_until(lambda: not lab.truth().motor[-1].any(), 15.0)
    time.sleep(2.5)  # the vehicle calls itself landed 2 s after its motors stopped
    truth = lab.truth()
    assert truth.position[-1, 2] < 0.02
    assert truth.off_in_air[-1] == 0
    assert not truth.locked


def stops_by_itself(lab: Lab, main: subprocess.Popen) -> None:
    wait_until(lambda: lab.truth().locked, 4.0)
    wait_until(lambda: lab.truth().position[-1, 2] < 0.05, 3.0)
    assert main.stderr is not None
    assert re.search(r"LinkError: .*exit code -9", main.stderr.read())


@pytest.mark.parametrize(("victim", "ends"), [("main", is_landed_by_the_pilot), ("pilot", stops_by_itself)])
def test_whichever_process_is_killed_the_vehicle_comes_down(limits, patient_mission, tmp_path, victim, ends):
    (tmp_path / "mission").write_bytes(pickle.dumps(patient_mission))
    (tmp_path / "main.py").write_text(textwrap.dedent(_MAIN))
    command = [sys.executable, str(tmp_path / "main.py"), str(tmp_path / "mission")]
    with (
        start_lab(limits.airframe, number=2) as lab,
        subprocess.Popen([*command, lab.mocap_uri], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as main,
    ):
        assert main.stdout is not None
        pilot = int(main.stdout.readline())
        assert lab.truth().position[-1, 2] > 0.3
        os.kill({"main": main.pid, "pilot": pilot}[victim], signal.SIGKILL)
        ends(lab, main)
