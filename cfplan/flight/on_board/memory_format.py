"""The firmware's trajectory memory: 4,096 bytes of raw or compressed pieces.

Raw (poly4d): 8 float32 coefficients each of x, y, z and yaw, and a float32 duration; 132 bytes, so 31 pieces.

Compressed (src/modules/src/pptraj_compressed.c): x, y, z in mm and yaw in 0.1°, int16, of the start; then for each
piece a byte with two bits per axis for the number of Bézier control points (0, 1, 3 or 7), a uint16 duration in ms, and
those points. The first control point of a piece is the end of the piece before. A piece of zero duration ends the
trajectory; without it, the firmware would read on into the bytes behind.
"""

import struct
from dataclasses import dataclass
from math import factorial

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import NotCertifiedError
from cfplan.flight.on_board.pieces import AXES, COUNT, Pieces

MEMORY_SIZE = 4096  # bytes
PIECE_SIZE = 4 * (AXES * COUNT + 1)  # bytes
MOST_PIECES = MEMORY_SIZE // PIECE_SIZE
POINTS = COUNT - 1  # most stored control points of a piece
STEPS = np.array([1e-3, 1e-3, 1e-3, np.radians(0.1)])  # m, m, m, rad: one in a stored control point
LONGEST = 65.535  # s, of a compressed piece
YAW_READ_SINCE = (2026, 8)  # the first firmware that reads the yaw of compressed pieces in 0.1°; earlier: in 10 rad
_POINTS_OF_TYPE = (0, 1, 3, POINTS)
_SCALES = np.array([1000.0, 1000.0, 1000.0, np.float32(1800.0) / np.float32(np.pi)], dtype=np.float32)
_HEADER = struct.Struct("<BH")
_START = struct.Struct("<4h")
START_SIZE = _START.size  # bytes
END = _HEADER.pack(0, 0)  # after the last compressed piece


@dataclass(frozen=True, slots=True)
class ControlPoints:
    """Compressed pieces, before encoding."""

    start: NDArray  # (4,) in STEPS
    durations: NDArray  # (K,) ms
    points: NDArray  # (K, 4, 7) in STEPS

    @property
    def moves(self) -> NDArray:
        """Return whether each axis moves in each piece, (K, 4): an axis at rest needs no points."""
        before = np.concatenate([self.start[None], self.points[:-1, :, -1]])
        return np.asarray((self.points != before[:, :, None]).any(axis=2))


def raw_bytes(pieces: Pieces) -> bytes:
    """Return the bytes of raw pieces. Raises NotCertifiedError if there are too many."""
    count = len(pieces.durations)
    if count > MOST_PIECES:
        raise NotCertifiedError(
            f"{count} pieces, but the vehicle's memory holds {MOST_PIECES}", where="trajectory memory",
            hint="compress them",
        )  # fmt: skip
    rows = np.concatenate([pieces.coefficients.reshape(count, -1), pieces.durations[:, None]], axis=1)
    return rows.astype("<f4").tobytes()


