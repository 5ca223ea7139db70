"""Read MAVLink .tlog: a ground station's packets, each after its time (8 bytes, big endian, µs since 1970).

MAVLink's world axes are north, east, down, its body axes forward, right, down. Here the world's z is up, with x east
and y north (LOCAL_NED) or x forward (LOCAL_FRD), and body axes are forward, left, up.
"""

import re
from collections import defaultdict
from collections.abc import Callable, Iterator
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from cfplan.recording.importers.mocap_log import (
    PLACE,
    QUATERNION,
    YAW_PITCH_ROLL,
    LoggedSubject,
    MocapLog,
    Table,
    attitude,
    in_order,
    quaternions,
    subject,
)  # fmt: skip

FORMAT, EXTRA = "MAVLink .tlog", "mavlink"
_TIME = rb"\0[\x03-\x0e].{6}"  # between 1996 and 2103
HEAD = re.compile(_TIME + rb"(?:[\xfd\xfe]|\Z)", re.DOTALL)  # the packet after it may be cut off
_PACKET = re.compile(  # length, flags and kind of version 2; length and kind of version 1
    _TIME + rb"(?:\xfd(?P<size>.)(?P<flags>.).{4}(?P<kind>...)|\xfe(?P<size_1>.)...(?P<kind_1>.))", re.DOTALL
)
_STAMP = 8  # bytes before each packet
_SIGNED = 0x01  # of a v2 packet's incompatibility flags: 13 bytes of signature follow
_LOCAL_FRD = 20
_GLOBAL_POSITION = 33  # not read, but named in a note if the log has nothing else
_LOCAL_POSITION, _ATTITUDE, _ATTITUDE_QUATERNION, _ODOMETRY, _SETPOINT = 32, 30, 31, 331, 85
_MESSAGES: dict[int, tuple[tuple[str, ...], Callable[[Any], Any]]] = {  # message: channels, and their fields
    _LOCAL_POSITION: (PLACE, attrgetter("x", "y", "z")),
    _ATTITUDE: (YAW_PITCH_ROLL, attrgetter("yaw", "pitch", "roll")),
    _ATTITUDE_QUATERNION: (QUATERNION, attrgetter("q2", "q3", "q4", "q1")),
    _ODOMETRY: ((*PLACE, "frame", *QUATERNION), lambda m: (m.x, m.y, m.z, m.frame_id, *m.q[1:], m.q[0])),
    _SETPOINT: ((*PLACE, "frame"), attrgetter("x", "y", "z", "coordinate_frame")),
}
_SUBJECTS = {_ODOMETRY: " odometry", _LOCAL_POSITION: "", _SETPOINT: " setpoint"}  # suffix of the name, by message
_NED = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])  # its own inverse: swaps x and y, and flips z
_FRD = Rotation.from_matrix([[1, 0, 0], [0, -1, 0], [0, 0, -1]])
_LONGEST_GAP = 0.5  # s between attitudes; longer gaps are not interpolated


def read(file: Path) -> MocapLog:
    """Read the positions that each vehicle reported and the setpoints it followed; other bytes are skipped.

    Raises ImportError without the extra.
    """
    from pymavlink.dialects.v20 import common

    notes: list[str] = []
    packets, truncated = _packets(file.read_bytes(), notes)
    rows: dict[tuple[int, int], list[tuple[float, ...]]] = defaultdict(list)
    decoder = common.MAVLink(None)
    broken = 0
    for time, packet in packets:
        try:
            message = decoder.decode(bytearray(packet))
        except common.MAVError:
            broken += 1
            continue
        kind = message.get_msgId()
        rows[message.get_srcSystem(), kind].append((time, *_MESSAGES[kind][1](message)))
    if broken:
        notes.append(f"{broken} packets left out because of wrong checksums")
    if truncated:
        notes.append("the last packet is cut off and left out")
    start = min((listed[0][0] for listed in rows.values()), default=0.0)
    systems: dict[int, dict[int, Table]] = defaultdict(dict)
    for (system, kind), listed in sorted(rows.items()):
        time, *columns = np.array(listed).T
        table = {"t": time - start, **dict(zip(_MESSAGES[kind][0], columns, strict=True))}
        systems[system][kind] = in_order(table, f"messages {kind} of vehicle {system}", notes)
    subjects = [found for system, tables in systems.items() for found in _subjects(f"vehicle {system}", tables)]
    return MocapLog(FORMAT, tuple(subjects), tuple(notes), truncated)


def _packets(data: bytes, notes: list[str]) -> tuple[list[tuple[float, bytes]], bool]:
    """Return (time in s, bytes) of each packet of a kind that is read, and whether the last packet is cut off."""
    packets, skipped, place, kinds = [], 0, 0, set()
    while head := _PACKET.search(data, place):
        skipped += head.start() - place
        size = 12 + head["size"][0] + 13 * (head["flags"][0] & _SIGNED) if head["size"] else 8 + head["size_1"][0]
        place = head.start() + _STAMP + size
        kind = int.from_bytes(head["kind"] or head["kind_1"], "little")
        kinds.add(kind)
        if kind in _MESSAGES and place <= len(data):
            time = int.from_bytes(head[0][:_STAMP], "big") * 1e-6
            packets.append((time, data[head.start() + _STAMP : place]))
    cut = place > len(data) or HEAD.match(data, place) is not None
    skipped += 0 if cut else len(data) - place
    if skipped:
        notes.append(f"{skipped} bytes skipped that are not packets")
    if not kinds & set(_SUBJECTS):
        where = "global positions only" if _GLOBAL_POSITION in kinds else "no positions"
        notes.append(f"the log has {where}; LOCAL_POSITION_NED and ODOMETRY are read: have the vehicle send these")
    return packets, cut


def _subjects(name: str, tables: dict[int, Table]) -> Iterator[LoggedSubject]:
    """Yield the subjects in one vehicle's messages, in cfplan's axes."""
    for kind, suffix in _SUBJECTS.items():
        if kind not in tables:
            continue
        found = subject(name + suffix, tables[kind])
        world = _FRD if tables[kind].get("frame", (0,))[-1] == _LOCAL_FRD else _NED
        reported = _attitude_at(found.time, tables) if kind == _LOCAL_POSITION else found.quaternion
        turned = quaternions(reported, partial(_turned, world))
        with np.errstate(invalid="ignore"):  # a vehicle may report NaN or infinity
            yield LoggedSubject(found.name, found.time, found.position @ world.as_matrix().T, turned)


def _turned(world: Rotation, reported: NDArray) -> Rotation:
    return world * Rotation.from_quat(reported) * _FRD


def _attitude_at(time: NDArray, tables: dict[int, Table]) -> NDArray:
    """Return the attitude at each time, (N, 4), NaN where none was reported nearby."""
    found = np.full((len(time), 4), np.nan)
    table = tables.get(_ATTITUDE_QUATERNION, tables.get(_ATTITUDE))
    if table is None:
        return found
    turn = attitude(table)
    known = np.isfinite(turn).all(axis=1)
    stamps, turn = table["t"][known], turn[known]
    if len(stamps) < 2:
        return found
    after = np.clip(np.searchsorted(stamps, time), 1, len(stamps) - 1)
    held = np.clip(time, stamps[0], stamps[-1])
    near = (np.abs(time - held) < _LONGEST_GAP) & (stamps[after] - stamps[after - 1] < _LONGEST_GAP)
    if near.any():
        found[near] = Slerp(stamps, Rotation.from_quat(turn))(held[near]).as_quat()
    return found
