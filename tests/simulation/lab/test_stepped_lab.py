"""The lab without real time: its clock, its faults, and the pilot's link in it."""

from pathlib import Path

import pytest

from cfplan.errors import LinkError
from cfplan.flight.clock import BEGIN
from cfplan.flight.mocap.pose_tracker import PoseTracker
from cfplan.flight.radio.session import PING_PERIOD
from cfplan.flight.telemetry import Estimate, VehicleStatus
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.lab.radio import RadioFault, RadioFaultKind
from cfplan.simulation.lab.stepped_lab import SteppedLab
from cfplan.simulation.lab.stepped_link import SteppedPoses, connect
from cfplan.simulation.virtual_crazyflie.faults import VehicleFault, VehicleFaultKind
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_vicon.faults import FaultKind, ViconFault
from cfplan.vehicle.airframes import AIRFRAMES

SAFETY_FILE = Path(__file__).parents[3] / "safety.yaml"
AIRFRAME = AIRFRAMES["crazyflie-2.1+"]


@pytest.fixture
def lab():
    return SteppedLab(AIRFRAME)


@pytest.fixture
def poses(lab):
    source = SteppedPoses(lab, load_limits(SAFETY_FILE).pose)
    source.open()
    return source


def test_time_goes_on_only_while_somebody_sleeps(lab):
    assert lab.now == BEGIN
    lab.clock.sleep(0.25)
    assert lab.now == pytest.approx(BEGIN + 0.25)
    lab.clock.stall(0.5)
    lab.clock.sleep(0.01)
    assert lab.now == pytest.approx(BEGIN + 0.76)


def test_what_is_to_happen_happens_at_its_time(lab):
    seen = []
    for moment in (0.3, 0.1):
        lab.clock.at(BEGIN + moment, lambda: seen.append(lab.now))
    lab.clock.sleep(1.0)
    assert seen == pytest.approx([BEGIN + 0.1, BEGIN + 0.3])


def test_the_link_hears_logs_dated_when_they_were_written(lab):
    heard = []
    link = connect(lab, heard.append)
    link.start_logs()
    lab.clock.sleep(1.0)
    estimates = [message for message in heard if isinstance(message, Estimate)]
    assert len(estimates) == pytest.approx(100, abs=3)
    assert len([message for message in heard if isinstance(message, VehicleStatus)]) == pytest.approx(50, abs=3)
    assert link.firmware == "2026.08"


def test_what_a_dead_radio_held_is_known_to_be_old(lab):
    link = connect(lab, lambda message: None)
    link.start_logs()
    lab.clock.sleep(0.2)
    lab.disturb(RadioFault(RadioFaultKind.DEAD, 0.0, 0.6))
    link.keep_alive()
    lab.clock.sleep(0.605)
    assert link.estimate is not None
    assert lab.now - link.estimate.time > 0.5  # it came just now
    lab.clock.sleep(0.5)
    assert lab.now - link.estimate.time < 0.05


def test_a_vehicle_without_packets_for_a_second_deletes_its_logs_and_the_link_creates_them_anew(lab):
    link = connect(lab, lambda message: None)
    link.start_logs()
    lab.clock.sleep(0.1)
    lab.disturb(RadioFault(RadioFaultKind.DEAD, 0.0, 1.1))
    lab.clock.sleep(1.5)
    assert lab.now - link.estimate.time > 0.3
    assert lab.now - link.acknowledged < PING_PERIOD + 0.01
    for _ in range(10):
        link.recreate_log("estimate")
        lab.clock.sleep(0.01)
    lab.clock.sleep(0.2)
    assert lab.now - link.estimate.time < 0.05
    assert lab.now - link.status.time > 0.3  # another log is left alone


def test_a_log_that_is_there_may_be_created_anew(lab):
    link = connect(lab, lambda message: None)
    link.start_logs()
    heard = lab.now
    for _ in range(10):
        link.recreate_log("status")
        lab.clock.sleep(0.01)
    lab.clock.sleep(0.1)
    assert link.status.time > heard + 0.1


