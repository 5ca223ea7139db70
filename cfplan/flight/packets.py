"""Full-state setpoints as the 29 bytes that go over the radio, and back.

CRTP port 7 channel 0; `<B 3h 3h 3h I 3h`: type 6, position mm, velocity mm/s, acceleration mm/s² (without gravity),
quaternion compressed to its three smallest components, body rates in millirad/s (whatever cflib's docstring says).
cflib's own call truncates towards zero; here values are rounded, which halves the error and removes the bias.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import NotCertifiedError

CRTP_PORT = 7
FULL_STATE_TYPE = 6
LARGEST = 32.767  # the most that 16 bits hold of m, m/s, m/s², rad/s

_WIRE = np.dtype(
    [
        ("type", "u1"),
        ("position", "<i2", 3),
        ("velocity", "<i2", 3),
        ("acceleration", "<i2", 3),
        ("quaternion", "<u4"),
        ("body_rate", "<i2", 3),
    ]
)
PAYLOAD_SIZE = _WIRE.itemsize
_MAGNITUDES = 511  # nine bits for a component in [0, 1/√2]


@dataclass(frozen=True, slots=True)
class FullStateSetpoints:
    """What the controller is asked to do, one row a setpoint."""

    position: NDArray
    # (N, 3) m
    velocity: NDArray
    # (N, 3) m/s
    acceleration: NDArray
    # (N, 3) m/s², without gravity
    quaternion: NDArray
    # (N, 4) body→world, x y z w
    body_rate: NDArray
    # (N, 3) rad/s, body axes


def encode(setpoints: FullStateSetpoints) -> NDArray:
    """The payloads, (N, 29) uint8. Raises NotCertifiedError where a value is not finite or does not fit."""
    rows = np.zeros(len(setpoints.position), dtype=_WIRE)
    rows["type"] = FULL_STATE_TYPE
    for name in ("position", "velocity", "acceleration", "body_rate"):
        rows[name] = _milli(name, getattr(setpoints, name))
    rows["quaternion"] = compress_quaternion(setpoints.quaternion)
    return rows.view(np.uint8).reshape(-1, PAYLOAD_SIZE)


def decode(payloads: NDArray) -> FullStateSetpoints:
    """What the vehicle will read from the payloads, (N, 29) uint8.

    Encoding that again may give other bytes that read alike: a zero in the quaternion has two signs, and of two
    components that tie for the largest either may be left out.
    """
    rows = np.ascontiguousarray(payloads, dtype=np.uint8).reshape(-1).view(_WIRE)
    return FullStateSetpoints(
        position=rows["position"] / 1000.0,
        velocity=rows["velocity"] / 1000.0,
        acceleration=rows["acceleration"] / 1000.0,
        quaternion=decompress_quaternion(rows["quaternion"]),
        body_rate=rows["body_rate"] / 1000.0,
    )


def _milli(name: str, values: NDArray) -> NDArray:
    bad = ~(np.abs(values) <= LARGEST)
    if np.any(bad):
        row = int(np.flatnonzero(bad.any(axis=1))[0])
        raise NotCertifiedError(
            f"{name} {np.asarray(values)[row]} does not fit a packet (at most {LARGEST})", where=f"setpoint {row}"
        )
    return np.round(np.asarray(values) * 1000.0).astype("<i2")


def compress_quaternion(quaternion: NDArray) -> NDArray:
    """(N, 4) x y z w, not zero, to (N,) u32: 2 bits name the largest component, 3 × (sign, 9 bits) give the others."""
    q = np.asarray(quaternion, dtype=float)
    norm = np.linalg.norm(q, axis=1, keepdims=True)
    bad = ~(np.isfinite(norm) & (norm > 0))
    if np.any(bad):
        raise NotCertifiedError("the quaternion is zero or not finite", where=f"setpoint {int(np.argmax(bad))}")
    q = q / norm
    rows = np.arange(len(q))
    largest = np.argmax(np.abs(q), axis=1)
    q = q * np.where(q[rows, largest] < 0, -1.0, 1.0)[:, None]
    others = _other_components(largest)
    small = q[rows[:, None], others]
    magnitude = np.minimum(np.floor(np.abs(small) * np.sqrt(2.0) * _MAGNITUDES + 0.5), _MAGNITUDES).astype(np.uint32)
    fields = magnitude | ((small < 0).astype(np.uint32) << 9)
    return (largest.astype(np.uint32) << 30) | (fields[:, 0] << 20) | (fields[:, 1] << 10) | fields[:, 2]


def decompress_quaternion(compressed: NDArray) -> NDArray:
    """(N,) u32 to (N, 4) unit quaternions x y z w, the largest component positive."""
    bits = np.asarray(compressed, dtype=np.uint32)
    rows = np.arange(len(bits))
    largest = (bits >> 30).astype(int)
    fields = np.stack([(bits >> shift) & 0x3FF for shift in (20, 10, 0)], axis=1)
    small = (fields & 0x1FF) / (_MAGNITUDES * np.sqrt(2.0)) * np.where(fields >> 9, -1.0, 1.0)
    q = np.zeros((len(bits), 4))
    q[rows[:, None], _other_components(largest)] = small
    q[rows, largest] = np.sqrt(np.maximum(0.0, 1.0 - np.sum(small**2, axis=1)))
    return q


def _other_components(largest: NDArray) -> NDArray:
    """(N, 3) indices of the components that are not the largest, ascending."""
    every = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
    return every[largest]
