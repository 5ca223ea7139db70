"""A block of the vehicle's log (CRTP port 5): packets that create it, also in flight, and its messages.

The firmware deletes all log blocks after 1 s without a packet, and when any client resets the log.
"""

import itertools
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

SETTINGS_CHANNEL, DATA_CHANNEL = 1, 2
DELETE, RESET = 2, 5
_STOP, _CREATE, _APPEND, _START = 4, 6, 7, 8
_MAX_PER_PACKET = 9  # variables
_RETRY_TICKS = 30  # between attempts
_TYPES = {"uint8_t": (1, "B"), "uint16_t": (2, "H"), "uint32_t": (3, "I"), "int16_t": (5, "h"), "float": (7, "f")}
_HEAD = 4  # bytes of a message: block number, then ms in 24 bits


@dataclass(frozen=True, slots=True)
class LogBlock:
    """A block of the vehicle's log, as its firmware knows it."""

    number: int
    period_ms: int
    variables: tuple[tuple[str, str, int], ...]  # name, type in C, and number in the vehicle's table

    def creation(self) -> tuple[bytes, ...]:
        """Return the payloads that create the block and start it, in order; answers begin with the first two bytes."""
        entries = [struct.pack("<BH", _TYPES[kind][0], number) for _, kind, number in self.variables]
        parts = [entries[at : at + _MAX_PER_PACKET] for at in range(0, len(entries), _MAX_PER_PACKET)]
        commands = (_CREATE, *(_APPEND for _ in parts[1:]))
        made = tuple(
            bytes((command, self.number)) + b"".join(part) for command, part in zip(commands, parts, strict=True)
        )
        return *made, struct.pack("<BBH", _START, self.number, self.period_ms)

    def recreation(self) -> Iterator[bytes | None]:
        """Yield one payload per tick, endlessly; together they recreate the block, whether or not it exists.

        None stands for a tick without a packet, which gives the log time to arrive.
        """
        return itertools.cycle((bytes((DELETE, self.number)), *self.creation(), *(None,) * _RETRY_TICKS))

    def stop(self) -> bytes:
        """Return the payload that stops the block."""
        return bytes((_STOP, self.number))

    def decode(self, message: bytes) -> dict[str, Any] | None:
        """Return the values of a message by name; None if its length is wrong, as for a partly created block."""
        layout = "<" + "".join(_TYPES[kind][1] for _, kind, _ in self.variables)
        if len(message) != _HEAD + struct.calcsize(layout):
            return None
        values = struct.unpack_from(layout, message, _HEAD)
        return {name: value for (name, _, _), value in zip(self.variables, values, strict=True)}
