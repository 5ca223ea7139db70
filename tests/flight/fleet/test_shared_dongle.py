"""Tests of vehicles that share a simulated Crazyradio: the packets of each arrive in time."""

import struct

import numpy as np
import pytest
from inline_crazyradio import NULL, InlineCrazyradio, RadioVehicle, unmarked

from cfplan.errors import LinkError
from cfplan.flight.clock import SteppedClock
from cfplan.flight.fleet.inline_radio import InlineRadio, RadioAddress
from cfplan.flight.fleet.shared_dongle import PACE, RADIO_DEAD_AFTER, SharedDongle, SharedVehicle
from cfplan.flight.radio.connection import FIRST_ANSWER_TIMEOUT
from cfplan.flight.radio.crtp import Port, pack
from cfplan.flight.radio.dongle import DEAD_AFTER
from cfplan.flight.radio.perishable import MAX_AGE
from cfplan.flight.setpoints.packets import FullStateSetpoints, encode

pytestmark = pytest.mark.unit

TICK = 0.01  # s
STOP = pack(Port.SETPOINT, 0, b"\0")
CUT = pack(Port.SUPERVISOR, 1, b"\x03")


def setpoint(number: int) -> bytes:
    """Return a setpoint packet with x = `number` mm."""
    position = np.array([[1e-3 * number, 0.0, 1.0]])
    level = np.array([[0.0, 0.0, 0.0, 1.0]])
    still = np.zeros((1, 3))
    return pack(Port.SETPOINT, 0, encode(FullStateSetpoints(position, still, still, level, still))[0].tobytes())


def pose(number: int) -> bytes:
    return pack(Port.LOCALIZATION, 1, struct.pack("<B7f", 8, number, 0, 0, 0, 0, 0, 1))


def numbered(number: int) -> bytes:
    return pack(Port.PARAMETERS, 2, struct.pack("<H", number))


class Shared:
    """A shared dongle on a stepped clock, and what the pilot of each vehicle sends and hears."""

    def __init__(self, *vehicles: RadioVehicle):
        self.clock = SteppedClock()
        self.usb = InlineCrazyradio(dict(enumerate(vehicles)), self.clock.sleep)
        self.radios = vehicles
        self.heard: list[list[bytes]] = [[] for _ in vehicles]
        self.failures: list[list[str]] = [[] for _ in vehicles]
        self.links = [
            SharedVehicle(RadioAddress(80, 2, (0xE7, 0xE7, 0xE7, 0xE7, n)), heard.append, failures.append)
            for n, (heard, failures) in enumerate(zip(self.heard, self.failures, strict=True))
        ]
        self.dongle = SharedDongle(InlineRadio(self.usb), self.links, self.clock)
        for link in self.links:
            link.begin(self.clock.now())

    def put(self, number: int, packet: bytes) -> None:
        self.links[number].put(packet, self.clock.now())

    def run(self, duration: float) -> None:
        """Serve the vehicles for `duration`, s."""
        end = self.clock.now() + duration
        while self.clock.now() < end:
            self.clock.sleep(min(self.dongle.serve(), max(end - self.clock.now(), 0.0)))

    def fly(self, ticks: int) -> None:
        """Send each vehicle a setpoint and a pose at every tick; each vehicle that is on sends two packets."""
        began = self.clock.now()
        for tick in range(ticks):
            for number, radio in enumerate(self.radios):
                self.put(number, setpoint(tick))
                self.put(number, pose(tick))
                if not radio.off:
                    radio.to_send.extend((numbered(2 * tick), numbered(2 * tick + 1)))
            self.run(max(began + (tick + 1) * TICK - self.clock.now(), 0.0))

    def got(self, number: int, port: Port) -> list[float]:
        """Return the numbers of the setpoints or poses that a vehicle has received."""
        packets = [packet for packet in self.radios[number].received if packet[0] >> 4 == port]
        if port is Port.SETPOINT:
            return [struct.unpack_from("<h", packet, 2)[0] for packet in packets]
        return [struct.unpack_from("<f", packet, 2)[0] for packet in packets]


