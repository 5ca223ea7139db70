"""Flights with real processes in real time, and what happens where one of them dies."""

import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable

import pytest
from stepped_flight import at_setpoint

from cfplan.errors import ExitCode, LinkError
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.setpoints.packets import decode
from cfplan.flight.telemetry import Estimate, Phase, PoseReceived, SetpointSent, VehicleStatus
from cfplan.simulation.lab.lab import start_lab

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
    assert flight.phases == list(Phase)
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


def test_ctrl_c_at_full_speed_brakes_on_the_path_and_lands(lab, fly_in):
    off_before, handler = lab.truth().off_in_air[-1], signal.getsignal(signal.SIGINT)
    flight = fly_in(lab, at_setpoint(120, interrupt))
    assert flight.outcome.exit_code is ExitCode.ENDED_BY_OPERATOR
    assert flight.outcome.rung is Rung.LAND
    end = flight.truth.position[-1]
    assert end[2] < 0.02
    assert -0.2 < end[0] < 0.6
    assert abs(end[1]) < 0.1
    assert flight.truth.off_in_air[-1] == off_before
    assert not flight.truth.locked
    assert signal.getsignal(signal.SIGINT) is handler


_MAIN = """
import pickle, sys
from cfplan.flight.pilot.process import fly
from cfplan.flight.telemetry import SetpointSent
from cfplan.simulation.lab.room import RoomPoseSource
from cfplan.simulation.lab.sim_driver import SimDriver

def show(message):
    if isinstance(message, SetpointSent) and message.index == 100:
        print("streaming", flush=True)

if __name__ == "__main__":
    mission = pickle.load(open(sys.argv[1], "rb"))
    fly(mission, uri="sim://0", drivers=[SimDriver], pose_source=RoomPoseSource(0), on_telemetry=show)
"""


def test_when_the_main_process_is_killed_the_pilot_lands(lab, patient_mission, tmp_path):
    off_before = lab.truth().off_in_air[-1]
    (tmp_path / "mission").write_bytes(pickle.dumps(patient_mission))
    (tmp_path / "main.py").write_text(textwrap.dedent(_MAIN))
    with subprocess.Popen(
        [sys.executable, str(tmp_path / "main.py"), str(tmp_path / "mission")], stdout=subprocess.PIPE, text=True
    ) as main:
        assert main.stdout is not None
        assert main.stdout.readline() == "streaming\n"
        assert lab.truth().position[-1, 2] > 0.3
        main.kill()
    wait_until(lambda: not lab.truth().motor[-1].any(), 15.0)
    time.sleep(2.5)  # the vehicle calls itself landed 2 s after its motors stopped
    truth = lab.truth()
    assert truth.position[-1, 2] < 0.02
    assert truth.off_in_air[-1] == off_before
    assert not truth.locked


def test_a_second_ctrl_c_cuts_the_motors(limits, fly_in):
    with start_lab(limits.airframe, number=1) as lab:
        flight = fly_in(lab, at_setpoint(120, lambda: (interrupt(), interrupt())))
        assert flight.outcome.exit_code is ExitCode.ENDED_BY_OPERATOR
        assert flight.outcome.rung is Rung.CUT
        wait_until(lambda: not lab.truth().motor[-1].any(), 2.0)
        assert lab.truth().locked


def test_a_pilot_that_is_killed_is_an_error_and_the_vehicle_stops_by_itself(limits, fly_in):
    def kill_pilot() -> None:
        (pilot,) = [child for child in multiprocessing.active_children() if child.name == "pilot"]
        assert pilot.pid is not None
        os.kill(pilot.pid, signal.SIGKILL)

    with start_lab(limits.airframe, number=2) as lab:
        with pytest.raises(LinkError, match="exit code -9"):
            fly_in(lab, at_setpoint(100, kill_pilot))
        wait_until(lambda: lab.truth().locked, 4.0)
        wait_until(lambda: lab.truth().position[-1, 2] < 0.05, 3.0)
