"""The link by a Crazyradio that is not there, to a vehicle that counts packets; cflib's driver has the same vehicle."""

import math
import queue
import struct
import threading
from collections import deque
from types import SimpleNamespace

import numpy as np
import pytest
from cflib.crtp.crtpstack import CRTPPacket
from cflib.crtp.radiodriver import _RadioDriverThread
from waiting import PATIENCE, until

from cfplan.flight.on_board.commands import go_to, land, start
from cfplan.flight.radio.crtp import Port, pack
from cfplan.flight.radio.dongle import DEAD_AFTER, Dongle
from cfplan.flight.radio.perishable import MAX_AGE, is_perishable
from cfplan.flight.setpoints.packets import FullStateSetpoints, encode

SETPOINT = encode(
    FullStateSetpoints(np.ones((1, 3)), *(np.zeros((1, 3)),) * 2, np.array([[0.0, 0.0, 0.0, 1.0]]), np.zeros((1, 3)))
)[0].tobytes()
TRANSMISSION = 0.001  # s


def pose(number: float) -> bytes:
    return pack(Port.LOCALIZATION, 1, struct.pack("<B7f", 8, number, 0, 0, 0, 0, 0, 1))


def numbered(number: int) -> bytes:
    return pack(Port.PARAMETERS, 2, struct.pack("<H", number))


def unmarked(packet) -> bytes:
    """Return a packet without safelink's counters in its header."""
    return bytes((packet[0] & 0xF3, *packet[1:]))


class Crazyradio:
    """Stands in for cflib's, with a vehicle that has safelink behind it; it transmits only while a test waits."""

    def __init__(self, loss: float = 0.0):
        self.now, self.dead, self.acknowledges, self.unplugged, self.safelink = 0.0, False, True, False, True
        self.received: list[bytes] = []
        self.to_send: deque[bytes] = deque()
        self.closed = False
        self._up, self._down, self._began = 1, 1, False
        self._held = False  # the packet last sent down is one of `to_send`
        self._loss, self._chance = loss, np.random.default_rng(3)
        self._turn, self._end = threading.Condition(), 0.0

    def wait(self, seconds: float) -> None:
        """Let so much time pass."""
        with self._turn:
            self._end = self.now + seconds
            self._turn.notify_all()
            assert self._turn.wait_for(lambda: self.now >= self._end, PATIENCE)

    def wait_for(self, condition) -> None:
        """Let time pass until a condition holds."""
        for _ in range(1000):
            if condition():
                return
            self.wait(0.002)
        pytest.fail("it does not come")

    def wait_for_packets(self, count: int) -> None:
        """Let time pass until the vehicle has received so many packets."""
        self.wait_for(lambda: len(self.received) >= count)

    def run_freely(self) -> None:
        with self._turn:
            self._end = math.inf
            self._turn.notify_all()

    def send_packet(self, data):
        with self._turn:
            self._turn.wait_for(lambda: self.now < self._end)
            self.now += TRANSMISSION
            self._turn.notify_all()
            return self._transmit(bytes(data))

    def _transmit(self, got: bytes):
        if self.unplugged:
            return None
        if got == b"\xff\x05\x01" and self.safelink:
            self._began = True
            return SimpleNamespace(ack=True, data=got)
        if self.dead or self._chance.random() < self._loss:
            return SimpleNamespace(ack=False, data=())
        if not self._began or got[0] >> 3 & 1 != self._up:  # else it is a repetition
            self._up = 1 - self._up
            if got[0] & 0xF3 != 0xF3:
                self.received.append(unmarked(got))
        if self._began and got[0] >> 2 & 1 != self._down:  # the computer has what it was sent last
            self._down = 1 - self._down
            if self._held:
                self.to_send.popleft()
        self._held = bool(self.to_send)
        answer = self.to_send[0] if self._held else b"\xf3"
        answer = bytes((answer[0] & 0xF3 | self._down << 2, *answer[1:]))
        if not self.acknowledges or self._chance.random() < self._loss:
            return SimpleNamespace(ack=False, data=())
        return SimpleNamespace(ack=True, data=answer)

    def close(self):
        self.closed = True


class Cflibs:
    """cflib's thread behind the same few methods as ours."""

    def __init__(self, radio: Crazyradio):
        self._out: queue.Queue = queue.Queue(1)
        self._came: queue.Queue = queue.Queue()
        self.needs_resending = True
        self._thread = _RadioDriverThread(radio, self._came, self._out, lambda _: None, lambda _: None, self, None)
        self._thread._radio_link_statistics = SimpleNamespace(update=lambda *_: None)

    def listen(self, hear, fail):
        self._hear = hear
        self._thread.start()

    def send(self, packet: bytes) -> None:
        self._out.put(CRTPPacket(packet[0], list(packet[1:])))

    def hear_all(self):
        while not self._came.empty():
            came = self._came.get()
            if came.header & 0xF3 != 0xF3:
                self._hear(bytes((came.header, *came.data)))

    def close(self):
        self._thread.stop()


@pytest.fixture
def radio():
    return Crazyradio()


@pytest.fixture
def link(radio):
    yield from opened(radio)


