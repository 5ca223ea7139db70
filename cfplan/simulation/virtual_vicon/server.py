"""The server's side of Vicon's DataStream protocol: connections, and frames as packets. Nothing here waits."""

import math
import socket
import struct
from collections.abc import Sequence
from dataclasses import dataclass

from cfplan.flight.mocap.datastream import (
    LARGEST_PACKET,
    OBJECTS,
    PACKET_HEAD,
    Block,
    Fields,
    MalformedError,
    kinds,
    packet,
    read_blocks,
    read_kinds,
)
from cfplan.flight.telemetry import Quaternion, Triple

_OFFERED = (
    Block.STREAM_INFO, Block.SUBJECT_INFO, Block.FRAME_INFO, Block.GLOBAL_SEGMENTS, Block.LATENCY_INFO,
    Block.APPLICATION_INFO, Block.FRAME_RATE_INFO, Block.OBJECT_QUALITY, Block.PING, Block.CONTENTS,
)  # fmt: skip
_STATIC = (Block.SUBJECT_INFO, Block.APPLICATION_INFO, Block.OBJECT_QUALITY)
_TICKS = 135_000_000  # Hz, of the stream's period
_ROOT_SEGMENT = 1
_MAX_UNSENT = 1 << 20  # bytes that a client may be behind before it is dropped

_U32 = struct.Struct("<I")
_BOOL = struct.Struct("<?")


@dataclass(frozen=True, slots=True)
class Shown:
    """One body in a frame."""

    name: str
    segment: str
    pose: tuple[Triple, Quaternion] | None  # None where it is not seen
    quality: float = 1.0


@dataclass(frozen=True, slots=True)
class Picture:
    """One frame as it goes out."""

    number: int
    rate: float
    latency: float
    y_up: bool
    bodies: tuple[Shown, ...]


class Connection:
    """One client. With `spare`, data that has not changed is omitted."""

    def __init__(self, client: socket.socket, *, spare: bool):
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket, self._spare = client, spare
        self._received, self._unsent = bytearray(), bytearray()
        self._wanted: set[int] = set()
        self._streaming = False
        self._asked = 0
        self._static: dict[int, list[bytes]] = {}
        self.alive = True
        self._send(packet((Block.OBJECT_ENUMS, kinds(_OFFERED))))

    def read(self) -> None:
        """Read the client's requests and obey them."""
        try:
            while data := self._socket.recv(1 << 16):
                self._received += data
            self.alive = False
        except BlockingIOError:
            pass
        except OSError:
            self.alive = False
        try:
            self._obey()
        except MalformedError:
            self.alive = False
        self._send(b"")

    def show(self, picture: Picture) -> None:
        """Send a frame to a client that wants it."""
        if self._streaming or self._asked:
            self._asked = max(0, self._asked - 1)
            self._send(self._encoded(picture))

    def close(self, *, reset: bool = False) -> None:
        """Close the connection; with `reset` as a crash would."""
        if reset:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self._socket.close()
        self.alive = False

    def _obey(self) -> None:
        while len(self._received) >= PACKET_HEAD.size:
            tag, size = PACKET_HEAD.unpack_from(self._received)
            if tag != OBJECTS or size > LARGEST_PACKET:
                raise MalformedError(f"no packet: {tag:#x}")
            end = PACKET_HEAD.size + size
            if len(self._received) < end:
                return
            body = bytes(self._received[PACKET_HEAD.size : end])
            del self._received[:end]
            for kind, payload in read_blocks(memoryview(body)):
                if kind == Block.OBJECT_ENUMS:
                    self._wanted = set(read_kinds(payload))
                    self._static.clear()
                elif kind == Block.REQUEST_FRAME:
                    (self._streaming,) = Fields(payload).take(_BOOL)
                    self._asked += not self._streaming
                elif kind == Block.PING:
                    self._send(packet((Block.PING, bytes(payload))))

    def _encoded(self, picture: Picture) -> bytes:
        blocks = [(kind, payload) for kind, payload in _blocks(picture) if kind in self._wanted]
        unchanged = []
        if self._spare:
            for static in _STATIC:
                now = [payload for kind, payload in blocks if kind == static]
                if now and self._static.get(static) == now:
                    unchanged.append(static)
                self._static[static] = now
            blocks = [block for block in blocks if block[0] not in unchanged]
        counts: dict[int, int] = {}
        for kind, _ in blocks:
            counts[kind] = counts.get(kind, 0) + 1
        contents = _U32.pack(len(counts)) + b"".join(PACKET_HEAD.pack(*item) for item in sorted(counts.items()))
        return packet((Block.CONTENTS, contents + kinds(unchanged)), *blocks)

    def _send(self, data: bytes) -> None:
        self._unsent += data
        try:
            while self._unsent:
                del self._unsent[: self._socket.send(self._unsent)]
        except BlockingIOError:
            self.alive = self.alive and len(self._unsent) < _MAX_UNSENT
        except OSError:
            self.alive = False


def _blocks(picture: Picture) -> list[tuple[int, bytes]]:
    blocks: list[tuple[int, bytes]] = [
        (Block.STREAM_INFO, struct.pack("<q", round(_TICKS / picture.rate))),
        (Block.APPLICATION_INFO, struct.pack("<b", picture.y_up)),
        (Block.FRAME_INFO, _U32.pack(picture.number)),
        (Block.LATENCY_INFO, _named([("Camera", picture.latency / 2), ("Processing", picture.latency / 2)])),
        (Block.FRAME_RATE_INFO, _named([("Hardware", picture.rate)])),
    ]
    for number, body in enumerate(picture.bodies, start=1):
        segment = struct.pack("<II6f", 0, _ROOT_SEGMENT, *[0.0] * 6) + _string(body.segment)
        info = _U32.pack(number) + _string(body.name) + _U32.pack(1) + segment + _U32.pack(0) + _U32.pack(0)
        blocks.append((Block.SUBJECT_INFO, info))
        blocks.append((Block.OBJECT_QUALITY, struct.pack("<Id", number, body.quality)))
    for number, body in enumerate(picture.bodies, start=1):
        if body.pose is None:
            blocks.append((Block.GLOBAL_SEGMENTS, struct.pack("<II", number, 0)))
        else:
            row = struct.pack("<I12d", _ROOT_SEGMENT, *_millimetres_and_matrix(*body.pose, y_up=picture.y_up))
            blocks.append((Block.GLOBAL_SEGMENTS, struct.pack("<II", number, 1) + row))
    return blocks


def _string(text: str) -> bytes:
    data = text.encode()
    return _U32.pack(len(data)) + data


def _named(values: Sequence[tuple[str, float]]) -> bytes:
    return _U32.pack(len(values)) + b"".join(_string(name) + struct.pack("<d", value) for name, value in values)


def _millimetres_and_matrix(position: Triple, quaternion: Quaternion, *, y_up: bool) -> tuple[float, ...]:
    (px, py, pz), (x, y, z, w) = position, quaternion
    if y_up:
        py, pz, y, z = pz, -py, z, -y
    norm = math.hypot(x, y, z, w)
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    return (
        1000 * px, 1000 * py, 1000 * pz,
        1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
        2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
        2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
