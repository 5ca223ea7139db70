"""A simulated Crazyradio 2.0 in inline mode, at the level of USB, and the radios of the vehicles that it reaches."""

import errno
import socket
from array import array
from collections import deque

import numpy as np
from usb.core import USBTimeoutError

from cfplan.flight.clock import REAL_CLOCK
from cfplan.flight.fleet.inline_radio import InlineRadio

SAFELINK = b"\xff\x05\x01"
NULL = b"\xff"
AIR_TIME = 0.00075  # s of an exchange
UNACKNOWLEDGED_TIME = 0.003  # s, with three repetitions


def unmarked(packet) -> bytes:
    """Return a packet with both counter bits of safelink set, as they are without safelink."""
    return bytes((packet[0] | 0x0C, *packet[1:]))


class RadioVehicle:
    """A vehicle's radio: it receives each packet once, and repeats its own until they are acknowledged."""

    def __init__(self, loss: float = 0.0, *, safelink: bool = True):
        self.off, self.has_safelink = False, safelink
        self.received: list[bytes] = []
        self.to_send: deque[bytes] = deque()
        self._began, self._up, self._down, self._held = False, 1, 1, False
        self._loss, self._chance = loss, np.random.default_rng(3)

    def receive(self, packet: bytes) -> None:
        self.received.append(packet)

    def collect(self) -> None:
        """Add the packets that the vehicle has sent meanwhile to `to_send`."""

    def exchange(self, frame: bytes) -> bytes | None:
        """Hear a frame; return the content of the acknowledgement, or None if either is lost."""
        if self.off or self._chance.random() < self._loss:
            return None
        if frame == SAFELINK and self.has_safelink:
            self._began, self._up, self._down, self._held = True, 1, 1, False
            return None if self._chance.random() < self._loss else frame
        if not self._began or frame[0] >> 3 & 1 != self._up:
            self._up = 1 - self._up
            if unmarked(frame) != NULL:
                self.receive(unmarked(frame))
        if self._began and frame[0] >> 2 & 1 != self._down:
            self._down = 1 - self._down
            if self._held:
                self.to_send.popleft()
        self.collect()
        self._held = bool(self.to_send)
        answer = self.to_send[0] if self._held else NULL
        if not self._began and self._held:
            self.to_send.popleft()
        answer = bytes((answer[0] & 0xF3 | self._down << 2, *answer[1:])) if self._began else answer
        return None if self._chance.random() < self._loss else answer


class EchoVehicle(RadioVehicle):
    """A vehicle that returns each packet."""

    def receive(self, packet: bytes) -> None:
        super().receive(packet)
        self.to_send.append(packet)


class UdpVehicle(RadioVehicle):
    """The radio of a virtual vehicle, which listens on a UDP port of this computer."""

    def __init__(self, port: int):
        super().__init__()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(("127.0.0.1", port))
        self._socket.setblocking(False)

    def receive(self, packet: bytes) -> None:
        self._socket.send(packet)

    def collect(self) -> None:
        while True:
            try:
                packet = self._socket.recv(64)
            except BlockingIOError:
                return
            if packet and unmarked(packet) != NULL:
                self.to_send.append(packet)


class InlineCrazyradio:
    """A stand-in for cflib's Crazyradio and its USB handle; `vehicles` by the last byte of their addresses."""

    def __init__(self, vehicles: dict[int, RadioVehicle], pass_time=REAL_CLOCK.sleep):
        self.vehicles, self._pass_time = vehicles, pass_time
        self.handle, self.inline, self.closed = self, False, False
        self.log: list[tuple[int, bytes]] = []  # last byte of the address, and frame
        self.headers: list[bytes] = []
        self.late = False  # the next answer comes after the time-out
        self.broken = False
        self.short = False  # the next answer is cut short
        self.air_time = AIR_TIME
        self._answers: deque[bytes] = deque()

    def ctrl_transfer(self, kind, request, *, wValue, wIndex, timeout, data_or_wLength):
        assert (kind, request, wValue) == (0x40, 0x23, 1)
        self.inline = True

    def write(self, endpoint, data, timeout):
        assert self.inline
        assert endpoint == 1
        assert data[0] == len(data)
        assert data[1] in (0x11, 0x12)  # acknowledged, at 1M or 2M
        assert data[2] <= 100
        if self.broken:
            raise USBTimeoutError("timed out", None, errno.ETIMEDOUT)
        self.log.append((data[7], bytes(data[8:])))
        self.headers.append(bytes(data[:8]))
        vehicle = self.vehicles.get(data[7])
        content = vehicle.exchange(bytes(data[8:])) if vehicle is not None else None
        self._pass_time(self.air_time if content is not None else UNACKNOWLEDGED_TIME)
        acknowledged = content is not None
        self._answers.append(bytes((2 + len(content or b""), int(acknowledged))) + (content or b""))

    def read(self, endpoint, size, timeout):
        assert (endpoint, size) == (0x81, 64)
        if self.late or not self._answers:
            self.late = False
            self._pass_time(1e-3 * timeout)
            raise USBTimeoutError("timed out", None, errno.ETIMEDOUT)
        answer = self._answers.popleft()
        if self.short:
            self.short, answer = False, answer[:1]
        return array("B", answer)

    def close(self):
        self.closed = True


def radio_of_echoing_vehicles(dongle: str) -> InlineRadio:
    """Open a radio with two vehicles, 1 and 2, which return each packet."""
    return InlineRadio(InlineCrazyradio({1: EchoVehicle(), 2: EchoVehicle()}))


def absent_radio(dongle: str) -> InlineRadio:
    raise OSError("Cannot find a Crazyradio Dongle")


def radio_of_virtual_vehicles(ports: dict[int, int], dongle: str) -> InlineRadio:
    """Open a radio with virtual vehicles; `ports` maps the last bytes of their addresses to their UDP ports."""
    return InlineRadio(InlineCrazyradio({number: UdpVehicle(port) for number, port in ports.items()}))
