"""The firmware's default controller, and the setpoints that only it understands."""

import struct

import numpy as np
import pytest

from cfplan.flight.radio.crtp import Port
from cfplan.simulation.virtual_crazyflie.supervisor import State


@pytest.fixture
def hovering(make_rig):
    """In the air under PID, as a vehicle is whose controller nobody chose."""
    rig = make_rig()
    rig.set("stabilizer.estimator", 2)
    rig.run(0.5)
    assert rig.take_off(0.8) == 0
    rig.run(6.0)
    return rig


def stream(rig, seconds, payload):
    rig.run(seconds, lambda tick: rig.send(Port.SETPOINT, 0, payload) if tick % 50 == 0 else None)


def test_it_holds_height_and_goes_where_it_is_sent(hovering):
    assert hovering.truth[2] == pytest.approx(0.8, abs=0.05)
    assert hovering.go_to(0.6, 0.4, 1.0, yaw=0.8, duration=3.0) == 0
    hovering.run(6.0)
    assert hovering.truth[:3] == pytest.approx([0.6, 0.4, 1.0], abs=0.06)
    assert 2 * np.arctan2(hovering.truth[8], hovering.truth[9]) == pytest.approx(0.8, abs=0.05)
    assert hovering.off_in_air == 0


def test_a_position_setpoint_is_approached_no_faster_than_the_limit(hovering):
    fastest = []
    payload = struct.pack("<Bffff", 7, 3.0, 0.0, 0.8, 0.0)

    def watch(tick):
        fastest.append(hovering.truth[3])
        if tick % 50 == 0:
            hovering.send(Port.SETPOINT, 0, payload)

    hovering.run(3.0, watch)
    assert 0.8 < max(fastest) < 1.3
    hovering.set("posCtlPid.xVelMax", 0.3)
    stream(hovering, 1.5, payload)
    assert hovering.truth[3] < 0.45


def test_a_hover_setpoint_moves_along_the_nose(hovering):
    hovering.go_to(*hovering.belief[:3], yaw=np.pi / 2, duration=2.0)
    hovering.run(3.0)
    before = hovering.truth[:3].copy()
    stream(hovering, 3.0, struct.pack("<Bffff", 10, 0.3, 0.0, 0.0, 0.8))
    moved = hovering.truth[:3] - before
    assert moved[1] > 0.5
    assert abs(moved[0]) < 0.15


def test_a_world_velocity_and_yaw_rate_are_followed(hovering):
    stream(hovering, 3.0, struct.pack("<Bffff", 8, 0.0, -0.4, 0.0, 40.0))
    assert hovering.truth[4] == pytest.approx(-0.4, abs=0.12)
    assert hovering.truth[12] == pytest.approx(np.radians(40.0), abs=0.1)


def test_an_attitude_setpoint_tilts_as_told(hovering):
    payload = struct.pack("<fffH", 0.0, 10.0, 0.0, 44000)  # pitch nose up, so it flies backwards
    hovering.send(Port.ATTITUDE_SETPOINT, 0, struct.pack("<fffH", 0.0, 0.0, 0.0, 0))
    hovering.run(0.6, lambda tick: hovering.send(Port.ATTITUDE_SETPOINT, 0, payload) if tick % 20 == 0 else None)
    x, y, z, w = hovering.truth[6:10]
    assert np.degrees(np.arcsin(2 * (w * y - x * z))) == pytest.approx(-10.0, abs=2.5)
    assert hovering.truth[3] < -0.2


def test_thrust_stays_locked_until_a_zero_has_come(rig):
    payload = struct.pack("<fffH", 0.0, 0.0, 0.0, 50000)
    rig.vehicle.firmware.commander.priority = 0
    rig.send(Port.ATTITUDE_SETPOINT, 0, payload)
    rig.run(0.1)
    assert not rig.vehicle.motors.any()
    rig.send(Port.ATTITUDE_SETPOINT, 0, struct.pack("<fffH", 0.0, 0.0, 0.0, 0))
    rig.send(Port.ATTITUDE_SETPOINT, 0, payload)
    rig.run(0.1)
    assert rig.vehicle.motors.all()


def test_levelling_out_keeps_height(hovering):
    stream(hovering, 1.0, struct.pack("<Bffff", 7, 0.5, 0.0, 0.8, 0.0))
    hovering.run(1.5)
    assert hovering.state is State.WARNING_LEVEL_OUT
    assert hovering.truth[2] == pytest.approx(0.8, abs=0.15)


def test_a_controller_that_is_not_simulated_leaves_pid_flying(hovering):
    hovering.set("stabilizer.controller", 5)
    hovering.run(1.0)
    assert hovering.vehicle.firmware.parameters["stabilizer.controller"] == 1
    assert hovering.truth[2] == pytest.approx(0.8, abs=0.3)
    assert any(b"not simulated" in packet for packet in hovering.received)
