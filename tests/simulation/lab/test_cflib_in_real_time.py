"""Unmodified cflib flies the virtual Crazyflie in real time."""

import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cflib.crazyflie.mem import MemoryElement, Poly4D
from cflib.crtp.crtpstack import CRTPPort
from waiting import PATIENCE, until

from cfplan.flight.mocap.source import pose_source
from cfplan.flight.on_board.certified_pieces import certified_compressed, certified_pieces
from cfplan.geometry.path_file import path_through
from cfplan.geometry.polynomial_csv import polynomial_rows
from cfplan.planning.plan import plan
from cfplan.safety.limits_file import load_limits
from cfplan.vehicle.airframes import AIRFRAMES

pytestmark = [pytest.mark.integration, pytest.mark.slow]
AIRFRAME = AIRFRAMES["crazyflie-2.1+"]
SAFETY_FILE = Path(__file__).parents[3] / "safety.yaml"


class PoseFeed(threading.Thread):
    """What a pilot does with poses, in short."""

    def __init__(self, cf, mocap_uri):
        super().__init__(daemon=True)
        self.cf, self.stop = cf, threading.Event()
        self.source = pose_source(mocap_uri, load_limits(SAFETY_FILE).pose, open_within=PATIENCE)
        self.source.open()
        self.start_position = self.source.poses()[-1].position
        self.latest = None

    def run(self):
        while not self.stop.wait(0.004):
            for pose in self.source.poses():
                self.latest = pose
                self.cf.loc.send_extpose(pose.position, pose.quaternion)
        self.source.close()


def prepare(cf, feed, set_and_read_back):
    cf.commander.send_notify_setpoint_stop()
    for name, value in (
        ("stabilizer.controller", 2),
        ("stabilizer.estimator", 2),
        ("ctrlMel.mass", AIRFRAME.mass),
        ("locSrv.extPosStdDev", 0.003),
        ("locSrv.extQuatStdDev", 0.01),
        ("kalman.dragB_x", AIRFRAME.drag[0] / AIRFRAME.mass),
        ("kalman.dragB_y", AIRFRAME.drag[0] / AIRFRAME.mass),
    ):
        set_and_read_back(name, value)
    feed.start()
    for axis, value in zip("XYZ", feed.start_position, strict=True):
        cf.param.set_value(f"kalman.initial{axis}", value)
    cf.param.set_value("kalman.resetEstimation", 1)
    time.sleep(0.7)


def takes_off(cf):
    cf.high_level_commander.takeoff(0.8, 1.5, yaw=None)
    time.sleep(2.0)


def lands(cf, feed):
    cf.high_level_commander.land(0.0, 1.5, yaw=None)
    assert until(lambda: not cf.supervisor.is_flying)
    feed.stop.set()
    feed.join()


def streams(lab, cf, feed):
    """Take off, go to, stream, hand back, land."""
    commander, planner, started = cf.commander, cf.high_level_commander, time.monotonic()
    takes_off(cf)
    planner.go_to(0.0, 0.0, 1.0, 0.0, 1.5)
    time.sleep(2.0)
    begun = time.monotonic()
    radius, rate = 0.4, 1.5
    for step in range(300):
        time.sleep(max(0.0, begun + step * 0.01 - time.monotonic()))
        angle = rate * max(0.0, (time.monotonic() - begun))
        ramp = min(angle / 3.0, 1.0)
        place = [radius * ramp * np.sin(angle), 0.0, 1.0]
        commander.send_full_state_setpoint(place, [0, 0, 0], [0, 0, 0], [0, 0, 0, 1], 0, 0, 0)
    x, y, z = feed.latest.position
    planner.go_to(x, y, z, 0.0, 1.0)
    commander.send_notify_setpoint_stop()
    time.sleep(1.2)
    lands(cf, feed)

    truth = lab.truth()
    begun_at = np.searchsorted(truth.time, started)
    assert truth.position[-1, 2] == 0.0
    assert truth.position[begun_at:, 2].max() == pytest.approx(1.0, abs=0.1)
    assert np.abs(truth.position[begun_at:, 0]).max() < 0.8
    assert truth.off_in_air[-1] == truth.off_in_air[begun_at]
    assert np.allclose(np.diff(truth.time[begun_at:]), 0.01, atol=1e-6)


class Packed:
    """Bytes for cflib's memory of trajectories, which asks its elements for them."""

    def __init__(self, content):
        self.content = content

    def pack(self):
        return bytearray(self.content)


def packed(made):
    return [Packed(made.memory)]


def from_csv(made):
    """Pieces of cflib's own, from a CSV as Crazyswarm reads it, and as cflib's autonomous_sequence_high_level has."""
    text = polynomial_rows(made.pieces.durations, made.pieces.coefficients)
    rows = np.loadtxt(text.splitlines(), delimiter=",", skiprows=1, usecols=range(33), ndmin=2)
    return [Poly4D(row[0], *(Poly4D.Poly(row[k : k + 8]) for k in range(1, 33, 8))) for row in rows]


def uploads(make, elements=packed):
    """Upload a plan, and let the vehicle fly it by itself."""
    limits = load_limits(SAFETY_FILE)
    gentle = replace(limits.plan, angular_acceleration=0.57 * limits.plan.angular_acceleration)
    path = path_through([[-0.8, -0.8, 0.7], [0.2, 0.4, 1.1], [1.0, -0.6, 0.9]]).path
    made = make(plan(path, limits.airframe, replace(limits, plan=gentle)).trajectory, limits)

    def fly(lab, cf, feed):
        (memory,) = cf.mem.get_mems(MemoryElement.TYPE_TRAJ)
        memory.trajectory = elements(made)
        assert memory.write_data_sync()
        planner = cf.high_level_commander
        planner.define_trajectory(1, 0, len(made.pieces.durations), int(made.compressed))
        takes_off(cf)
        x, y, z, yaw = (float(value) for value in made.pieces.coefficients[0, :, 0])
        planner.go_to(x, y, z, yaw, 3.0)
        time.sleep(4.5)
        begun = time.monotonic()
        planner.start_trajectory(1)
        time.sleep(made.duration + 0.5)
        lands(cf, feed)

        truth = lab.truth()
        offsets = []
        for late in np.arange(0.0, 0.2, 0.01):  # until the command took effect
            here = (truth.time >= begun + late) & (truth.time < begun + late + made.duration)
            wanted = made.reference.plan_at(truth.time[here] - begun - late)[:, 0, :3]
            offsets.append(np.linalg.norm(truth.position[here] - wanted, axis=1).max())
        assert min(offsets) < 0.05

    return fly


@pytest.mark.parametrize(
    ("make_flight", "commands"),
    [
        pytest.param(lambda: streams, 4, id="by setpoints"),
        pytest.param(lambda: uploads(certified_pieces), 5, id="by polynomials"),
        pytest.param(lambda: uploads(certified_compressed), 5, id="by compressed polynomials"),
        pytest.param(lambda: uploads(certified_pieces, from_csv), 5, id="by a CSV of Crazyswarm's"),
    ],
)
def test_cflib_flies_the_virtual_crazyflie(lab, link, set_and_read_back, make_flight, commands):
    flight, codes = make_flight(), []
    assert until(lambda: link.supervisor.can_fly)  # some seconds after the flight before
    link.add_port_callback(CRTPPort.SETPOINT_HL, lambda packet: codes.append(packet.data[3]))
    feed = PoseFeed(link, lab.mocap_uri)
    prepare(link, feed, set_and_read_back)
    flight(lab, link, feed)
    assert codes == [0] * commands
    assert not lab.truth().locked
