"""Read MAVLink .tlog: a ground station's packets, each after its time (8 bytes, big endian, µs since 1970).

Positions in MAVLink are north, east, down and bodies forward, right, down; ours are z up and forward, left, up, with x
east and y north (LOCAL_NED), or x forward (LOCAL_FRD).
"""

import re
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from cfplan.errors import InputError
from cfplan.recording.importers.mocap_log import (
    LoggedSubject,
    MocapLog,
    growing,
    quaternions,
    unit_quaternions,
    unknown_rotations,
)  # fmt: skip

FORMAT = "MAVLink .tlog"
V1, V2 = 0xFE, 0xFD  # first bytes of a packet
_MAGIC = re.compile(rb"[\xfd\xfe]")
_STAMP = 8  # bytes before each packet
_SIGNED = 0x01  # of a v2 packet's incompatibility flags: 13 bytes of signature follow
_LARGEST = 300  # bytes of a packet
_FIRST, _LAST = 946_684_800_000_000, 4_102_444_800_000_000  # µs: 2000 and 2100, between which a log was made
_LOCAL_FRD = 20
_LOCAL_POSITION, _ATTITUDE, _ATTITUDE_QUATERNION, _ODOMETRY, _SETPOINT = 32, 30, 31, 331, 85
_COLUMNS: dict[int, Callable[[Any], list[float]]] = {  # message: its place, its frame, its attitude
    _LOCAL_POSITION: lambda m: [m.x, m.y, m.z],
    _ATTITUDE: lambda m: [m.yaw, m.pitch, m.roll],
    _ATTITUDE_QUATERNION: lambda m: [m.q2, m.q3, m.q4, m.q1],
    _ODOMETRY: lambda m: [m.x, m.y, m.z, m.frame_id, *m.q[1:], m.q[0]],
    _SETPOINT: lambda m: [m.x, m.y, m.z, m.coordinate_frame],
}
_NED = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])  # its own inverse; x and y change places, z turns over
_FRD = Rotation.from_matrix([[1, 0, 0], [0, -1, 0], [0, 0, -1]])
_LONGEST_GAP = 0.5  # s between attitudes; over longer ones none is made up


def recognises(file: Path, head: bytes) -> bool:
    """Return whether a plausible time stands before a packet's first byte."""
    return len(head) > 8 and head[8] in (V1, V2) and _FIRST < int.from_bytes(head[:8], "big") < _LAST


def read(file: Path) -> MocapLog:
    """Read the positions that each vehicle reported and the setpoints it followed; other bytes are skipped.

    Raises InputError where the extra is not installed.
    """
    try:
        from pymavlink.dialects.v20 import common
    except ImportError as error:
        hint = "pip install 'cfplan[mavlink]'"
        raise InputError(".tlog files need the package pymavlink", where=str(file), hint=hint) from error
    notes: list[str] = []
    packets, truncated = _packets(file.read_bytes(), notes)
    rows: dict[tuple[int, int], list[list[float]]] = defaultdict(list)
    decoder = common.MAVLink(None)
    broken = 0
    for time, packet in packets:
        try:
            message = decoder.decode(bytearray(packet))
        except common.MAVError:
            broken += 1
            continue
        kind = message.get_msgId()
        rows[message.get_srcSystem(), kind].append([time, *_COLUMNS[kind](message)])
    if broken:
        notes.append(f"{broken} packets left out, as their checksums are wrong")
    if truncated:
        notes.append("the last packet is cut off and left out")
    start = min((table[0][0] for table in rows.values()), default=0.0)
    systems: dict[int, dict[int, NDArray]] = defaultdict(dict)
    for (system, kind), listed in sorted(rows.items()):
        table = np.array(listed)
        table = table[growing(table[:, 0], f"messages {kind} of vehicle {system}", notes)]
        table[:, 0] -= start
        systems[system][kind] = table
    subjects = [subject for system, tables in systems.items() for subject in _subjects(f"vehicle {system}", tables)]
    return MocapLog(FORMAT, tuple(subjects), tuple(notes), truncated)


