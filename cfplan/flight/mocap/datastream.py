"""Vicon's DataStream protocol, read from the SDK's public source: little endian, packed.

    packet = u32 OBJECTS, u32 length, block*        block = u32 type, u32 length, payload
    string = u32 n, bytes        vector, set, map = u32 n, items

A server need not repeat blocks that have not changed since its last packet: the contents block then lists their types
as unchanged, and the client keeps the old values.
"""

import math
import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from enum import IntEnum

from cfplan.flight.mocap.frames import Frame, Scene, Subject, TrackedBody
from cfplan.flight.telemetry import Quaternion

OBJECTS = 0x1A2B0001
PACKET_HEAD = struct.Struct("<II")
LARGEST_PACKET = 16 << 20  # bytes; a larger size means that this is not a packet
_SEGMENT = struct.Struct("<I12d")
_ROTATION_ERROR = 1e-3  # on a matrix's product with its transpose, which must be the identity


class Block(IntEnum):
    """Types of the blocks that cfplan uses."""

    STREAM_INFO = 1
    SUBJECT_INFO = 2
    FRAME_INFO = 5
    GLOBAL_SEGMENTS = 9
    LATENCY_INFO = 26
    APPLICATION_INFO = 37
    FRAME_RATE_INFO = 39
    OBJECT_QUALITY = 40
    PING = 42
    OBJECT_ENUMS = 100001
    REQUEST_FRAME = 100002
    CONTENTS = 100004


WANTED = (
    Block.SUBJECT_INFO, Block.FRAME_INFO, Block.GLOBAL_SEGMENTS, Block.LATENCY_INFO, Block.APPLICATION_INFO,
    Block.FRAME_RATE_INFO, Block.OBJECT_QUALITY, Block.CONTENTS,
)  # fmt: skip


class MalformedError(ValueError):
    """The bytes are not a DataStream."""


class Fields:
    """Reads the fields of a block in order."""

    def __init__(self, data: memoryview):
        self._data, self._at = data, 0

    def take(self, layout: struct.Struct) -> tuple:
        """Read the fields of this layout."""
        try:
            values = layout.unpack_from(self._data, self._at)
        except struct.error as why:
            raise MalformedError(str(why)) from why
        self._at += layout.size
        return values

    def count(self, smallest: int) -> int:
        """Read how many items follow, each of at least `smallest` bytes."""
        (count,) = self.take(_U32)
        if count * smallest > len(self._data) - self._at:
            raise MalformedError(f"{count} items in {len(self._data) - self._at} bytes")
        return count

    def string(self) -> str:
        """Read a text."""
        size = self.count(1)
        self._at += size
        return bytes(self._data[self._at - size : self._at]).decode("utf-8", "replace")


_LONGEST_LATENCY = 60.0  # s; a larger value means that the server does not know it
_U32, _I8, _F64 = struct.Struct("<I"), struct.Struct("<b"), struct.Struct("<d")
_IDS_AND_BOUNDS = struct.Struct("<II6f")
_QUALITY = struct.Struct("<Id")


def packet(*blocks: tuple[int, bytes]) -> bytes:
    """Return a packet of these blocks: type and payload."""
    body = b"".join(PACKET_HEAD.pack(kind, len(payload)) + payload for kind, payload in blocks)
    return PACKET_HEAD.pack(OBJECTS, len(body)) + body


def kinds(values: Collection[int]) -> bytes:
    """Return a set of types as bytes."""
    return struct.pack(f"<I{len(values)}I", len(values), *sorted(values))


def read_kinds(payload: memoryview) -> tuple[int, ...]:
    """Return a set of types from bytes."""
    fields = Fields(payload)
    return tuple(fields.take(_U32)[0] for _ in range(fields.count(4)))


