"""Full-state setpoints as the 29 bytes that go over the radio, and back.

CRTP port 7 channel 0; `<B 3h 3h 3h I 3h`: type 6, position mm, velocity mm/s, acceleration mm/s² (without gravity),
quaternion compressed to its three smallest components, body rates in millirad/s (cflib's docstring is wrong).
cflib's own call truncates towards zero; here values are rounded, which halves the error and removes the bias.
"""

import math
from dataclasses import dataclass
from struct import Struct

import numpy as np
from numba.extending import register_jitable
from numpy.typing import ArrayLike, NDArray

from cfplan.errors import NotCertifiedError
from cfplan.machine_code import njit

CRTP_PORT = 7
FULL_STATE_TYPE = 6
HALF_QUANTUM = 0.5e-3  # of position m, velocity m/s, acceleration m/s², body rate rad/s
ATTITUDE_QUANTUM = math.radians(0.25)  # the largest angle by which compressing turns a quaternion
LARGEST = 32.767  # the largest value that 16 bits hold, in m, m/s, m/s² or rad/s

_WIRE_OF_ONE = Struct("<B9hI3h")
PAYLOAD_SIZE = _WIRE_OF_ONE.size
_IN_MILLI = ("position", "velocity", "acceleration", "body_rate")
FIELD_PLACES = (1, 7, 13, 23)  # bytes where these begin in a payload
QUATERNION_PLACE = 19
_MAGNITUDES = 511  # nine bits for a component in [0, 1/√2]


@dataclass(frozen=True, slots=True)
class FullStateSetpoints:
    """What the controller is asked to do, one row a setpoint."""

    position: NDArray  # (N, 3) m
    velocity: NDArray  # (N, 3) m/s
    acceleration: NDArray  # (N, 3) m/s², without gravity
    quaternion: NDArray  # (N, 4) body→world, x y z w
    body_rate: NDArray  # (N, 3) rad/s, body axes


def arrays_of(setpoints: FullStateSetpoints) -> tuple[NDArray, ...]:
    """Return the fields in their order, as arrays of one type for compiled code."""
    return tuple(np.array(getattr(setpoints, name), dtype=float, order="C") for name in FullStateSetpoints.__slots__)


def encode(setpoints: FullStateSetpoints) -> NDArray:
    """Return the payloads, (N, 29) uint8. Raises NotCertifiedError where a value is not finite or does not fit."""
    compressed = compress_quaternion(setpoints.quaternion)
    payloads = np.empty((len(compressed), PAYLOAD_SIZE), dtype=np.uint8)
    position, velocity, acceleration, _, rate = arrays_of(setpoints)
    values = position, velocity, acceleration, rate
    bad, field = _packed(payloads, values, compressed)
    if bad >= 0:
        raise NotCertifiedError(
            f"{_IN_MILLI[field]} {values[field][bad]} does not fit a packet (at most {LARGEST})",
            where=f"setpoint {bad}",
            hint="keep the flight within that of the room's origin, and its limits below that",
        )
    return payloads


def decode(payloads: NDArray) -> FullStateSetpoints:
    """Return what the vehicle reads from the payloads, (N, 29) uint8.

    Encoding that again may give other bytes that read alike: a zero in the quaternion has two signs, and of two
    components that tie for the largest either may be left out.
    """
    rows = np.ascontiguousarray(payloads, dtype=np.uint8).reshape(-1, PAYLOAD_SIZE)
    numbers, compressed = _unpacked(rows)
    return FullStateSetpoints(
        position=numbers[0],
        velocity=numbers[1],
        acceleration=numbers[2],
        quaternion=_decompressed(compressed),
        body_rate=numbers[3],
    )


def decode_one(payload: bytes) -> list[float]:
    """Return the 16 numbers that the vehicle reads from one payload, in the order of FullStateSetpoints' fields."""
    _, *milli, quaternion, roll, pitch, yaw = _WIRE_OF_ONE.unpack(payload)
    turn = decompress_quaternion([quaternion])[0].tolist()
    return [*(value / 1000.0 for value in milli), *turn, roll / 1000.0, pitch / 1000.0, yaw / 1000.0]


def compress_quaternion(quaternion: NDArray) -> NDArray:
    """Compress (N, 4) x y z w, not zero, to (N,) u32.

    2 bits name the largest component, 3 × (sign, 9 bits) give the others.
    """
    compressed, bad = _compressed(np.array(quaternion, dtype=float))
    if bad >= 0:
        raise NotCertifiedError(
            "the quaternion is zero or not finite", where=f"setpoint {bad}", hint="plan the trajectory anew"
        )
    return compressed


