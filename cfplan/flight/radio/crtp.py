"""CRTP packets: a header of port and channel, then at most 30 bytes."""

from enum import IntEnum

LARGEST_PAYLOAD = 30
NULL_PACKET = b"\xff"  # empty; a vehicle answers it


class Port(IntEnum):
    """The service that a packet is for."""

    CONSOLE = 0
    PARAMETERS = 2
    ATTITUDE_SETPOINT = 3
    MEMORY = 4
    LOG = 5
    LOCALIZATION = 6
    SETPOINT = 7
    HIGH_LEVEL = 8
    SUPERVISOR = 9
    PLATFORM = 13
    LINK = 15


def pack(port: Port, channel: int, payload: bytes) -> bytes:
    """Return a packet as bytes."""
    return bytes((port << 4 | 0x0C | channel,)) + payload
