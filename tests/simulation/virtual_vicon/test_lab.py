"""The lab's virtual Vicon sees the lab's vehicle."""

import math
import socket

import pytest
from waiting import PATIENCE, until

from cfplan.flight.mocap.pose_check import Verdict
from cfplan.flight.mocap.source import pose_source
from cfplan.flight.radio.crtp import NULL_PACKET
from cfplan.safety.limits import PoseLimits
from cfplan.simulation.lab.lab import start_lab
from cfplan.simulation.lab.room import RoomSettings
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_vicon.cameras import ViconSettings
from cfplan.simulation.virtual_vicon.faults import FaultKind, ViconFault
from cfplan.vehicle.airframes import load_airframe

pytestmark = pytest.mark.integration

LIMITS = PoseLimits(
    rate=100.0, rate_min=80.0, latency=0.01, age_warning=0.05, age_brake=0.15, age_land=0.5, jump=0.15,
    agreement=0.05, yaw_agreement=0.17,
)  # fmt: skip


@pytest.fixture(scope="module")
def lab():
    room, beside = RoomSettings(ViconSettings(rate=200.0)), {"cf2": VehicleSettings(position=(0.5, 1.0, 0.0))}
    with start_lab(load_airframe("crazyflie-2.1+"), room=room, companions=beside, number=7) as lab:
        yield lab


@pytest.mark.parametrize(("system", "vehicle"), [("vicon", 0), ("vicon-sdk", 0), ("vicon", 1)])
def test_poses_are_of_the_vehicle_that_stands_there(lab, system, vehicle):
    uri = lab.mocap_uri.replace("vicon:", f"{system}:").replace("cf1", ("cf1", "cf2")[vehicle])
    source, found = pose_source(uri, LIMITS, open_within=PATIENCE), []
    source.open()
    try:
        assert until(lambda: len(found) >= 50 or found.extend(source.poses()))
    finally:
        source.close()
    truth = lab.truth(vehicle)
    assert truth.position[-1] == pytest.approx(((0.0, 0.0, 0.0), (0.5, 1.0, 0.0))[vehicle], abs=1e-3)
    where = [math.fsum(pose.position[axis] for pose in found) / len(found) for axis in range(3)]
    assert math.dist(where, truth.position[-1]) < 0.001  # the mean of 50 with a millimetre of noise


def test_each_vehicle_answers_at_a_port_of_its_own(lab):
    first, second = lab.ports
    assert second != first
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.settimeout(PATIENCE)
        for port in (first, second):
            client.sendto(NULL_PACKET, ("127.0.0.1", port))
            assert client.recvfrom(64)[1][1] == port


def test_what_goes_wrong_is_told_to_the_running_lab(lab):
    source = pose_source(lab.mocap_uri, LIMITS, open_within=PATIENCE)
    source.open()
    try:
        lab.disturb(ViconFault(FaultKind.OCCLUDE, duration=0.5))
        assert until(lambda: source.poses() is not None and source.fault == Verdict.OCCLUDED)
        assert until(lambda: source.poses())
        assert source.fault == ""
    finally:
        source.close()