def test_without_acknowledgements_the_vehicle_has_the_packet_in_the_air_once_and_no_other():
    lab = SteppedLab(AIRFRAME, vehicle=VehicleSettings(auto_arming=False))
    link = connect(lab, lambda message: None)
    lab.clock.sleep(0.05)  # until nothing waits any more
    before = lab.now
    lab.disturb(RadioFault(RadioFaultKind.UNACKNOWLEDGED, 0.0, 0.5))
    link.arm(True)
    link.arm(False)
    lab.clock.sleep(0.4)
    assert lab.vehicle.firmware.supervisor.armed
    assert link.acknowledged <= before
    lab.clock.sleep(0.2)
    assert not lab.vehicle.firmware.supervisor.armed
    assert lab.now - link.acknowledged < PING_PERIOD + 0.01


@pytest.mark.parametrize(("kind", "silent", "heard"), [
    (VehicleFaultKind.SILENT_ESTIMATE, "estimate", "status"),
    (VehicleFaultKind.SILENT_STATUS, "status", "estimate"),
])  # fmt: skip
def test_a_silent_log_leaves_the_other_alone(lab, kind, silent, heard):
    link = connect(lab, lambda message: None)
    link.start_logs()
    lab.clock.sleep(0.1)
    lab.disturb(VehicleFault(kind, 0.0, 0.4))
    lab.clock.sleep(0.39)
    assert lab.now - getattr(link, silent).time > 0.3
    assert lab.now - getattr(link, heard).time < 0.05
    lab.clock.sleep(0.1)
    assert lab.now - getattr(link, silent).time < 0.05


def test_parameters_are_set_and_read_back(lab):
    link = connect(lab, lambda message: None)
    assert link.set_parameter("ctrlMel.mass", 0.0345) == pytest.approx(0.0345)
    assert lab.vehicle.firmware.parameters["ctrlMel.mass"] == pytest.approx(0.0345)


def test_a_slow_vehicle_is_waited_for_and_a_silent_one_is_not():
    slow = SteppedLab(AIRFRAME, vehicle=VehicleSettings(parameter_delay=0.5))
    assert connect(slow, lambda message: None).set_parameter("stabilizer.controller", 2) == 2
    silent = SteppedLab(AIRFRAME, vehicle=VehicleSettings(parameter_delay=9.0))
    with pytest.raises(LinkError, match="no answer"):
        connect(silent, lambda message: None).set_parameter("stabilizer.controller", 2)


def test_poses_are_where_the_vehicle_is_ten_milliseconds_late(lab, poses):
    lab.clock.sleep(3.0)
    found = poses.poses()
    assert len(found) == pytest.approx(300, abs=3)
    assert found[-1].position == pytest.approx((0.0, 0.0, 0.0), abs=5e-3)
    assert lab.now - found[-1].time == pytest.approx(0.015, abs=0.01)


@pytest.mark.parametrize(
    "kind", [FaultKind.OCCLUDE, FaultKind.STALL, FaultKind.FREEZE, FaultKind.BREAK, FaultKind.CLOSE]
)
def test_no_faulty_pose_is_used(lab, poses, kind):
    tracker = PoseTracker(load_limits(SAFETY_FILE).pose)

    def used():
        return [pose for pose in poses.poses() if tracker.take(pose) and not tracker.fault]

    lab.clock.sleep(3.0)
    used()
    lab.disturb(ViconFault(kind, 0.0, 1.0))
    lab.clock.sleep(0.9)
    assert len(used()) <= 2
    lab.clock.sleep(1.0)
    assert len(used()) > 30


def test_the_truth_is_recorded_a_hundred_times_a_second(lab):
    lab.clock.sleep(1.0)
    truth = lab.truth()
    assert len(truth.time) == pytest.approx(100, abs=2)
    assert not truth.locked
