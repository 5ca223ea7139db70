"""Packets that create a log block (CRTP port 5), also in flight, where nothing may wait for an answer.

The firmware deletes all log blocks after 1 s without a packet, and when any client resets the log.
"""

import itertools
import struct
from collections.abc import Iterator
from dataclasses import dataclass

LOG_PORT, SETTINGS_CHANNEL = 5, 1
_DELETE, _CREATE, _APPEND, _START = 2, 6, 7, 8
_IN_ONE_PACKET = 9  # variables
_TICKS_BETWEEN = 30  # from one attempt to the next
_TYPES = {"uint8_t": 1, "uint16_t": 2, "uint32_t": 3, "int16_t": 5, "float": 7}


@dataclass(frozen=True, slots=True)
class LogBlock:
    """A block of the vehicle's log, as its firmware knows it."""

    number: int
    period_ms: int
    variables: tuple[tuple[str, int], ...]  # type in C, and number in the vehicle's table

    def creation(self) -> tuple[bytes, ...]:
        """Return the payloads that create the block and start it, in order; answers begin with the first two bytes."""
        entries = [struct.pack("<BH", _TYPES[kind], number) for kind, number in self.variables]
        parts = [entries[at : at + _IN_ONE_PACKET] for at in range(0, len(entries), _IN_ONE_PACKET)]
        commands = (_CREATE, *(_APPEND for _ in parts[1:]))
        made = tuple(
            bytes((command, self.number)) + b"".join(part) for command, part in zip(commands, parts, strict=True)
        )
        return *made, struct.pack("<BBH", _START, self.number, self.period_ms)

    def revival(self) -> Iterator[bytes | None]:
        """Yield one payload a tick, without end; together they create the block anew, whether or not it exists.

        None stands for a tick without a packet, so that the log has time to come.
        """
        return itertools.cycle((bytes((_DELETE, self.number)), *self.creation(), *(None,) * _TICKS_BETWEEN))
