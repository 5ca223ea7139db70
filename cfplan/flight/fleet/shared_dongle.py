"""One Crazyradio for several vehicles: decides which packet it transmits next, and to which vehicle.

Vehicles take turns; the one that was served longest ago is next. A vehicle for which no packet waits is polled, as its
own packets come with acknowledgements. One that does not acknowledge is tried less often, so that it does not take the
time of the others.

Safelink and the expiry of packets are as in radio/dongle.py. For each vehicle, only its newest setpoint and its newest
pose wait.
"""

from collections.abc import Callable, Sequence
from typing import Protocol

from cfplan.errors import LinkError
from cfplan.flight.clock import Clock
from cfplan.flight.firmware import Timeouts
from cfplan.flight.fleet.inline_radio import RadioAddress
from cfplan.flight.radio.crtp import NULL_PACKET, Port
from cfplan.flight.radio.dongle import DEAD_AFTER
from cfplan.flight.radio.perishable import Outbox, is_perishable

PACE = 0.002  # s, least time between packets to one vehicle, whose radio queue holds 5
NEVER_HEARD_AFTER = 3.0  # s after the link was opened, without any acknowledgement: the link is lost
RADIO_DEAD_AFTER = Timeouts().motors_off  # s without a report: all links are lost; by then no vehicle flies
_POLL_PERIOD, _QUICK_POLLS = 0.01, 3  # s between polls; after a vehicle's packet, this many follow at PACE
_MAX_BACKOFF = 0.03  # s between attempts to reach a vehicle that acknowledges nothing
_MAX_WAITING = 16  # packets for one vehicle; then the oldest is dropped
_NO_REPORT_PAUSE = 0.001  # s after an exchange without a report: an unplugged radio fails at once
_SAFELINK, _SAFELINK_ATTEMPTS = bytes((0xFF, 0x05, 0x01)), 10  # see radio/dongle.py
_PING = Port.LINK << 4  # header of a ping, without the counters
_UP, _DOWN = 3, 2  # bits of the counters in the header
_COUNTERS = 1 << _UP | 1 << _DOWN


class SharedRadio(Protocol):
    """A radio that can send each packet to a different vehicle."""

    def exchange(self, to: RadioAddress, frame: bytes) -> bytes | None:
        """Transmit; return the acknowledgement's content, or None if there is none. Raises OSError without a report."""

    def close(self) -> None:
        """Release the radio."""


class SharedVehicle:
    """One vehicle on a shared dongle: the packets that wait for it, and the state of its link."""

    def __init__(self, address: RadioAddress, hear: Callable[[bytes], None], fail: Callable[[str], None]):
        """Take an address; `hear` gets each packet from the vehicle, and `fail` the reason why its link is lost."""
        self.address, self.hear, self.fail = address, hear, fail
        self.open = False
        self.served_at = 0.0  # s, its last turn

    def begin(self, now: float, *, safelink: bool = True) -> None:
        """Open the link. Without safelink, `hear` also gets empty acknowledgements."""
        self.open, self.acknowledged = True, now
        self._outbox, self._waiting = Outbox(), dict[bytes, tuple[float, bytes]]()
        self._safelink_attempts = _SAFELINK_ATTEMPTS if safelink else 0  # left
        self._plain, self._safelink = not safelink, False
        self._heard = False
        self._up = self._down = self._failures = self._empty = 0
        self._next = self._poll = now  # s: when it may be served, and when it is polled

    def put(self, packet: bytes, sent: float) -> None:
        """Add a packet that the pilot sent at `sent`, s; it replaces an older setpoint, pose or ping, or its equal.

        A pose keeps the place of the one that it replaces, so that setpoints do not always go first; any other packet
        goes to the end.
        """
        newest = is_perishable(packet) or packet[0] & ~_COUNTERS == _PING
        kind = packet[:1] if newest else packet
        if packet[0] >> 4 != Port.LOCALIZATION:
            self._waiting.pop(kind, None)
        self._waiting[kind] = sent, packet
        if len(self._waiting) > _MAX_WAITING:
            del self._waiting[next(iter(self._waiting))]

    @property
    def turn(self) -> float:
        """Return when, s, its next turn is due; this may be in the past."""
        return self._next if self._waiting or not self._outbox.empty else max(self._next, self._poll)

    def frame(self, now: float) -> bytes:
        """Return the frame to transmit now, s."""
        self.served_at = now
        if self._safelink_attempts:
            return _SAFELINK
        if self._outbox.empty and self._waiting:
            sent, packet = self._waiting.pop(next(iter(self._waiting)))
            self._outbox.put(packet, sent)
        header, *rest = self._outbox.transmission(now)
        if self._safelink:
            header = header & ~_COUNTERS | self._up << _UP | self._down << _DOWN
        return bytes((header, *rest))

    def unanswered(self, now: float) -> None:
        """Record that the frame was not acknowledged."""
        self._failures += 1
        self._next = now + min(PACE * self._failures, _MAX_BACKOFF)
        if now - self.acknowledged > (DEAD_AFTER if self._heard else NEVER_HEARD_AFTER):
            self.open = False
            self.fail("the vehicle acknowledges nothing: is it on, and are channel, rate and address right?")

    def answered(self, content: bytes, now: float) -> None:
        """Record the acknowledgement of the frame, and pass its content on."""
        self.acknowledged, self._heard, self._failures, self._next = now, True, 0, now + PACE
        if self._safelink_attempts:
            self._safelink = content == _SAFELINK
            self._safelink_attempts = 0 if self._safelink else self._safelink_attempts - 1
            return
        self._outbox.acknowledged()
        self._up = 1 - self._up
        if content and content[0] >> _DOWN & 1 == self._down:
            self._down = 1 - self._down
        empty = not content or content[0] | _COUNTERS == NULL_PACKET[0]
        self._empty = self._empty + 1 if empty else 0
        self._poll = now + (_POLL_PERIOD if self._empty > _QUICK_POLLS else PACE)
        if self._plain or not empty:
            self.hear(content or NULL_PACKET)


class SharedDongle:
    """A Crazyradio that serves several vehicles in turn."""

    def __init__(self, radio: SharedRadio, vehicles: Sequence[SharedVehicle], clock: Clock):
        self._radio, self._vehicles, self._clock = radio, vehicles, clock
        self._reported = clock.now()

    def serve(self) -> float:
        """Serve the vehicle that is due, if any; return the time, s, until the next turn.

        Raises LinkError if the radio has not reported for RADIO_DEAD_AFTER.
        """
        now = self._clock.now()
        vehicles = [(each, each.turn) for each in self._vehicles if each.open]
        due = [each for each, turn in vehicles if turn <= now]
        if due:
            self._exchange(min(due, key=lambda each: each.served_at), now)
            return 0.0
        return min((turn for _, turn in vehicles), default=now + _POLL_PERIOD) - now

    def _exchange(self, vehicle: SharedVehicle, now: float) -> None:
        try:
            content = self._radio.exchange(vehicle.address, vehicle.frame(now))
        except OSError as error:  # a pyusb error is one
            if self._clock.now() - self._reported > RADIO_DEAD_AFTER:
                raise LinkError(f"the Crazyradio does not answer: {error}", hint="unplug it, and plug it in") from error
            self._clock.sleep(_NO_REPORT_PAUSE)
            content = None
        else:
            self._reported = self._clock.now()
        if content is None:
            vehicle.unanswered(self._clock.now())
        else:
            vehicle.answered(content, self._clock.now())