def test_each_frame_goes_out_on_the_channel_the_rate_and_the_address_of_its_vehicle():
    usb = InlineCrazyradio({}, lambda duration: None)
    radio = InlineRadio(usb)
    radio.exchange(RadioAddress(80, 2, (0xE7, 0xE7, 0xE7, 0xE7, 1)), NULL)
    radio.exchange(RadioAddress(10, 1, (1, 2, 3, 4, 5)), NULL)
    assert usb.headers == [b"\x09\x12\x50\xe7\xe7\xe7\xe7\x01", b"\x09\x11\x0a\x01\x02\x03\x04\x05"]


def test_over_a_lossy_radio_each_packet_arrives_once_and_in_order_both_ways():
    shared = Shared(*(RadioVehicle(loss=0.3) for _ in range(3)))
    for number in range(60):
        for vehicle, radio in enumerate(shared.radios):
            shared.put(vehicle, numbered(100 * vehicle + number))
            radio.to_send.append(numbered(1000 + 100 * vehicle + number))
        shared.run(0.1)
    for vehicle, radio in enumerate(shared.radios):
        assert radio.received == [numbered(100 * vehicle + number) for number in range(60)]
        heard = [unmarked(packet) for packet in shared.heard[vehicle]]
        assert heard == [numbered(1000 + 100 * vehicle + number) for number in range(60)]


def test_four_vehicles_get_each_setpoint_and_each_pose():
    shared = Shared(*(RadioVehicle() for _ in range(4)))
    shared.fly(200)
    shared.run(TICK)
    for vehicle in range(4):
        assert shared.got(vehicle, Port.SETPOINT) == list(range(200))
        assert shared.got(vehicle, Port.LOCALIZATION) == list(range(200))
        assert len(shared.heard[vehicle]) > 390


def test_vehicles_share_a_slow_radio_fairly():
    shared = Shared(*(RadioVehicle() for _ in range(4)))
    shared.usb.air_time = 0.002  # s; there is time for about half of the packets
    shared.fly(200)
    counts = [len(radio.received) for radio in shared.radios]
    assert max(counts) < 350  # of 400
    assert min(counts) > 0.95 * max(counts)
    for vehicle in range(4):
        assert len(shared.got(vehicle, Port.SETPOINT)) == pytest.approx(counts[vehicle] / 2, rel=0.2)


def test_a_vehicle_that_is_off_costs_the_others_no_packet():
    shared = Shared(*(RadioVehicle() for _ in range(4)))
    shared.run(0.1)
    shared.radios[0].off = True
    shared.fly(200)
    shared.run(TICK)
    for vehicle in (1, 2, 3):
        assert shared.got(vehicle, Port.SETPOINT) == list(range(200))
        assert shared.got(vehicle, Port.LOCALIZATION) == list(range(200))


def test_a_vehicle_that_was_off_gets_an_order_to_cut_but_no_expired_setpoint_or_pose():
    shared = Shared(RadioVehicle(), RadioVehicle())
    shared.run(0.1)
    shared.radios[0].off = True
    shared.put(0, CUT)
    shared.fly(100)
    shared.radios[0].off = False
    shared.run(0.1)
    assert shared.radios[0].received[0] == CUT
    oldest = 100 - MAX_AGE / TICK - 1
    assert all(number >= oldest for number in shared.got(0, Port.SETPOINT) + shared.got(0, Port.LOCALIZATION))
    assert len(shared.radios[0].received) <= 3


def test_a_packet_that_expires_on_its_way_to_the_dongle_is_not_transmitted():
    shared = Shared(RadioVehicle())
    shared.run(0.1)
    shared.links[0].put(pose(1), shared.clock.now() - 2.0 * MAX_AGE)
    shared.run(0.1)
    assert not shared.radios[0].received


def test_an_order_to_stop_comes_before_a_newer_setpoint_which_replaces_the_older_one():
    shared = Shared(RadioVehicle())
    shared.run(0.1)
    for packet in (setpoint(1), STOP, setpoint(2)):
        shared.put(0, packet)
    shared.run(0.1)
    assert shared.radios[0].received == [STOP, setpoint(2)]


