"""Whole flights on the virtual Crazyflie: from connecting to landed, and the ways in which they may end.

They are flown on the stepped clock; test_flight_in_real_time.py has those that need processes, and the deaths of these.
"""

import os
import pickle
import signal

import numpy as np
import pytest
from stepped_flight import at_setpoint, fly_stepped

from cfplan.errors import ExitCode, LinkError
from cfplan.flight.mocap.source import pose_source
from cfplan.flight.pilot.conducted import ConductorMessage, HeldConductor
from cfplan.flight.pilot.keys import HeldOrders
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.pilot.process import fly
from cfplan.flight.setpoints.packets import decode
from cfplan.flight.telemetry import Estimate, Phase, PoseReceived, SetpointSent, VehicleStatus
from cfplan.simulation.lab.sim_driver import SimDriver
from cfplan.simulation.lab.stepped_lab import SteppedLab
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings

pytestmark = pytest.mark.integration


def interrupt() -> None:
    os.kill(os.getpid(), signal.SIGINT)


@pytest.fixture
def lab(limits):
    return SteppedLab(limits.airframe)


@pytest.fixture(scope="module")
def whole_flight(mission):
    return fly_stepped(mission)


def test_a_flight_ends_landed_disarmed_and_unlocked(whole_flight):
    assert whole_flight.outcome.exit_code is ExitCode.OK
    assert whole_flight.outcome.reason == "landed"
    assert whole_flight.phases == [phase for phase in Phase if phase is not Phase.UPLOAD]
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


def test_every_setpoint_is_sent_when_it_is_due_and_reported_as_sent(whole_flight, mission):
    outcome = whole_flight.outcome
    landing = dict(outcome.phases)[Phase.LAND]
    sent = [each for each in whole_flight.of(SetpointSent) if outcome.first_setpoint <= each.time < landing]
    planned = decode(mission.payloads).position
    assert [message.index for message in sent[: len(planned)]] == list(range(len(planned)))
    assert outcome.lateness.skipped == 0
    for message in sent:
        due = (message.time - outcome.first_setpoint) * 100.0
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


def test_ctrl_c_at_full_speed_brakes_on_the_path_and_lands(mission, lab):
    handler = signal.getsignal(signal.SIGINT)
    flight = fly_stepped(mission, at_setpoint(120, interrupt), lab=lab)
    assert flight.outcome.exit_code is ExitCode.ENDED_BY_OPERATOR
    assert flight.outcome.rung is Rung.LAND
    end = flight.truth.position[-1]
    assert end[2] < 0.02
    assert -0.2 < end[0] < 0.65
    assert abs(end[1]) < 0.1
    assert flight.truth.off_in_air[-1] == 0
    assert not flight.truth.locked
    assert signal.getsignal(signal.SIGINT) is handler


def test_a_second_ctrl_c_cuts_the_motors(mission, lab):
    flight = fly_stepped(mission, at_setpoint(120, lambda: (interrupt(), interrupt())), lab=lab)
    assert flight.outcome.exit_code is ExitCode.ENDED_BY_OPERATOR
    assert flight.outcome.rung is Rung.CUT
    assert not flight.truth.motor[-1].any()
    assert lab.truth().locked


def test_a_listener_that_fails_lands_the_vehicle_and_is_heard(mission, lab):
    def fail() -> None:
        raise ZeroDivisionError("the record is full")

    with pytest.raises(ZeroDivisionError, match="the record is full"):
        fly_stepped(mission, at_setpoint(50, fail), lab=lab)
    truth = lab.truth()
    assert truth.position[-1, 2] < 0.02
    assert not truth.motor[-1].any()
    assert not truth.locked


def test_when_the_main_process_is_gone_the_pilot_lands(mission, lab):
    orders = HeldOrders()

    def die() -> None:
        assert lab.truth().position[-1, 2] > 0.3
        orders.gone = True

    flight = fly_stepped(mission, at_setpoint(100, die), lab=lab, orders=orders)
    assert flight.outcome.exit_code is ExitCode.ENDED_BY_SAFETY
    assert flight.outcome.rung is Rung.LAND
    lab.clock.sleep(2.5)  # the vehicle calls itself landed 2 s after its motors stopped
    truth = lab.truth()
    assert truth.position[-1, 2] < 0.02
    assert not truth.motor[-1].any()
    assert truth.off_in_air[-1] == 0
    assert not truth.locked


class Killed(BaseException):
    """The pilot's process ends at once."""


def test_without_its_pilot_the_vehicle_stops_by_itself(mission, lab):
    def kill() -> None:
        raise Killed

    with pytest.raises(Killed):
        fly_stepped(mission, at_setpoint(100, lambda: lab.clock.at(lab.now, kill)), lab=lab)
    assert lab.truth().position[-1, 2] > 0.3
    lab.clock.sleep(4.0)
    assert lab.truth().locked
    lab.clock.sleep(3.0)
    assert lab.truth().position[-1, 2] < 0.05


def test_an_empty_battery_stays_on_the_ground(mission, limits):
    lab = SteppedLab(limits.airframe, vehicle=VehicleSettings(charge=0.05))
    flight = fly_stepped(mission, lab=lab)
    assert flight.outcome.exit_code is ExitCode.PREFLIGHT
    assert "battery at rest" in flight.outcome.reason
    assert Phase.ARM not in flight.phases
    assert not flight.truth.motor.any()


def test_a_lab_that_is_gone_is_an_error_with_a_hint(mission, monkeypatch):
    monkeypatch.setenv("CFPLAN_SIM_7", "127.0.0.1:9")
    source = pose_source("vicon://127.0.0.1:9/cf1", mission.limits.pose)
    with pytest.raises(LinkError) as caught:
        fly(mission, uri="sim://7", drivers=[SimDriver], pose_source=source)
    assert caught.value.hint


def test_a_conductor_that_clears_at_once_changes_nothing(whole_flight, mission, lab):
    """A single vehicle has none, and flies the same code."""
    conductor = HeldConductor(lambda _: None, lab.clock.now)
    conductor.give(ConductorMessage(dict.fromkeys(Phase, 0.0)))

    def beat(_):
        conductor.heard = lab.now

    assert fly_stepped(mission, beat, lab=lab, conductor=conductor).telemetry == whole_flight.telemetry