def opened(radio: Crazyradio):
    dongle = Dongle(radio, SimpleNamespace(now=lambda: radio.now))
    dongle.heard, dongle.failures = [], []
    dongle.listen(dongle.heard.append, dongle.failures.append)
    yield dongle
    radio.run_freely()
    dongle.close()
    assert radio.closed


def numbers(radio) -> list[float]:
    return [struct.unpack_from("<f", got, 2)[0] for got in radio.received if got[0] >> 4 == Port.LOCALIZATION]


@pytest.mark.parametrize("make", [lambda radio: Dongle(radio, SimpleNamespace(now=lambda: radio.now)), Cflibs])
def test_over_a_lossy_radio_each_packet_comes_once_and_in_order_both_ways_as_by_cflib(make):
    radio, heard, count = Crazyradio(loss=0.3), [], 200
    link = make(radio)
    link.listen(lambda packet: heard.append(unmarked(packet)), pytest.fail)
    radio.to_send.extend(numbered(1000 + number) for number in range(count))
    for number in range(count):
        link.send(numbered(number))
        radio.wait_for_packets(number + 1)
    radio.wait_for(lambda: not radio.to_send)
    radio.run_freely()
    link.close()
    getattr(link, "hear_all", lambda: None)()
    assert radio.received == [unmarked(numbered(number)) for number in range(count)]
    assert until(lambda: len(heard) == count)
    assert heard == [unmarked(numbered(1000 + number)) for number in range(count)]


def test_a_good_radio_passes_everything_on(radio, link):
    for number in range(20):
        link.send(pose(number))
        radio.wait_for_packets(number + 1)
    assert numbers(radio) == list(range(20))


def test_a_vehicle_without_safelink_gets_each_packet_too():
    radio = Crazyradio()
    radio.safelink = False
    for link in opened(radio):
        for number in range(20):
            link.send(numbered(number))
            radio.wait_for_packets(number + 1)
    assert radio.received == [unmarked(numbered(number)) for number in range(20)]


def test_what_a_dead_radio_held_does_not_come_when_it_returns(radio, link):
    radio.dead = True
    for number in range(40):  # one in the air, one that waits; the others find no room
        link.send(pose(number))
        radio.wait(0.01)
    radio.dead = False
    radio.wait_for_packets(1)
    radio.wait(0.1)
    (held,) = numbers(radio)
    assert held >= 40 - MAX_AGE / 0.01 - 1


def test_a_radio_that_is_dead_for_some_seconds_ends_no_link_and_one_that_is_dead_for_long_does(radio, link):
    radio.wait(0.1)
    radio.dead = True
    radio.wait(DEAD_AFTER - 0.5)
    assert not link.failures
    radio.run_freely()
    assert until(lambda: link.failures)
    assert link.failures == ["the vehicle acknowledges nothing"]


def test_a_crazyradio_that_is_unplugged_is_named(radio, link):
    radio.wait(0.1)
    radio.now += DEAD_AFTER  # instead of waiting for as long: each transmission fails at once
    radio.unplugged = True
    radio.run_freely()
    assert until(lambda: link.failures)
    assert "Crazyradio" in link.failures[0]


def test_an_order_to_cut_the_motors_does_not_perish(radio, link):
    radio.dead = True
    link.send(pack(Port.SUPERVISOR, 1, b"\x03"))
    radio.wait(0.2)
    link.send(pack(Port.SETPOINT, 0, b"\0"))  # stop the motors
    for number in range(20):
        link.send(pose(number))
        radio.wait(0.01)
    radio.dead = False
    radio.wait_for_packets(2)
    assert [got[1:] for got in radio.received] == [b"\x03", b"\0"]


def test_a_packet_whose_acknowledgement_was_lost_is_neither_lost_nor_doubled(radio, link):
    radio.acknowledges = False
    link.send(pose(1))
    radio.wait_for_packets(1)
    radio.wait(0.2)
    radio.acknowledges = True
    for number in (2, 3):
        link.send(pose(number))
        radio.wait_for_packets(number)
    assert numbers(radio) == [1, 2, 3]


@pytest.mark.parametrize(
    ("sent", "perishable"),
    [
        (pose(1), True),
        (pack(Port.SETPOINT, 0, SETPOINT), True),
        (pack(Port.HIGH_LEVEL, 0, go_to(0.0, 0.0, 1.0, 0.0, 1.0)), True),
        (pack(Port.HIGH_LEVEL, 0, start()), True),
        (pack(Port.HIGH_LEVEL, 0, land(0.0, 1.0)), False),
        (pack(Port.SETPOINT, 0, b"\0"), False),  # stop
        (pack(Port.SETPOINT, 1, bytes(5)), False),  # release priority
        (pack(Port.LOCALIZATION, 1, b"\x03"), False),  # emergency stop of older firmware
        (pack(Port.SUPERVISOR, 1, b"\x01\x00"), False),  # disarm
        (pack(Port.PARAMETERS, 2, b"\x08\x00\x01"), False),
        (pack(Port.LINK, 3, b""), False),  # nothing
    ],
)
def test_setpoints_poses_go_tos_and_starts_perish_and_nothing_else(sent, perishable):
    assert is_perishable(sent) is perishable