def test_packets_to_a_vehicle_are_paced():
    shared = Shared(RadioVehicle())
    shared.run(0.1)
    for number in range(10):
        shared.put(0, numbered(number))
    shared.run(5.0 * PACE)
    assert len(shared.radios[0].received) <= 6
    shared.run(0.1)
    assert len(shared.radios[0].received) == 10


def test_a_vehicle_without_safelink_gets_each_packet_too():
    shared = Shared(RadioVehicle(safelink=False), RadioVehicle())
    for number in range(20):
        for vehicle in (0, 1):
            shared.put(vehicle, numbered(number))
        shared.run(0.05)
    for radio in shared.radios:
        assert [packet for packet in radio.received if packet[1:] != b"\x05\x01"] == list(map(numbered, range(20)))


def test_a_vehicle_that_is_switched_on_late_is_asked_for_safelink_then():
    shared = Shared(RadioVehicle(loss=0.3))
    shared.radios[0].off = True
    shared.run(1.0)
    shared.radios[0].off = False
    shared.run(0.5)
    for number in range(20):
        shared.put(0, numbered(number))
        shared.run(0.1)
    assert shared.radios[0].received == [numbered(number) for number in range(20)]


def test_a_vehicle_that_is_off_for_long_is_lost_and_the_others_are_not():
    shared = Shared(RadioVehicle(), RadioVehicle())
    shared.run(0.1)
    shared.radios[0].off = True
    shared.run(DEAD_AFTER - 0.5)
    assert not shared.failures[0]
    shared.run(1.0)
    assert len(shared.failures[0]) == 1
    assert "acknowledges nothing" in shared.failures[0][0]
    assert not shared.failures[1]


def test_a_vehicle_that_never_answers_is_reported_before_its_pilot_gives_up():
    shared = Shared(RadioVehicle(), RadioVehicle())
    shared.radios[0].off = True
    shared.run(FIRST_ANSWER_TIMEOUT - 0.5)
    assert "is it on" in shared.failures[0][0]
    assert not shared.failures[1]


def test_an_answer_that_comes_late_is_not_taken_for_that_of_another_vehicle():
    shared = Shared(RadioVehicle(), RadioVehicle())
    shared.run(0.1)
    for _ in range(20):
        shared.radios[0].to_send.append(numbered(0))
        shared.radios[1].to_send.append(numbered(1))
        shared.usb.late = True
        shared.run(0.2)
    for vehicle in (0, 1):
        assert {unmarked(packet) for packet in shared.heard[vehicle]} == {numbered(vehicle)}


def test_an_answer_that_is_cut_short_counts_as_none():
    shared = Shared(RadioVehicle(), RadioVehicle())
    shared.run(0.1)
    shared.usb.short = True
    shared.put(0, numbered(0))
    shared.run(0.1)
    assert not shared.usb.short
    assert shared.failures == [[], []]
    assert numbered(0) in [unmarked(packet) for packet in shared.radios[0].received]


def test_a_radio_that_does_not_report_for_long_is_given_up():
    shared = Shared(RadioVehicle(), RadioVehicle())
    shared.run(0.1)
    shared.usb.broken = True
    began = shared.clock.now()
    with pytest.raises(LinkError, match="does not answer"):
        shared.run(10.0)
    assert shared.clock.now() - began == pytest.approx(RADIO_DEAD_AFTER, abs=0.2)


def test_a_plain_link_hears_empty_acknowledgements_too():
    """cflib restarts a vehicle by packets that its radio acknowledges while its main processor is off."""
    shared = Shared(RadioVehicle())
    shared.links[0].begin(shared.clock.now(), safelink=False)
    shared.put(0, b"\xff\xfe\x02")
    shared.run(0.01)
    assert shared.radios[0].received == [b"\xff\xfe\x02"]
    assert shared.heard[0][0] == NULL
