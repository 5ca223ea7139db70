"""Services that a client requests first: link and versions (CRTP ports 15 and 13), and memories (port 4)."""

from struct import unpack_from

PROTOCOL_VERSION = 12
FIRMWARE_VERSION = "2026.08"
DEVICE_TYPE = "CF20"
_NAME = b"Bitcraze Crazyflie"

_ECHO, _SOURCE, _SINK, _NULL = range(4)
_PLATFORM_COMMAND, _VERSION = range(2)
_PROTOCOL, _FIRMWARE, _DEVICE = range(3)

TRAJECTORY_MEMORY_TYPE = 0x12
TRAJECTORY_MEMORY_SIZE = 4096
_TESTER_MEMORY_TYPE = 0x15
_MEMORY_INFO, _MEMORY_READ, _MEMORY_WRITE = range(3)
_COUNT, _DETAILS = 1, 2
_MAX_READ = 24
_IO_ERROR = 5


def answer_link(channel: int, payload: bytes) -> bytes | None:
    """Answer link control: echo, name, and the null packet that scans send."""
    if channel == _ECHO:
        return payload
    if channel == _SOURCE:
        return _NAME.ljust(30, b"\0")
    return b"" if channel == _NULL else None


def answer_platform(channel: int, payload: bytes, *, protocol: int, firmware: str) -> bytes | None:
    """Answer the platform service: versions. Its commands (continuous wave, notifications) are only echoed."""
    if channel == _PLATFORM_COMMAND:
        return payload
    if channel != _VERSION or not payload:
        return None
    if payload[0] == _PROTOCOL:
        return bytes((_PROTOCOL,)) + protocol.to_bytes(4, "little")
    if payload[0] == _FIRMWARE:
        return bytes((_FIRMWARE,)) + firmware.encode()[:29]
    if payload[0] == _DEVICE:
        return bytes((_DEVICE,)) + DEVICE_TYPE.encode()
    return None


class Memories:
    """The list of memories; only the one for trajectories has any content."""

    def __init__(self) -> None:
        self.trajectory = bytearray(TRAJECTORY_MEMORY_SIZE)
        self._list = ((_TESTER_MEMORY_TYPE, 0x1000), (TRAJECTORY_MEMORY_TYPE, TRAJECTORY_MEMORY_SIZE))
        self._trajectory_id = 1

    def receive(self, channel: int, payload: bytes) -> bytes | None:
        """Take a packet; return the answer's payload, on the same channel, None where the firmware is silent."""
        if channel == _MEMORY_INFO and payload:
            return self._info(payload)
        if channel == _MEMORY_READ and len(payload) >= 6:
            return self._read(payload)
        if channel == _MEMORY_WRITE and len(payload) >= 5:
            return self._write(payload)
        return None

    def _info(self, payload: bytes) -> bytes | None:
        if payload[0] == _COUNT:
            return bytes((_COUNT, len(self._list)))
        if payload[0] != _DETAILS or len(payload) < 2:
            return None
        if payload[1] >= len(self._list):
            return payload[:2]
        kind, size = self._list[payload[1]]
        return payload[:2] + bytes((kind,)) + size.to_bytes(4, "little") + bytes(8)

    def _read(self, payload: bytes) -> bytes:
        number, address, length = unpack_from("<BIB", payload)
        if number != self._trajectory_id or length > _MAX_READ or address + length > TRAJECTORY_MEMORY_SIZE:
            return payload[:5] + bytes((_IO_ERROR,))
        return payload[:5] + b"\0" + bytes(self.trajectory[address : address + length])

    def _write(self, payload: bytes) -> bytes:
        number, address = unpack_from("<BI", payload)
        content = payload[5:]
        if number != self._trajectory_id or address + len(content) > TRAJECTORY_MEMORY_SIZE:
            return payload[:5] + bytes((_IO_ERROR,))
        self.trajectory[address : address + len(content)] = content
        return payload[:5] + b"\0"