def decompress_quaternion(compressed: ArrayLike) -> NDArray:
    """Decompress (N,) u32 to (N, 4) unit quaternions x y z w, the largest component positive."""
    return _decompressed(np.array(compressed, dtype=np.int64))


def positions_of(payloads: NDArray) -> NDArray:
    """Return the positions, (..., 3) m, of payloads, (..., 29) uint8, in less time than decode()."""
    begin = FIELD_PLACES[0]
    return np.ascontiguousarray(payloads[..., begin : begin + 6]).view("<i2") * 1e-3


@njit(error_model="numpy")
def _packed(out: NDArray, values: tuple[NDArray, ...], compressed: NDArray) -> tuple[int, int]:
    """Write the payloads, (N, 29), from the fields of _IN_MILLI, (N, 3) each, and the compressed quaternions, (N,).

    Returned are the first row that does not fit, -1 where all do, and its field.
    """
    for n in range(len(out)):
        out[n, 0] = FULL_STATE_TYPE
        for field in range(4):
            for axis in range(3):
                value = values[field][n, axis]
                if not abs(value) <= LARGEST:
                    return n, field
                milli, place = int(np.rint(value * 1000.0)), FIELD_PLACES[field] + 2 * axis
                out[n, place], out[n, place + 1] = milli & 255, (milli >> 8) & 255
        for byte in range(4):
            out[n, QUATERNION_PLACE + byte] = (compressed[n] >> (8 * byte)) & 255
    return -1, 0


@njit(error_model="numpy")
def _unpacked(payloads: NDArray) -> tuple[NDArray, NDArray]:
    """Return the fields of _IN_MILLI, (4, N, 3), in m, m/s, m/s² and rad/s, and the compressed quaternions, (N,)."""
    numbers, compressed = np.empty((4, len(payloads), 3)), np.empty(len(payloads), dtype=np.int64)
    for n in range(len(payloads)):
        for field in range(4):
            for axis in range(3):
                place = FIELD_PLACES[field] + 2 * axis
                bits = int(payloads[n, place]) | int(payloads[n, place + 1]) << 8
                numbers[field, n, axis] = (bits - 65536 if bits >= 32768 else bits) / 1000.0
        bits = 0
        for byte in range(4):
            bits |= int(payloads[n, QUATERNION_PLACE + byte]) << (8 * byte)
        compressed[n] = bits
    return numbers, compressed


@njit(error_model="numpy")
def _compressed(quaternions: NDArray) -> tuple[NDArray, int]:
    """Return the compressed quaternions, and the first row that is zero or not finite, else -1."""
    out = np.empty(len(quaternions), dtype=np.uint32)
    for n in range(len(quaternions)):
        q = quaternions[n]
        norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
        if not (math.isfinite(norm) and norm > 0.0):
            return out, n
        largest = 0
        for k in range(1, 4):
            if abs(q[k]) > abs(q[largest]):
                largest = k
        bits = largest
        for k in range(4):
            if k != largest:
                # The sign of the largest is not sent, so all change theirs where it is negative.
                small = -q[k] / norm if q[largest] < 0.0 else q[k] / norm
                magnitude = min(math.floor(abs(small) * math.sqrt(2.0) * _MAGNITUDES + 0.5), _MAGNITUDES)
                bits = bits << 10 | (512 if small < 0.0 else 0) | magnitude
        out[n] = bits
    return out, -1


@njit(error_model="numpy")
def _decompressed(compressed: NDArray) -> NDArray:
    out = np.empty((len(compressed), 4))
    for n in range(len(compressed)):
        out[n, 0], out[n, 1], out[n, 2], out[n, 3] = decompressed(compressed[n])
    return out


@register_jitable(forceinline=True)
def decompressed(bits: int) -> tuple[float, float, float, float]:
    """Return the quaternion x, y, z, w of its 32 bits.

    Without branches, so that the compiler can vectorise it.
    """
    first, second, third = _small(bits >> 20), _small(bits >> 10), _small(bits)
    square = 1.0 - first * first - second * second - third * third
    largest = math.sqrt(square if square > 0.0 else 0.0)
    in_x, in_x_or_y, not_in_w = bits < 1 << 30, bits < 2 << 30, bits < 3 << 30
    return (
        largest if in_x else first,
        first if in_x else largest if in_x_or_y else second,
        second if in_x_or_y else largest if not_in_w else third,
        third if not_in_w else largest,
    )


@register_jitable(forceinline=True)
def _small(bits: int) -> float:
    """Return a component other than the largest, from its sign and nine bits."""
    size = (bits & 0x1FF) / (_MAGNITUDES * math.sqrt(2.0))
    return -size if bits & 0x200 else size
