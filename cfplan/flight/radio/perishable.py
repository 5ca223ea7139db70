"""Perishable packets: setpoints and poses, which the vehicle takes for fresh whenever they arrive.

A radio that is dead keeps two packets for when it returns: the one in the air, which cflib's driver repeats until it is
acknowledged, and the one in its queue. A pose among them throws the vehicle's estimate back by as far as it has come
since; where no other follows, as poses have stopped too, it flies off to make up for that. So nothing perishable stays
in either place for long: the queue takes a fresh packet instead, and what is in the air is repeated as an empty packet.
"""

import queue
from array import array
from collections.abc import Callable
from typing import Any

from cfplan.flight.setpoints.packets import CRTP_PORT, FULL_STATE_TYPE

LOCALIZATION_PORT, EXTERNAL_POSE = 6, 8
KEEPS_FOR = 0.05  # s; under heavy loss a packet is acknowledged sooner
_COUNTERS = 0x0C  # bits of the header by which cflib and the vehicle tell a new packet from a repeated one
_EMPTY = 0xF3


def is_perishable(header: int, data: bytes) -> bool:
    """Return whether a packet, by its CRTP header and what follows that, is a full-state setpoint or a pose."""
    kind = header >> 4, header & 3, data[0] if data else -1
    return kind in ((CRTP_PORT, 0, FULL_STATE_TYPE), (LOCALIZATION_PORT, 1, EXTERNAL_POSE))


class PerishableQueue:
    """Puts packets of flight into the queue of one of cflib's driver; what has perished there gives way to the next."""

    def __init__(self, waiting: queue.Queue[Any], now: Callable[[], float]):
        self._waiting, self._now = waiting, now
        self._last: Any = None  # the last perishable packet that was put
        self._put_at = 0.0  # s

    def put(self, packet: Any, patience: float) -> None:
        """Wait for room for at most `patience`, s; then drop the packet, as the next one is fresher."""
        if not self._replaces(packet):
            try:
                self._waiting.put(packet, timeout=patience)
            except queue.Full:
                return
        perishable = is_perishable(packet.header, bytes(packet.data))
        self._last, self._put_at = (packet if perishable else None), self._now()

    def _replaces(self, packet: Any) -> bool:
        """Put a packet where the last one still waits and has perished; return whether that was so."""
        if self._last is None or self._now() - self._put_at < KEEPS_FOR:
            return False
        with self._waiting.mutex:
            held = self._waiting.queue
            if not held or held[0] is not self._last:
                return False
            held[0] = packet
        return True


class PerishableAir:
    """The dongle as cflib's driver thread sees it: it repeats what has perished in the air as an empty packet.

    The counters of the header stay: a vehicle that had the packet, whose acknowledgement was lost, sees a repetition.
    """

    def __init__(self, radio: Any, now: Callable[[], float]):
        self._radio, self._now = radio, now
        self._sent: Any = None  # the thread repeats the same array
        self._since = 0.0  # s

    def send_packet(self, data: Any) -> Any:
        """Transmit a packet once; return the acknowledgement."""
        now = self._now()
        if data is not self._sent:
            self._sent, self._since = data, now
        elif now - self._since > KEEPS_FOR and is_perishable(data[0], bytes(data[1:2])):
            data = array("B", [_EMPTY | data[0] & _COUNTERS])
        return self._radio.send_packet(data)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._radio, name)


def empty_air(driver: Any, now: Callable[[], float]) -> None:
    """Let a radio driver of cflib repeat perishable packets no longer than they keep; others are left as they are."""
    thread: Any = getattr(driver, "_thread", None)
    if thread is not None and hasattr(thread, "_radio"):
        thread._radio = PerishableAir(thread._radio, now)
