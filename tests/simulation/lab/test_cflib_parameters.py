"""The pilot's link by a driver of cflib, to a virtual Crazyflie in one process: parameters, setpoints of others."""

import queue
import struct
import threading

import pytest
from cflib import crtp
from cflib.crtp.crtpdriver import CRTPDriver
from cflib.crtp.crtpstack import CRTPPacket
from cflib.crtp.exceptions import WrongUriType
from waiting import PATIENCE, a_moment, until

from cfplan.errors import LinkError
from cfplan.flight.pilot.vehicle_rules import PARAMETER_RULES
from cfplan.flight.radio.connection import connect
from cfplan.flight.radio.crtp import Port, pack
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_crazyflie.vehicle import VirtualCrazyflie
from cfplan.vehicle.airframes import AIRFRAMES

_STEP = 10  # ms of the vehicle's time at each look for a packet
NAMES = [rule.name for rule in PARAMETER_RULES]


class DirectDriver(CRTPDriver):
    """A driver without a medium; the vehicle's time goes on when the link looks for a packet and none is there."""

    needs_resending = False
    vehicle: VirtualCrazyflie
    silent = False
    guest = b""  # a packet that another client sends at each step: by the vehicle's time, which goes faster than ours
    null = pack(Port.LINK, 3, b"")  # sent at each step: pings are too rare by that time to keep the connection

    def connect(self, uri, statistics, error):
        if not uri.startswith("direct://"):
            raise WrongUriType("not mine")
        self._lock, self._came = threading.Lock(), queue.SimpleQueue()

    def send_packet(self, packet):
        with self._lock:
            if not self.silent:
                self.vehicle.receive(bytes((packet.header,)) + bytes(packet.data))
            self._collect()

    def receive_packet(self, wait=0):
        with self._lock:
            if self._came.empty():
                self.vehicle.receive(self.guest or self.null)
                self.vehicle.advance(_STEP)
                self._collect()
        try:
            datagram = self._came.get_nowait()
        except queue.Empty:
            a_moment(0.001)
            return None
        return CRTPPacket(datagram[0], datagram[1:])

    def _collect(self):
        for datagram in self.vehicle.sent():
            self._came.put(datagram)

    def close(self):
        pass


def open_link(**settings):
    """Connect to a vehicle with these settings; give the link and its driver."""
    vehicle = VirtualCrazyflie(AIRFRAMES["crazyflie-2.1+"], VehicleSettings(**settings))
    vehicle.advance(_STEP)  # compiles if need be, for which nothing waits
    driver = type("Driver", (DirectDriver,), {"vehicle": vehicle})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(crtp, "CLASSES", [driver])
        link = connect("direct://0", lambda message: None, [driver], patience=PATIENCE)
        yield link, driver
        driver.silent = False
        link.close()


@pytest.fixture(scope="module")
def newest():
    yield from open_link(firmware="2026.08")


@pytest.fixture(scope="module")
def older():
    yield from open_link(firmware="2025.09.1", protocol=10)


def test_every_parameter_of_the_table_is_read(newest):
    link, driver = newest
    on_board = {name: driver.vehicle.firmware.parameters[name] for name in NAMES}
    assert link.read_parameters(NAMES, PATIENCE) == pytest.approx(on_board)


def test_what_an_older_firmware_lacks_is_left_out(older):
    link, _ = older
    lacking = {"kalman.dragB_x", "kalman.dragB_y", "supervisor.crashDetectGs"}
    assert set(NAMES) - set(link.read_parameters(NAMES, PATIENCE)) == lacking
    assert not link.has_log_variable("ctrltarget.mode_roll")


def test_a_value_is_the_vehicles_of_now_not_that_of_connecting(newest):
    link, driver = newest
    assert link.read_parameters(["colAv.enable"], PATIENCE) == {"colAv.enable": 0}
    driver.vehicle.firmware.parameters["colAv.enable"] = 1
    assert link.read_parameters(["colAv.enable"], PATIENCE) == {"colAv.enable": 1}


def test_a_vehicle_that_falls_silent_is_an_error(newest):
    link, driver = newest
    driver.silent = True
    with pytest.raises(LinkError, match=r"no answer to reading colAv\.enable"):
        link.read_parameters(["colAv.enable"], patience=0.1)
    driver.silent = False


@pytest.mark.parametrize("vehicle", ["newest", "older"])
def test_a_setpoint_of_another_client_is_seen_and_its_end_too(request, vehicle):
    link, driver = request.getfixturevalue(vehicle)
    link.start_logs()
    assert until(lambda: link.status is not None)
    assert not link.has_setpoint
    driver.guest = pack(Port.SETPOINT, 0, struct.pack("<Bffff", 7, 0.5, 0.5, 0.4, 0.0))
    assert until(lambda: link.has_setpoint)
    driver.guest = b""
    link.release_priority()
    assert until(lambda: not link.has_setpoint)
    link.stop_preflight_logs()
