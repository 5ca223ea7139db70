"""Transports, which carry packets between a session and a vehicle: the protocol, and one over cflib's drivers."""

import logging
import threading
from collections.abc import Callable, Sequence
from typing import Any, Protocol

_LOOK_PERIOD = 0.1  # s between checks of a receiving thread whether it must end
_SEND_TIMEOUT = 0.1  # s to wait for another thread's packet in a slow driver; then the packet is dropped

Hear = Callable[[bytes], None]
Fail = Callable[[str], None]
_log = logging.getLogger(__name__)


class Transport(Protocol):
    """An open link to one vehicle. Packets may be lost, repeated or late, but stay in order."""

    def listen(self, hear: Hear, fail: Fail) -> None:
        """Call `hear` with each packet, and `fail` with the reason once the link is lost; to be called once."""

    def send(self, packet: bytes) -> None:
        """Send a packet within some milliseconds, or drop it."""

    def close(self) -> None:
        """End the link; may be called twice."""


def start_receiver(receive: Callable[[float], bytes | None], hear: Hear, ended: threading.Event) -> None:
    """Start a thread that calls `hear` with each packet from `receive`, until `ended`; `receive` takes a time-out, s.

    An exception in `hear` is logged, and reception continues: no packet may end a link.
    """

    def run() -> None:
        while not ended.is_set():
            packet = receive(_LOOK_PERIOD)
            if packet is not None:
                try:
                    hear(packet)
                except Exception:
                    _log.exception("a packet could not be read: %s", packet.hex())

    threading.Thread(target=run, name="CRTP", daemon=True).start()


class DriverTransport:
    """A transport over one of cflib's link drivers."""

    def __init__(self, uri: str):
        """Connect. Raises ValueError if no driver knows the URI, and the errors of its driver."""
        from cflib import crtp

        self._fail: Fail = lambda _: None
        self._failure = ""  # why the link is lost
        self._sending, self._ended = threading.Lock(), threading.Event()
        self._driver: Any = crtp.get_link_driver(uri, lambda _: None, self._failed)
        if self._driver is None:
            raise ValueError("No driver found or malformed URI")

    def listen(self, hear: Hear, fail: Fail) -> None:
        self._fail = fail
        if self._failure:
            fail(self._failure)
        start_receiver(self._receive, hear, self._ended)

    def send(self, packet: bytes) -> None:
        from cflib.crtp.crtpstack import CRTPPacket

        if not self._ended.is_set() and self._sending.acquire(timeout=_SEND_TIMEOUT):
            try:
                self._driver.send_packet(CRTPPacket(packet[0], bytearray(packet[1:])))
            finally:
                self._sending.release()

    def close(self) -> None:
        if not self._ended.is_set():
            self._ended.set()
            self._driver.close()

    def _receive(self, wait: float) -> bytes | None:
        packet = self._driver.receive_packet(wait)
        return None if packet is None else bytes((packet.header, *packet.data))

    def _failed(self, reason: str) -> None:
        """Record why the link is lost, and close it; some drivers report the same error repeatedly."""
        if not self._failure:
            self._failure = reason
            self._fail(reason)
            threading.Thread(target=self.close, daemon=True).start()  # it waits for the reporting thread


def register_drivers(drivers: Sequence[type]) -> None:
    """Register link drivers with cflib, ahead of its own."""
    from cflib import crtp
    from cflib.crtp.udpdriver import UdpDriver

    if UdpDriver not in crtp.CLASSES:  # cflib's own are missing; there may already be others
        crtp.init_drivers()
    for driver in reversed(drivers):
        if driver not in crtp.CLASSES:
            crtp.CLASSES.insert(0, driver)
