"""A restart by radio: it ends a lock, forgets what was set, and leaves the body where it is."""

import numpy as np

from cfplan.flight.radio.crtp import Port
from cfplan.flight.radio.restart import POWER, POWER_CHANNEL, SYSTEM_OFF, SYSTEM_ON
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_crazyflie.supervisor import State


def switch(rig, command: int) -> list[bytes]:
    return rig.send(Port.LINK, POWER_CHANNEL, bytes((POWER, command)))


def test_a_restart_ends_a_lock_and_nothing_answers_meanwhile(make_rig):
    rig = make_rig(VehicleSettings(position=(0.4, -0.3, 0.0), yaw=0.5, auto_arming=False))
    rig.run(0.5)
    rig.vehicle.firmware.parameters["stabilizer.controller"] = 2
    rig.vehicle.firmware.supervisor.emergency_stop()
    rig.run(0.2)
    assert rig.state is State.LOCKED
    place = rig.truth.copy()

    assert switch(rig, SYSTEM_OFF)
    rig.run(1.0)
    assert not rig.send(Port.LINK, 0, b"ping")
    assert switch(rig, SYSTEM_ON)
    assert not rig.send(Port.LINK, 0, b"ping")
    rig.run(2.5)
    assert rig.send(Port.LINK, 0, b"ping")
    assert rig.state is State.CHECKS_PASSED
    assert rig.vehicle.firmware.parameters["stabilizer.controller"] == 1
    assert np.array_equal(rig.truth, place)


def test_without_power_on_it_stays_off(make_rig):
    rig = make_rig()
    switch(rig, SYSTEM_OFF)
    rig.run(10.0)
    assert not rig.send(Port.LINK, 0, b"ping")


def test_switched_off_in_the_air_it_falls(make_rig):
    rig = make_rig()
    rig.truth[2], rig.truth[13:17] = 1.0, rig.airframe.hover_thrust
    switch(rig, SYSTEM_OFF)
    rig.run(1.0)
    assert rig.truth[2] == 0.0
