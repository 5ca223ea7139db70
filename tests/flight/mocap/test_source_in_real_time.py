"""Poses by the driver's process in real time: how well they are dated."""

import math
import time

import pytest

from cfplan.flight.mocap.source import pose_source
from cfplan.safety.limits import PoseLimits
from cfplan.simulation.virtual_vicon.cameras import ViconSettings
from cfplan.simulation.virtual_vicon.vicon import serve

pytestmark = pytest.mark.slow

LIMITS = PoseLimits(
    rate=100.0, rate_min=80.0, latency=0.01, age_warning=0.05, age_brake=0.15, age_land=0.5, jump=0.15,
    agreement=0.05, yaw_agreement=0.17,
)  # fmt: skip


def flown(t):
    """A circle at 1 m/s, nose along x."""
    return (math.cos(t), math.sin(t), 1.0), (0.0, 0.0, 0.0, 1.0)


@pytest.mark.parametrize("system", ["vicon", "vicon-sdk"])
def test_poses_are_where_and_when_the_body_was(system):
    with serve(ViconSettings(position_noise=0, attitude_noise=0), flown) as vicon:
        source, poses = pose_source(vicon.uri_of("cf1", system), LIMITS), []
        source.open()
        end = time.monotonic() + 0.7
        while time.monotonic() < end:
            poses += source.poses()
            time.sleep(0.005)
        source.close()
        assert len(poses) > 40
        # Where the body was at a pose's date, to what a late wake-up of a process costs at 1 m/s; most are on time.
        off = sorted(math.dist(pose.position, flown(pose.time - vicon.start)[0]) for pose in poses)
        assert off[len(off) // 2] < 0.01