def read_raw(memory: bytes, count: int, offset: int = 0) -> Pieces:
    """Return `count` pieces as the firmware reads them. Raises NotCertifiedError if they are invalid."""
    if not 0 < count * PIECE_SIZE <= len(memory) - offset:
        raise NotCertifiedError(
            f"{count} pieces from byte {offset} on do not lie in {len(memory)} bytes", where="trajectory memory",
            hint="upload the trajectory again",
        )  # fmt: skip
    rows = np.frombuffer(memory, "<f4", count * PIECE_SIZE // 4, offset).reshape(count, -1)
    return Pieces(rows[:, -1], rows[:, :-1].reshape(count, AXES, COUNT))


def compressed_size(moves: NDArray) -> int:
    """Return the size, in bytes, of compressed pieces whose axes move or not, (K, 4)."""
    return _START.size + len(moves) * _HEADER.size + 2 * POINTS * int(np.sum(moves)) + _HEADER.size


def compressed_bytes(curve: ControlPoints, room: int = MEMORY_SIZE) -> bytes:
    """Return the bytes of compressed pieces, at most `room`.

    Raises NotCertifiedError if they do not fit, or a control point does not fit 16 bits.
    """
    moves = curve.moves
    size = compressed_size(moves)
    if size > room:
        raise NotCertifiedError(
            f"{size} bytes, but the vehicle's memory holds {room}", where="trajectory memory",
            hint="use fewer, longer pieces",
        )  # fmt: skip
    if max(np.abs(curve.points).max(), np.abs(curve.start).max()) > 32767:
        raise NotCertifiedError(
            "a control point beyond 32.767 m or 3276.7°", where="trajectory memory",
            hint="move the path nearer to the origin, or turn less",
        )  # fmt: skip
    if curve.durations.min() < 1 or curve.durations.max() > 1000 * LONGEST:
        raise NotCertifiedError(
            f"a compressed piece lasts from 0.001 to {LONGEST:g} s", where="trajectory memory",
            hint="fly faster, or wait less",
        )  # fmt: skip
    parts = [_START.pack(*curve.start.tolist())]
    for duration, points, moving in zip(curve.durations.tolist(), curve.points, moves, strict=True):
        parts.append(_HEADER.pack(sum(3 << (2 * axis) for axis in range(AXES) if moving[axis]), duration))
        parts.append(points[moving].astype("<i2").tobytes())
    return b"".join([*parts, END])


def read_compressed(memory: bytes, offset: int = 0) -> Pieces:
    """Return compressed pieces as the firmware reads them, rounded to float32 where it rounds.

    Raises NotCertifiedError if they do not end within the memory, or there is no piece.
    """
    durations, coefficients = [], []
    try:
        end = (np.array(_START.unpack_from(memory, offset)) / _SCALES).astype(np.float32)
        place = offset + _START.size
        while True:
            types, milliseconds = _HEADER.unpack_from(memory, place)
            place += _HEADER.size
            if not milliseconds:
                break
            duration, table = np.float32(milliseconds / 1000.0), np.zeros((AXES, COUNT), dtype=np.float32)
            for axis in range(AXES):
                count = _POINTS_OF_TYPE[(types >> (2 * axis)) & 3]
                stored = np.array(struct.unpack_from(f"<{count}h", memory, place), dtype=np.float32) / _SCALES[axis]
                place += 2 * count
                table[axis] = _polynomial(np.append(end[axis], stored), duration)
            end = _at(table, duration)
            durations.append(duration)
            coefficients.append(table)
    except struct.error:
        raise NotCertifiedError(
            "compressed pieces that do not end", where="trajectory memory", hint="upload the trajectory again"
        ) from None
    return Pieces(np.array(durations), np.array(coefficients).reshape(-1, AXES, COUNT))


def _polynomial(points: NDArray, duration: np.float32) -> NDArray:
    """Return the coefficients, (8,) float32, of a Bézier curve of 1, 2, 4 or 8 points, step by step as on board."""
    out = np.zeros(COUNT, dtype=np.float32)
    degree, single = len(points) - 1, np.float32
    out[0] = points[0]
    if degree == 1:
        out[1] = (points[1] - points[0]) / duration
    if degree < 2:
        return out
    for j in range(degree + 1):
        total = single(0.0)
        for i in range(j + 1):
            sign = single(-1.0 if (i + j) % 2 else 1.0)
            total += sign * points[i] / single(factorial(i)) / single(factorial(j - i))
        out[j] = total * single(factorial(degree)) / single(factorial(degree - j))
    shrink = scale = single(1.0) / duration
    for power in range(1, COUNT):
        out[power] *= scale
        scale *= shrink
    return out


def _at(table: NDArray, time: np.float32) -> NDArray:
    """Return polynomials, (4, 8) float32, at one time, (4,)."""
    value = np.zeros(AXES, dtype=np.float32)
    for power in range(COUNT - 1, -1, -1):
        value = value * time + table[:, power]
    return value
