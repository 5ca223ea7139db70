"""A virtual lab in its own process, and cflib's link to it."""

import threading

import pytest
from cflib.crazyflie import Crazyflie
from cflib.crazyflie.syncCrazyflie import SyncCrazyflie
from waiting import PATIENCE, until

from cfplan.simulation.lab.lab import start_lab
from cfplan.simulation.lab.sim_driver import register_sim_driver
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.vehicle.airframes import AIRFRAMES

AIRFRAME = AIRFRAMES["crazyflie-2.1+"]


@pytest.fixture(scope="module")
def lab():
    """One lab for all that leave it whole."""
    register_sim_driver()
    with start_lab(AIRFRAME, vehicle=VehicleSettings(position=(0.5, -0.3, 0.0))) as running:
        yield running


@pytest.fixture
def doomed():
    """A lab for those that do not."""
    register_sim_driver()
    with start_lab(AIRFRAME, number=5) as running:
        yield running


@pytest.fixture
def doomed_link(doomed):
    """Give cflib's link to it, open, and an event that tells that it is lost."""
    lost, connected, cf = threading.Event(), threading.Event(), Crazyflie()
    cf.connection_lost.add_callback(lambda uri, why: lost.set())
    cf.connected.add_callback(lambda uri: connected.set())
    cf.open_link(doomed.uri)
    assert connected.wait(PATIENCE)
    yield cf, lost
    cf.close_link()


@pytest.fixture
def link(lab):
    with SyncCrazyflie(lab.uri, cf=Crazyflie()) as sync:
        sync.wait_for_params()
        yield sync.cf


@pytest.fixture
def set_and_read_back(link):
    """A function that sets a parameter and waits for the vehicle to say that it has it."""

    def act(name, value):
        link.param.set_value(name, value)
        assert until(lambda: abs(float(link.param.get_value(name)) - value) <= 1e-6 * max(1.0, abs(value)))

    return act
