"""What a dead radio holds: cflib's own driver thread, a dongle that is not there, and a vehicle that counts packets."""

import queue
import struct
from types import SimpleNamespace

import numpy as np
import pytest
from cflib.crtp.radiodriver import _RadioDriverThread
from waiting import until

from cfplan.flight.radio.connection import SerializedDriver
from cfplan.flight.radio.link import packet
from cfplan.flight.radio.perishable import KEEPS_FOR, empty_air, is_perishable
from cfplan.flight.setpoints.packets import FullStateSetpoints, encode

SETPOINT = encode(
    FullStateSetpoints(np.ones((1, 3)), *(np.zeros((1, 3)),) * 2, np.array([[0.0, 0.0, 0.0, 1.0]]), np.zeros((1, 3)))
)[0].tobytes()
TRANSMISSION = 0.001  # s


def pose(number: float):
    return packet(6, 1, struct.pack("<B7f", 8, number, 0, 0, 0, 0, 0, 1))


class Dongle:
    """Passes packets to a vehicle that has safelink; time is what transmissions take."""

    version = 0.6

    def __init__(self):
        self.now, self.dead, self.acknowledges = 0.0, False, True
        self.received: list[bytes] = []
        self._counter = 0
        self.tries = 0

    def send_packet(self, data):
        self.now += TRANSMISSION
        self.tries += 1
        got = bytes(data)
        if got == b"\xff\x05\x01":  # safelink begins
            return SimpleNamespace(ack=True, data=got)
        if self.dead:
            return SimpleNamespace(ack=False, data=b"")
        if got[0] >> 3 & 1 == self._counter:  # else it is a repetition
            self._counter = 1 - self._counter
            if got[0] & 0xF3 != 0xF3:
                self.received.append(got)
        return SimpleNamespace(ack=self.acknowledges, data=b"")


@pytest.fixture
def dongle():
    return Dongle()


class CflibDriver:
    """cflib's driver of a dongle that is there already."""

    needs_resending = False

    def __init__(self, dongle: Dongle):
        self.out_queue = queue.Queue(1)
        self._thread = _RadioDriverThread(
            dongle, queue.Queue(), self.out_queue, lambda _: None, lambda _: None, self, None
        )
        self._thread._radio_link_statistics = SimpleNamespace(update=lambda *_: None)
        self.start, self.stop = self._thread.start, self._thread.stop


@pytest.fixture
def cflibs_driver(dongle):
    driver = CflibDriver(dongle)
    empty_air(driver, lambda: dongle.now)
    driver.start()
    yield driver
    driver.stop()


@pytest.fixture
def driver(cflibs_driver, dongle):
    return SerializedDriver(cflibs_driver, SimpleNamespace(now=lambda: dongle.now))


def wait(dongle, seconds: float) -> None:
    end = dongle.now + seconds
    assert until(lambda: dongle.now > end)


def wait_for(dongle, count: int) -> None:
    assert until(lambda: len(dongle.received) >= count)


def numbers(dongle) -> list[float]:
    return [struct.unpack_from("<f", got, 2)[0] for got in dongle.received if got[0] >> 4 == 6]


def test_a_good_radio_passes_everything_on(dongle, driver):
    for number in range(20):
        driver.send_soon(pose(number))
        wait_for(dongle, number + 1)
    assert numbers(dongle) == list(range(20))


def test_what_a_dead_radio_held_does_not_come_when_it_returns(dongle, driver):
    dongle.dead = True
    for number in range(40):  # one in the air, one in the queue; the others find no room
        driver.send_soon(pose(number))
        wait(dongle, 0.01)
    assert driver.out_queue.full()
    dongle.dead = False
    assert until(lambda: dongle.received)
    wait(dongle, 0.1)
    (held,) = numbers(dongle)
    assert held >= 40 - KEEPS_FOR / 0.01 - 1


def test_a_ping_of_cflibs_own_is_dropped_by_a_radio_that_is_dead_for_long_and_ends_no_link(
    dongle, driver, cflibs_driver
):
    ended = []
    cflibs_driver.link_error_callback = ended.append
    dongle.dead = True
    driver.send_soon(packet(9, 1, b"\x04"))
    wait(dongle, 0.05)
    driver.send_soon(packet(9, 1, b"\x04"))  # fills the queue
    driver.send_packet(packet(15, 0, b"ping"))
    assert not ended


def test_an_order_to_cut_the_motors_does_not_perish(dongle, driver):
    dongle.dead = True
    driver.send_soon(packet(9, 1, b"\x03"))
    wait(dongle, 0.2)
    driver.send_soon(packet(7, 0, b"\0"))  # stop the motors
    for number in range(20):
        driver.send_soon(pose(number))
        wait(dongle, 0.01)
    dongle.dead = False
    assert until(lambda: len(dongle.received) == 2)
    assert [got[1:] for got in dongle.received] == [b"\x03", b"\0"]


def test_a_packet_whose_acknowledgement_was_lost_is_neither_lost_nor_doubled(dongle, driver):
    dongle.acknowledges = False
    driver.send_soon(pose(1))
    assert until(lambda: dongle.received)
    wait(dongle, 0.2)
    dongle.acknowledges = True
    for number in (2, 3):
        driver.send_soon(pose(number))
        wait_for(dongle, number)
    assert numbers(dongle) == [1, 2, 3]


@pytest.mark.parametrize(
    ("sent", "perishable"),
    [
        (pose(1), True),
        (packet(7, 0, SETPOINT), True),
        (packet(7, 0, b"\0"), False),  # stop
        (packet(7, 1, bytes(5)), False),  # release priority
        (packet(6, 1, b"\x03"), False),  # emergency stop of older firmware
        (packet(9, 1, b"\x01\x00"), False),  # disarm
        (packet(2, 2, b"\x08\x00\x01"), False),  # a parameter
        (packet(15, 3, b""), False),  # nothing
    ],
)
def test_setpoints_and_poses_perish_and_nothing_else(sent, perishable):
    assert is_perishable(sent.header, bytes(sent.data)) is perishable
