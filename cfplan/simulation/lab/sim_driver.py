"""A cflib link driver for `sim://0`: unmodified cflib connects to the virtual Crazyflie of a lab.

If the environment names no lab, the link starts its own, and ends it when it closes.
"""

import re
import select
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress

import cflib.crtp
from cflib.crtp.crtpdriver import CRTPDriver
from cflib.crtp.crtpstack import CRTPPacket
from cflib.crtp.exceptions import WrongUriType

from cfplan.errors import InputError, LinkError
from cfplan.flight.radio.crtp import NULL_PACKET
from cfplan.simulation.lab.lab import Lab, start_lab
from cfplan.simulation.lab.room import lab_address
from cfplan.vehicle.airframes import AIRFRAMES

_SCHEME = "sim://"
_OWN_LAB_AIRFRAME = "crazyflie-2.1+"
_PROBE_TIMEOUT = 1.0  # s
_SCAN_TIMEOUT = 0.1  # s
_SCANNED = 8  # labs that a scan looks for
_LONGEST_SILENCE = 2.0  # s without an answer to packets sent
_BUFFER = 1 << 20  # bytes


def register_sim_driver() -> None:
    """Register this driver with cflib, once."""
    if SimDriver not in cflib.crtp.CLASSES:
        cflib.crtp.CLASSES.insert(0, SimDriver)


class SimDriver(CRTPDriver):
    """One link. Packets are read in cflib's thread."""

    def __init__(self) -> None:
        super().__init__()
        self.needs_resending = True  # a datagram may be lost; without this a lost answer would hang a connect for ever
        self.uri = ""
        self._socket: socket.socket | None = None
        self._own_lab: Lab | None = None
        self._wake_reader, self._wake_writer = socket.socketpair()
        self._report: Callable[[str], None] | None = None
        self._failure = ""
        self._reading = threading.RLock()
        self._asked = self._heard = 0.0

    def connect(
        self, uri: str, radio_link_statistics_callback: object, link_error_callback: Callable[[str], None] | None
    ) -> None:
        """Connect. Raises WrongUriType if the URI is of another driver, a CfplanError if no vehicle answers."""
        if not uri.startswith(_SCHEME):
            raise WrongUriType(f"not a {_SCHEME} URI")
        if self._socket is not None:
            raise LinkError("the link is open already", where=uri, hint="close it first")
        number = lab_number(uri)
        address = lab_address(number)
        if address is None:
            self._own_lab = start_lab(AIRFRAMES[_OWN_LAB_AIRFRAME], number=number)
            address = ("127.0.0.1", self._own_lab.port)
        self.uri = uri
        self._socket = _open(address)
        if not _answers(self._socket, _PROBE_TIMEOUT):
            self.close()
            raise LinkError("no vehicle answers", where=uri, hint="its lab has ended; start it again")
        self._report = link_error_callback
        self._asked = self._heard = time.monotonic()

    def receive_packet(self, wait: float = 0) -> CRTPPacket | None:
        """Return the next packet, None after `wait` s (never if negative) or when the link closes."""
        with self._reading:
            link = self._socket
            if link is None:
                return None
            ready, _, _ = select.select([link, self._wake_reader], [], [], None if wait < 0 else wait)
            packet = self._take(link) if link in ready else None
            failure, report = self._failure or self._silence(), self._report
            if failure and report is not None:
                self._report = None
                report(failure)
            return packet

    def _take(self, link: socket.socket) -> CRTPPacket | None:
        try:
            data = link.recv(64)
        except BlockingIOError:
            return None
        except OSError as why:
            self._failure = f"The virtual lab is gone: {why}"
            return None
        self._heard = time.monotonic()
        return CRTPPacket(data[0], bytearray(data[1:])) if data and data != NULL_PACKET else None

    def _silence(self) -> str:
        """Return an error if the lab has not answered for long; cflib pings ten times a second."""
        if self._asked > self._heard and time.monotonic() - self._heard > _LONGEST_SILENCE:
            return f"The virtual lab has not answered for {_LONGEST_SILENCE:.0f} s"
        return ""

    def send_packet(self, pk: CRTPPacket) -> None:
        """Send a packet; a failure is reported from the receiving thread, as the sender may hold locks."""
        link = self._socket
        if link is None:
            return
        try:
            link.send(bytes((pk.header,)) + bytes(pk.data))
            self._asked = time.monotonic()
        except OSError as why:
            self._failure = f"The virtual lab is gone: {why}"
            self._wake()

    def _wake(self) -> None:
        with suppress(OSError):  # closed meanwhile
            self._wake_writer.send(b"\0")

    def close(self) -> None:
        """Close the link; may be called twice."""
        self._report = None
        self._wake()
        with self._reading:
            if self._socket is not None:
                self._socket.close()
                self._socket = None
        if self._own_lab is not None:
            self._own_lab.close()
            self._own_lab = None

    def get_name(self) -> str:
        return "sim"

    def get_status(self) -> str:
        return f"{self.uri}: {'open' if self._socket is not None else 'closed'}"

    def scan_interface(self, address: object = None) -> list[list[str]]:
        """Return the labs that the environment names and that answer."""
        found = []
        for number in range(_SCANNED):
            place = lab_address(number)
            if place is None:
                continue
            probe = _open(place)
            with probe:
                if _answers(probe, _SCAN_TIMEOUT):
                    found.append([f"{_SCHEME}{number}", "virtual Crazyflie"])
        return found

    def get_help(self) -> str:
        return f"{_SCHEME}0: the virtual Crazyflie of the first lab"


def lab_number(uri: str) -> int:
    """Return N of sim://N, whatever options cflib appends. Raises InputError."""
    match = re.fullmatch(r"sim://(\d{1,3})(\?.*)?", uri)
    if match is None:
        raise InputError("no such virtual vehicle", where=uri, hint="sim://0, sim://1, …")
    return int(match[1])


def _open(address: tuple[str, int]) -> socket.socket:
    link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
    link.connect(address)
    link.setblocking(False)
    return link


def _answers(link: socket.socket, timeout: float) -> bool:
    give_up = time.monotonic() + timeout
    try:
        while time.monotonic() < give_up:
            link.send(NULL_PACKET)
            if select.select([link], [], [], timeout / 4)[0]:
                link.recv(64)
                return True
    except OSError:  # refused
        return False
    return False
