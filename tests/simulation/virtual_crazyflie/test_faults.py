"""Faults of the vehicle, and firmware that is not the newest."""

import struct

import numpy as np
import pytest

from cfplan.flight.radio.crtp import Port
from cfplan.simulation.virtual_crazyflie.battery import Battery
from cfplan.simulation.virtual_crazyflie.faults import VehicleFault, VehicleFaultKind
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_crazyflie.supervisor import State
from tests.simulation.virtual_crazyflie.conftest import Rig

HOVER, TAKE_OFF = 0.5, 7


def set_parameter(rig, name, value):
    parameters = rig.vehicle.firmware.parameters
    number = parameters.toc.index()[name]
    layout = parameters.toc.variables[number].format
    return rig.send(Port.PARAMETERS, 2, struct.pack("<H", number) + struct.pack(layout, value))


@pytest.fixture
def hovering():
    """A rig whose vehicle hovers at half a metre under the Mellinger controller."""
    rig = Rig()
    set_parameter(rig, "stabilizer.estimator", 2)
    set_parameter(rig, "stabilizer.controller", 2)
    set_parameter(rig, "ctrlMel.mass", rig.airframe.mass)
    rig.run(1.0)
    rig.send(Port.HIGH_LEVEL, 0, bytes((TAKE_OFF,)) + struct.pack("<Bff?f", 0, HOVER, 0.0, True, 1.5))
    rig.run(3.0)
    assert rig.truth[2] == pytest.approx(HOVER, abs=0.05)
    return rig


def test_a_gust_pushes_along_y_and_passes(hovering):
    hovering.vehicle.inject(VehicleFault(VehicleFaultKind.GUST, 0.0, 0.5, 2.0))
    hovering.run(0.3)
    pushed = hovering.truth[1]
    assert pushed > 0.005
    hovering.run(3.0)
    assert abs(hovering.truth[1]) < pushed
    assert not hovering.vehicle.wind.any()


def test_more_mass_needs_more_thrust(hovering):
    before = hovering.truth[13:17].sum()
    hovering.vehicle.inject(VehicleFault(VehicleFaultKind.MASS, 0.0, size=1.2))
    hovering.run(4.0)
    assert hovering.truth[13:17].sum() / before == pytest.approx(1.2, abs=0.03)


def test_a_weak_motor_is_asked_for_more(hovering):
    hovering.vehicle.inject(VehicleFault(VehicleFaultKind.MOTOR, 0.0, size=0.8))
    hovering.run(2.0)
    motors = hovering.truth[13:17]
    assert motors[0] * 0.8 == pytest.approx(motors[1:].mean(), rel=0.1)


def test_a_tumble_turns_it_over_and_brings_it_down(hovering):
    hovering.vehicle.inject(VehicleFault(VehicleFaultKind.TUMBLE, 0.0, 0.4))
    upright, height = 1.0, HOVER
    for _ in range(100):
        hovering.run(0.01)
        x, y = hovering.truth[6:8]
        upright, height = min(upright, 1.0 - 2.0 * (x * x + y * y)), min(height, hovering.truth[2])
    assert upright < 0.0
    assert height < 0.02


def test_a_lock_stops_the_motors_for_good(hovering):
    hovering.vehicle.inject(VehicleFault(VehicleFaultKind.LOCK, 0.1, 0.1))
    hovering.run(1.0)
    assert hovering.state is State.LOCKED
    assert not hovering.vehicle.motors.any()


def test_a_battery_sags_to_the_voltage_named_and_comes_back(hovering):
    hovering.vehicle.inject(VehicleFault(VehicleFaultKind.BATTERY, 0.0, 1.0, 3.1))
    hovering.run(0.5)
    assert hovering.vehicle.battery.voltage == pytest.approx(3.1, abs=0.05)
    hovering.run(1.0)
    assert hovering.vehicle.battery.voltage > 3.5


@pytest.mark.parametrize(("voltage", "thrust"), [(3.0, 0.113), (3.066, 0.12), (3.7, 0.12)])
def test_motors_weaken_with_voltage_as_measured(voltage, thrust):
    battery = Battery()
    battery.voltage = voltage
    assert 0.12 * battery.strength == pytest.approx(thrust, abs=5e-4)


def test_a_stubborn_parameter_keeps_its_value():
    rig = Rig(VehicleSettings(stubborn=("stabilizer.controller",)))
    assert set_parameter(rig, "stabilizer.controller", 2)
    assert rig.vehicle.firmware.parameters["stabilizer.controller"] == 1


def test_a_slow_write_is_answered_after_its_delay():
    rig = Rig(VehicleSettings(parameter_delay=0.2))
    assert not set_parameter(rig, "stabilizer.controller", 2)
    rig.run(0.15)
    assert not [packet for packet in rig.received if packet[0] >> 4 == Port.PARAMETERS]
    rig.run(0.1)
    assert [packet for packet in rig.received if packet[0] >> 4 == Port.PARAMETERS]


def test_older_firmware_has_no_supervisor_port_and_no_drag():
    rig = Rig(VehicleSettings(protocol=10, firmware="2025.12"))
    assert not rig.send(Port.SUPERVISOR, 0, bytes((12,)))
    assert "kalman.dragB_x" not in rig.vehicle.firmware.parameters.toc.index()
    assert rig.send(Port.PLATFORM, 0, bytes((1, 1)))


@pytest.mark.parametrize(("firmware", "steady"), [("2025.09", False), ("2025.09.1", True)])
def test_before_2025_09_1_the_filter_goes_wrong_with_yaw_beyond_90_degrees(firmware, steady):
    rig = Rig(VehicleSettings(protocol=10, firmware=firmware, yaw=2.6))
    set_parameter(rig, "kalman.initialYaw", 2.6)
    set_parameter(rig, "stabilizer.estimator", 2)
    set_parameter(rig, "stabilizer.controller", 2)
    set_parameter(rig, "ctrlMel.mass", rig.airframe.mass)
    rig.run(1.0)
    rig.send(Port.HIGH_LEVEL, 0, bytes((TAKE_OFF,)) + struct.pack("<Bff?f", 0, HOVER, 0.0, True, 1.5))
    rig.run(4.0)
    off = np.linalg.norm(rig.truth[0:3] - [0.0, 0.0, HOVER])
    assert bool(off < 0.1) is steady