def _packets(data: bytes, notes: list[str]) -> tuple[list[tuple[float, bytes]], bool]:
    """Return (time in s, bytes) of each packet of a kind that is read, and whether the last packet is cut off."""
    packets, skipped, place, cut = [], 0, 0, False
    while place < len(data) and not cut:
        size, kind = _size_and_kind(data[place : place + _STAMP + 10])
        after = place + _STAMP + size
        if size == 0:
            found = _MAGIC.search(data, place + _STAMP + 1)
            after = found.start() - _STAMP if found else len(data)
            skipped += after - place
        elif after > len(data):
            cut = True
        elif kind in _COLUMNS:
            time = int.from_bytes(data[place : place + _STAMP], "big") * 1e-6
            packets.append((time, data[place + _STAMP : after]))
        place = after
    if skipped:
        notes.append(f"{skipped} bytes skipped that are no packet")
    return packets, cut


def _size_and_kind(begin: bytes) -> tuple[int, int]:
    """Return length and kind of the packet behind a time; length 0 where there is none."""
    head = begin[_STAMP:]
    if not _FIRST < int.from_bytes(begin[:_STAMP], "big") < _LAST:
        return 0, 0
    if len(head) == 10 and head[0] == V2:
        return 12 + head[1] + (13 if head[2] & _SIGNED else 0), int.from_bytes(head[7:10], "little")
    if len(head) >= 6 and head[0] == V1:
        return 8 + head[1], head[5]
    if not head or head[0] in (V1, V2):
        return _LARGEST, -1  # cut off within its head
    return 0, 0


def _subjects(name: str, tables: dict[int, NDArray]) -> Iterator[LoggedSubject]:
    if (odometry := tables.get(_ODOMETRY)) is not None:
        yield _subject(f"{name} odometry", odometry, _frame(odometry), unit_quaternions(odometry[:, 5:]))
    if (local := tables.get(_LOCAL_POSITION)) is not None:
        yield _subject(name, local, _NED, _attitude_at(local[:, 0], tables))
    if (setpoint := tables.get(_SETPOINT)) is not None:
        yield _subject(f"{name} setpoint", setpoint, _frame(setpoint), unknown_rotations(len(setpoint)))


def _frame(table: NDArray) -> Rotation:
    return _FRD if len(table) and table[-1, 4] == _LOCAL_FRD else _NED


def _subject(name: str, table: NDArray, world: Rotation, quaternion: NDArray) -> LoggedSubject:
    turned = quaternions(quaternion, lambda known: world * Rotation.from_quat(known) * _FRD)
    with np.errstate(invalid="ignore"):  # a vehicle may report NaN or infinity
        return LoggedSubject(name, table[:, 0], table[:, 1:4] @ world.as_matrix().T, turned)


def _attitude_at(time: NDArray, tables: dict[int, NDArray]) -> NDArray:
    """Return (N, 4) the attitude at each time, NaN where none was reported nearby."""
    found = unknown_rotations(len(time))
    if (table := tables.get(_ATTITUDE_QUATERNION)) is not None:
        turn = unit_quaternions(table[:, 1:])
    elif (table := tables.get(_ATTITUDE)) is not None:
        turn = quaternions(table[:, 1:], lambda angles: Rotation.from_euler("ZYX", angles))
    else:
        return found
    known = np.isfinite(turn).all(axis=1)
    stamps, turn = table[known, 0], turn[known]
    if len(stamps) < 2:
        return found
    after = np.clip(np.searchsorted(stamps, time), 1, len(stamps) - 1)
    held = np.clip(time, stamps[0], stamps[-1])
    near = (np.abs(time - held) < _LONGEST_GAP) & (stamps[after] - stamps[after - 1] < _LONGEST_GAP)
    if near.any():
        found[near] = Slerp(stamps, Rotation.from_quat(turn))(held[near]).as_quat()
    return found