def read_blocks(body: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Yield the blocks of a packet's body: type and payload."""
    at = 0
    while at < len(body):
        if len(body) - at < PACKET_HEAD.size:
            raise MalformedError("a block's head is cut off")
        kind, size = PACKET_HEAD.unpack_from(body, at)
        at += PACKET_HEAD.size
        if size > len(body) - at:
            raise MalformedError(f"a block of {size} bytes in {len(body) - at}")
        yield kind, body[at : at + size]
        at += size


@dataclass(slots=True)
class _Known:
    """A subject as its info block describes it."""

    name: str
    segments: dict[int, str]
    tracked: int  # the segment that stands for the body


@dataclass(slots=True)
class Decoder:
    """Decodes frames; keeps the values that a server does not repeat."""

    _subjects: dict[int, _Known] = field(default_factory=dict)
    _seen: dict[int, dict[int, tuple[float, ...]]] = field(default_factory=dict)
    _quality: dict[int, float] = field(default_factory=dict)
    _number: int | None = None
    _rate: float = math.nan
    _latency: float = math.nan
    _y_up: bool = False
    scene: Scene | None = None

    def frame(self, body: memoryview, received: float) -> Frame | None:
        """Return the frame in a packet's body, None if it has none. Raises MalformedError."""
        subjects: dict[int, _Known] = {}
        seen: dict[int, dict[int, tuple[float, ...]]] = {}
        unchanged: tuple[int, ...] = ()
        is_frame = False
        for kind, payload in read_blocks(body):
            fields = Fields(payload)
            if kind == Block.GLOBAL_SEGMENTS:
                number, segments = _segments(fields)
                seen[number] = segments
            elif kind == Block.FRAME_INFO:
                (self._number,) = fields.take(_U32)
                is_frame = True
            elif kind == Block.SUBJECT_INFO:
                number, known = _subject(fields)
                subjects[number] = known
            elif kind == Block.LATENCY_INFO:
                samples = {fields.string(): fields.take(_F64)[0] for _ in range(fields.count(12))}
                latency = sum(samples.values()) if samples else math.nan
                self._latency = latency if abs(latency) < _LONGEST_LATENCY else math.nan
            elif kind == Block.FRAME_RATE_INFO:
                rates = [(fields.string(), fields.take(_F64)[0]) for _ in range(fields.count(12))]
                # The cameras' rate if there are several; the system names it "Hardware".
                self._rate = next((rate for name, rate in rates if rate > 0), math.nan)
            elif kind == Block.OBJECT_QUALITY:
                number, quality = fields.take(_QUALITY)
                self._quality[number] = quality
            elif kind == Block.APPLICATION_INFO:
                self._y_up = fields.take(_I8)[0] == 1
            elif kind == Block.CONTENTS:
                _ = [fields.take(PACKET_HEAD) for _ in range(fields.count(8))]
                unchanged = tuple(fields.take(_U32)[0] for _ in range(fields.count(4)))
        if subjects and subjects != self._subjects:
            self._subjects = subjects
            self.scene = Scene(tuple(_as_subject(known) for known in subjects.values()))
        if Block.GLOBAL_SEGMENTS not in unchanged or seen:
            self._seen = seen
        if not is_frame and Block.FRAME_INFO not in unchanged:
            return None
        return self._picture(received)

    def _picture(self, received: float) -> Frame:
        bodies, hidden = [], []
        for number, known in self._subjects.items():
            pose = self._seen.get(number, {}).get(known.tracked)
            if pose is None:
                hidden.append(known.name)
            else:
                bodies.append(_body(known.name, pose, self._y_up, self._quality.get(number, math.nan)))
        return Frame(received, tuple(bodies), tuple(hidden), self._number, self._rate, self._latency)


def _segments(fields: Fields) -> tuple[int, dict[int, tuple[float, ...]]]:
    (subject,) = fields.take(_U32)
    rows = [fields.take(_SEGMENT) for _ in range(fields.count(_SEGMENT.size))]
    return subject, {row[0]: row[1:] for row in rows}


def _subject(fields: Fields) -> tuple[int, _Known]:
    (subject,) = fields.take(_U32)
    name = fields.string()
    segments: dict[int, str] = {}
    root = None
    for _ in range(fields.count(36)):
        parent, number, *_ = fields.take(_IDS_AND_BOUNDS)
        segments[number] = fields.string()
        if root is None and parent == 0:
            root = number
    # As users of the SDK do: the segment with the body's name, else the root.
    named = next((number for number, segment in segments.items() if segment == name), None)
    tracked = named if named is not None else root if root is not None else next(iter(segments), 0)
    return subject, _Known(name, segments, tracked)


def _as_subject(known: _Known) -> Subject:
    others = [name for number, name in known.segments.items() if number != known.tracked]
    return Subject(known.name, tuple([known.segments[known.tracked], *others] if known.segments else ()))


def _body(name: str, pose: tuple[float, ...], y_up: bool, quality: float) -> TrackedBody:
    """Return a body in metres, with a quaternion from the matrix, and z up."""
    x, y, z = (value / 1000 for value in pose[:3])
    qx, qy, qz, qw = _quaternion(pose[3:])
    if y_up:  # y up to z up: 90° about x, of the world and of the body's axes
        return TrackedBody(name, (x, -z, y), (qx, -qz, qy, qw), quality)
    return TrackedBody(name, (x, y, z), (qx, qy, qz, qw), quality)


def _quaternion(matrix: tuple[float, ...]) -> Quaternion:
    """Return x y z w of a row-major rotation matrix; NaN if it is not a rotation."""
    nowhere = (math.nan, math.nan, math.nan, math.nan)
    a, b, c, d, e, f, g, h, i = matrix
    error = max(
        abs(a * a + b * b + c * c - 1), abs(d * d + e * e + f * f - 1), abs(g * g + h * h + i * i - 1),
        abs(a * d + b * e + c * f), abs(a * g + b * h + c * i), abs(d * g + e * h + f * i),
        abs(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) - 1),
    )  # fmt: skip
    if not error < _ROTATION_ERROR:
        return nowhere
    # Of four equivalent forms, the one with the largest divisor.
    largest = max(a + e + i, a, e, i)
    if largest == a + e + i:
        q = (h - f, c - g, d - b, 1 + a + e + i)
    elif largest == a:
        q = (1 + a - e - i, b + d, c + g, h - f)
    elif largest == e:
        q = (b + d, 1 - a + e - i, f + h, c - g)
    else:
        q = (c + g, f + h, 1 - a - e + i, d - b)
    norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm
