"""The lab's virtual Vicon sees the lab's vehicle."""

import math
import time

import pytest

from cfplan.flight.mocap.source import pose_source
from cfplan.safety.limits import PoseLimits
from cfplan.simulation.lab.lab import start_lab
from cfplan.simulation.lab.room import RoomSettings
from cfplan.simulation.virtual_vicon.cameras import ViconSettings
from cfplan.simulation.virtual_vicon.faults import FaultKind, ViconFault
from cfplan.vehicle.airframes import load_airframe

pytestmark = pytest.mark.integration

LIMITS = PoseLimits(
    rate=100.0, rate_min=80.0, latency=0.01, age_warning=0.05, age_brake=0.15, age_land=0.5, jump=0.15,
    agreement=0.05, yaw_agreement=0.17,
)  # fmt: skip
PATIENCE = 60.0  # s of the computer's time, spent only where something never comes


@pytest.fixture(scope="module")
def lab():
    with start_lab(
        load_airframe("crazyflie-2.1+"), room=RoomSettings(vicon=ViconSettings(rate=200.0)), number=7
    ) as lab:
        yield lab


@pytest.mark.parametrize("system", ["vicon", "vicon-sdk"])
def test_poses_are_of_the_vehicle_that_stands_there(lab, system):
    source = pose_source(lab.mocap_uri.replace("vicon:", f"{system}:"), LIMITS)
    source.open()
    try:
        found, end = [], time.monotonic() + PATIENCE
        while len(found) < 50 and time.monotonic() < end:
            found += source.poses()
            time.sleep(0.005)
    finally:
        source.close()
    truth = lab.truth()
    where = [math.fsum(pose.position[axis] for pose in found) / len(found) for axis in range(3)]
    assert len(found) >= 50
    assert math.dist(where, truth.position[-1]) < 0.001  # the mean of 50 with a millimetre of noise


def test_what_goes_wrong_is_told_to_the_running_lab(lab):
    source = pose_source(lab.mocap_uri, LIMITS)
    source.open()
    try:
        lab.disturb(ViconFault(FaultKind.OCCLUDE, duration=0.5))
        end = time.monotonic() + PATIENCE
        while source.fault != "occluded" and time.monotonic() < end:
            source.poses()
            time.sleep(0.005)
        assert source.fault == "occluded"
        while not source.poses() and time.monotonic() < end:
            time.sleep(0.005)
        assert source.fault == ""
    finally:
        source.close()
