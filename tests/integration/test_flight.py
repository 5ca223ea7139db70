"""Whole flights on the virtual Crazyflie: from connecting to landed, and the ways in which they may end."""

import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable

import numpy as np
import pytest

from cfplan.errors import ExitCode, LinkError
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.pilot.process import fly
from cfplan.flight.setpoints.packets import decode
from cfplan.flight.telemetry import Estimate, Phase, PoseReceived, SetpointSent, Telemetry, VehicleStatus
from cfplan.simulation.lab.lab import start_lab
from cfplan.simulation.lab.room import RoomPoseSource
from cfplan.simulation.lab.sim_driver import SimDriver
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings

pytestmark = pytest.mark.integration


def at_setpoint(index: int, action: Callable[[], None]) -> Callable[[Telemetry], None]:
    """A reaction that acts once, when that setpoint has been sent."""
    done = False

    def react(message: Telemetry) -> None:
        nonlocal done
        if not done and isinstance(message, SetpointSent) and message.index >= index:
            done = True
            action()

    return react


def interrupt() -> None:
    os.kill(os.getpid(), signal.SIGINT)


def wait_until(condition: Callable[[], bool], patience: float) -> None:
    end = time.monotonic() + patience
    while not condition() and time.monotonic() < end:
        time.sleep(0.2)
    assert condition()


@pytest.fixture
def whole_flight(lab, fly_in, once):
    return once(lambda: fly_in(lab))


def test_a_flight_ends_landed_disarmed_and_unlocked(whole_flight):
    assert whole_flight.outcome.exit_code is ExitCode.OK
    assert whole_flight.outcome.reason == "landed"
    assert whole_flight.phases == list(Phase)
    assert whole_flight.truth.position[-1, 2] < 0.02
    assert not whole_flight.truth.motor[-1].any()
    assert not whole_flight.truth.locked


def test_the_motors_never_stop_in_the_air(whole_flight):
    assert whole_flight.truth.off_in_air[-1] == 0


def test_the_vehicle_stays_with_its_setpoints(whole_flight, mission):
    outcome, truth = whole_flight.outcome, whole_flight.truth
    assert outcome.deviation.max < 0.08
    planned = decode(mission.payloads).position
    # The same by the truth, at the moments of the setpoints.
    moments = outcome.first_setpoint + np.arange(len(planned)) / 100.0
    flown = np.stack([np.interp(moments, truth.time, truth.position[:, axis]) for axis in range(3)], axis=1)
    assert np.linalg.norm(flown - planned, axis=1).max() < 0.08
    assert flown[-1] == pytest.approx(planned[-1], abs=0.03)


def test_setpoints_are_sent_by_the_clock_and_reported_as_sent(whole_flight, mission):
    sent = whole_flight.of(SetpointSent)
    planned = decode(mission.payloads).position
    assert len({message.index for message in sent}) > 0.9 * len(mission.payloads)  # a busy computer may skip some
    # Each deadline was met, or passed altogether on a computer that stood still, and was counted then.
    moving = [message for message in sent if message.index < len(planned) - 1]
    assert len(moving) + whole_flight.outcome.lateness.skipped >= len(planned) - 2
    for message in sent:
        due = (message.time - whole_flight.outcome.first_setpoint) * 100.0
        assert message.index == min(round(due), len(planned) - 1)
        assert message.position == tuple(planned[message.index])


def test_everything_is_reported_on_one_clock(whole_flight):
    begin, end = (whole_flight.outcome.phases[which][1] for which in (0, -1))
    for kind, least in ((Estimate, 500), (VehicleStatus, 250), (PoseReceived, 500)):
        messages = whole_flight.of(kind)
        assert len(messages) > least
        assert all(begin - 0.1 <= message.time <= end for message in messages)
    assert whole_flight.outcome.telemetry_dropped == 0


def test_every_preflight_check_is_reported_with_its_number(whole_flight):
    assert len(whole_flight.outcome.checks) >= 12
    for check in whole_flight.outcome.checks:
        assert check.passed
        assert any(check.name in text and check.value in text for text in whole_flight.said)


def test_an_outcome_can_be_passed_on(whole_flight):
    assert pickle.loads(pickle.dumps(whole_flight.outcome)) == whole_flight.outcome


def test_ctrl_c_at_full_speed_brakes_on_the_path_and_lands(lab, fly_in):
    off_before, handler = lab.truth().off_in_air[-1], signal.getsignal(signal.SIGINT)
    flight = fly_in(lab, at_setpoint(120, interrupt))
    assert flight.outcome.exit_code is ExitCode.ENDED_BY_PILOT
    assert flight.outcome.rung is Rung.LAND
    end = flight.truth.position[-1]
    assert end[2] < 0.02
    assert -0.2 < end[0] < 0.6
    assert abs(end[1]) < 0.1
    assert flight.truth.off_in_air[-1] == off_before
    assert not flight.truth.locked
    assert signal.getsignal(signal.SIGINT) is handler


def test_a_listener_that_fails_lands_the_vehicle_and_is_heard(lab, fly_in):
    def fail() -> None:
        raise ZeroDivisionError("the record is full")

    with pytest.raises(ZeroDivisionError, match="the record is full"):
        fly_in(lab, at_setpoint(50, fail))
    truth = lab.truth()
    assert truth.position[-1, 2] < 0.02
    assert not truth.motor[-1].any()
    assert not truth.locked


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


def test_when_the_main_process_is_killed_the_pilot_lands(lab, mission, tmp_path):
    off_before = lab.truth().off_in_air[-1]
    (tmp_path / "mission").write_bytes(pickle.dumps(mission))
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
        assert flight.outcome.exit_code is ExitCode.ENDED_BY_PILOT
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


def test_an_empty_battery_stays_on_the_ground(limits, fly_in):
    with start_lab(limits.airframe, vehicle=VehicleSettings(charge=0.05), number=3) as lab:
        flight = fly_in(lab)
        assert flight.outcome.exit_code is ExitCode.PREFLIGHT
        assert "battery at rest" in flight.outcome.reason
        assert Phase.ARM not in flight.phases
        assert not flight.truth.motor.any()


def test_a_lab_that_is_gone_is_an_error_with_a_hint(limits, mission, monkeypatch):
    monkeypatch.setenv("CFPLAN_SIM_7", "127.0.0.1:9")
    began = time.monotonic()
    with pytest.raises(LinkError) as caught:
        fly(mission, uri="sim://7", drivers=[SimDriver], pose_source=RoomPoseSource(7))
    assert time.monotonic() - began < 8.0  # of which the start of a process takes its part
    assert caught.value.hint
