"""Packets waiting for a polled radio; setpoints, poses and some commands expire, as a vehicle treats every one as new.

A Crazyradio repeats the packet in the air until it is acknowledged, and one more waits behind it. A radio that was dead
would send both when it returns. An old pose would set the vehicle's estimate back by the distance flown since, an old
go-to would turn the vehicle back to a place that it has passed, and an old start would begin its trajectory later than
the pilot expects. Therefore an expired packet is replaced by the next one, and in the air it is repeated as an empty
packet.
"""

from cfplan.flight.on_board.commands import GO_TO, START
from cfplan.flight.radio.crtp import NULL_PACKET, Port
from cfplan.flight.setpoints.packets import FULL_STATE_TYPE

EXTERNAL_POSE = 8
MAX_AGE = 0.05  # s, of perishable packets; even under heavy loss packets are acknowledged sooner

_PERISHABLE = (  # port, channel and first byte
    (Port.SETPOINT, 0, FULL_STATE_TYPE),
    (Port.LOCALIZATION, 1, EXTERNAL_POSE),
    (Port.HIGH_LEVEL, 0, GO_TO),
    (Port.HIGH_LEVEL, 0, START),
)


def is_perishable(packet: bytes) -> bool:
    """Return whether a packet is a full-state setpoint, a pose, a go-to, or the start of a trajectory."""
    kind = packet[0] >> 4, packet[0] & 3, packet[1] if len(packet) > 1 else -1
    return kind in _PERISHABLE


class Outbox:
    """The packet in the air and the one that waits behind it, each with the time, s, at which it was added."""

    def __init__(self) -> None:
        self._in_air: tuple[float, bytes] | None = None
        self._waiting: tuple[float, bytes] | None = None

    @property
    def empty(self) -> bool:
        """Return whether nothing is in the air."""
        return self._in_air is None

    def put(self, packet: bytes, now: float) -> bool:
        """Add a packet; return False if another one is waiting that has not expired."""
        if self._in_air is None:
            self._in_air = now, packet
        elif self._waiting is None or _perished(*self._waiting, now):
            self._waiting = now, packet
        else:
            return False
        return True

    def transmission(self, now: float) -> bytes:
        """Return the packet to transmit: the one in the air, or an empty one, which is in the air from then on."""
        if self._in_air is None:
            self._in_air = now, NULL_PACKET
        return NULL_PACKET if _perished(*self._in_air, now) else self._in_air[1]

    def acknowledged(self) -> None:
        """Remove the packet in the air: the vehicle has it."""
        self._in_air, self._waiting = self._waiting, None

    def full(self, now: float) -> bool:
        """Return whether `put` would return False."""
        return self._waiting is not None and not _perished(*self._waiting, now)


def _perished(put_at: float, packet: bytes, now: float) -> bool:
    return now - put_at > MAX_AGE and is_perishable(packet)
