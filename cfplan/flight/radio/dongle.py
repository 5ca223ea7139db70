"""Transport over a Crazyradio: cflib drives the dongle; this module decides which packet it transmits next.

The radio is polled: the vehicle acknowledges each transmission, and its packets are carried by the acknowledgements.
Safelink marks packets in both directions with a one-bit counter in the header, so that repetitions are recognised.
"""

import queue
import threading
from array import array
from typing import Any

from cfplan.flight.clock import REAL_CLOCK, Clock
from cfplan.flight.radio.perishable import Outbox
from cfplan.flight.radio.transport import Fail, Hear, start_receiver

PATIENCE = 0.005  # s to wait for a busy radio; then the packet is dropped, as the next one is fresher
DEAD_AFTER = 10.0  # s without an acknowledgement; a vehicle that hovers may come back
_UNANSWERED_PAUSE = 0.001  # s after a transmission without a report: an unplugged dongle fails at once
_SAFELINK = bytes((0xFF, 0x05, 0x01))  # requests safelink; a vehicle that supports it echoes this
_SAFELINK_ATTEMPTS = 10
_UP, _DOWN = 3, 2  # bits of the counters in the header
_COUNTERS = 1 << _UP | 1 << _DOWN
_NULL = 0xF3  # header of an empty packet, without the counters
_IDLE_AFTER, _IDLE_PERIOD = 10, 0.01  # after this many empty acknowledgements, s between transmissions


class Dongle:
    """A link to one vehicle over a Crazyradio."""

    def __init__(self, radio: Any, clock: Clock = REAL_CLOCK, period: float = 0.0):
        """Take a `cflib.drivers.crazyradio.Crazyradio` that is tuned; `period`, s, is the least time each."""
        self._radio, self._clock, self._period = radio, clock, period
        self._outbox, self._changed = Outbox(), threading.Condition()
        self._received: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._ended = threading.Event()
        self._transmitting: threading.Thread | None = None
        self._fail: Fail = lambda _: None

    def listen(self, hear: Hear, fail: Fail) -> None:
        self._fail = fail
        self._transmitting = threading.Thread(target=self._run, name="radio", daemon=True)
        self._transmitting.start()
        start_receiver(self._receive, hear, self._ended)

    def send(self, packet: bytes) -> None:
        with self._changed:
            self._changed.wait_for(lambda: self._outbox.put(packet, self._clock.now()), PATIENCE)
            self._changed.notify_all()

    def close(self) -> None:
        if not self._ended.is_set():
            self._ended.set()
            if self._transmitting is not None:
                self._transmitting.join()
            self._radio.close()

    def _receive(self, wait: float) -> bytes | None:
        try:
            return self._received.get(timeout=wait)
        except queue.Empty:
            return None

    def _run(self) -> None:
        """Transmit continuously, as the vehicle's packets come only with acknowledgements."""
        try:
            self._transmit(safelink=any(self._has_safelink() for _ in range(_SAFELINK_ATTEMPTS)))
        except Exception as error:  # pyusb raises many types
            self._fail(f"the Crazyradio failed: {error}")

    def _has_safelink(self) -> bool:
        answer = self._radio.send_packet(array("B", _SAFELINK))
        return answer is not None and bytes(answer.data) == _SAFELINK

    def _transmit(self, *, safelink: bool) -> None:
        up = down = empty = 0
        answered = acknowledged = self._clock.now()
        while not self._ended.is_set():
            with self._changed:
                frame = array("B", self._outbox.transmission(self._clock.now()))
            if safelink:
                frame[0] = frame[0] & ~_COUNTERS | up << _UP | down << _DOWN
            answer = self._radio.send_packet(frame)
            now = self._clock.now()
            if answer is not None:
                answered = now
            else:
                self._ended.wait(_UNANSWERED_PAUSE)
            if answer is None or not answer.ack:
                if now - acknowledged > DEAD_AFTER:
                    alive = now - answered < DEAD_AFTER
                    self._fail("the vehicle acknowledges nothing" if alive else "the Crazyradio does not answer")
                    return
                continue
            acknowledged, content = now, bytes(answer.data)
            up = 1 - up
            if content and content[0] >> _DOWN & 1 == down:
                down = 1 - down
            if content and content[0] & ~_COUNTERS != _NULL:
                self._received.put(content)
            empty = 0 if content else empty + 1
            with self._changed:
                self._outbox.acknowledged()
                self._changed.notify_all()
                if self._period:
                    self._changed.wait_for(self._ended.is_set, self._period)
                elif empty > _IDLE_AFTER:
                    self._changed.wait_for(lambda: not self._outbox.empty, _IDLE_PERIOD)


def open_dongle(uri: str, clock: Clock = REAL_CLOCK) -> Dongle:
    """Open the Crazyradio of a radio:// URI. Raises the errors of cflib and pyusb."""
    from cflib.crtp.radiodriver import RadioDriver
    from cflib.drivers.crazyradio import Crazyradio

    number, channel, rate, address, most = RadioDriver.parse_uri(uri)
    radio = Crazyradio(devid=number)
    radio.set_channel(channel)
    radio.set_data_rate(rate)
    radio.set_address(address)
    return Dongle(radio, clock, 1.0 / most if most else 0.0)
