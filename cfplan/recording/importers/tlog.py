"""Read MAVLink .tlog: a ground station's packets, each after its time (8 bytes, big endian, µs since 1970).

Positions in MAVLink are north, east, down and bodies forward, right, down; ours are z up and forward, left, up, with x
east and y north (LOCAL_NED), or x forward (LOCAL_FRD).
"""

import mmap
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from cfplan.errors import InputError
from cfplan.recording.importers.mocap_log import LoggedSubject, MocapLog, ascending, unit_quaternions

FORMAT = "MAVLink .tlog"
V1, V2 = 0xFE, 0xFD  # first bytes of a packet
_MAGIC = re.compile(rb"[\xfd\xfe]")
_STAMP = 8  # bytes before each packet
_SIGNED = 0x01  # of a v2 packet's incompatibility flags: 13 bytes of signature follow
_LARGEST = 300  # bytes of a packet
_FIRST, _LAST = 946_684_800_000_000, 4_102_444_800_000_000  # µs: 2000 and 2100, between which a log was made
_LOCAL_FRD = 20
_LOCAL_POSITION, _ATTITUDE, _ATTITUDE_QUATERNION, _ODOMETRY, _SETPOINT = 32, 30, 31, 331, 85
_READ = (_LOCAL_POSITION, _ATTITUDE, _ATTITUDE_QUATERNION, _ODOMETRY, _SETPOINT)
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
        raise InputError(
            ".tlog files need the package pymavlink", where=str(file), hint="pip install 'cfplan[mavlink]'"
        ) from error
    rows: dict[tuple[int, int], list[list[float]]] = defaultdict(list)
    frames: dict[tuple[int, int], int] = {}
    decoder = common.MAVLink(None)
    broken = 0
    with file.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        packets = _Packets(data)
        for time, packet in packets:
            try:
                message = decoder.decode(bytearray(packet))
            except common.MAVError:
                broken += 1
                continue
            kind = message.get_msgId()
            rows[message.get_srcSystem(), kind].append([time, *_values(message, kind)])
            if kind in (_ODOMETRY, _SETPOINT):
                frame = message.frame_id if kind == _ODOMETRY else message.coordinate_frame
                frames[message.get_srcSystem(), kind] = frame
    notes = []
    if packets.skipped:
        notes.append(f"{packets.skipped} bytes skipped that are no packet")
    if broken:
        notes.append(f"{broken} packets left out, as their checksums are wrong")
    if packets.cut:
        notes.append("the last packet is cut off and left out")
    start = min((table[0][0] for table in rows.values()), default=0.0)
    tables = {key: _grown(np.array(table), start) for key, table in rows.items()}
    subjects = [s for system in sorted({system for system, _ in tables}) for s in _subjects(system, tables, frames)]
    return MocapLog(FORMAT, tuple(subjects), tuple(notes), truncated=packets.cut)


class _Packets:
    """Yields (time in s, bytes) of each packet of a kind that is read; counts the bytes that it skips."""

    def __init__(self, data: mmap.mmap):
        self.data = data
        self.skipped = 0  # bytes
        self.cut = False

    def __iter__(self) -> Iterator[tuple[float, bytes]]:
        place, last = 0, len(self.data)
        while place < last:
            size, kind = self._packet(place + _STAMP)
            if size == 0:
                found = _MAGIC.search(self.data, place + _STAMP + 1)
                after = found.start() - _STAMP if found else last
                self.skipped += after - place
                place = after
                continue
            after = place + _STAMP + size
            if after > last:
                self.cut = True
                return
            if kind in _READ:
                time = int.from_bytes(self.data[place : place + _STAMP], "big") * 1e-6
                yield time, self.data[place + _STAMP : after]
            place = after

    def _packet(self, place: int) -> tuple[int, int]:
        """Return length and kind of the packet there; length 0 where there is none."""
        head = self.data[place : place + 10]
        stamp = int.from_bytes(self.data[place - _STAMP : place], "big")
        if not _FIRST < stamp < _LAST:
            return 0, 0
        if len(head) == 10 and head[0] == V2:
            return 12 + head[1] + (13 if head[2] & _SIGNED else 0), int.from_bytes(head[7:10], "little")
        if len(head) >= 6 and head[0] == V1:
            return 8 + head[1], head[5]
        if not head or head[0] in (V1, V2):
            return _LARGEST, -1  # cut off within its head
        return 0, 0


def _values(message: Any, kind: int) -> list[float]:
    if kind == _ATTITUDE:
        return list(Rotation.from_euler("ZYX", [message.yaw, message.pitch, message.roll]).as_quat())
    if kind == _ATTITUDE_QUATERNION:
        return [message.q2, message.q3, message.q4, message.q1]
    place = [message.x, message.y, message.z]
    return [*place, *message.q[1:], message.q[0]] if kind == _ODOMETRY else place


def _grown(table: NDArray, start: float) -> NDArray:
    table = table[ascending(table[:, 0])]
    table[:, 0] -= start
    return table


def _subjects(
    system: int, tables: dict[tuple[int, int], NDArray], frames: dict[tuple[int, int], int]
) -> Iterator[LoggedSubject]:
    odometry = tables.get((system, _ODOMETRY))
    if odometry is not None:
        world = _FRD if frames[system, _ODOMETRY] == _LOCAL_FRD else _NED
        yield _subject(f"vehicle {system} odometry", world, odometry[:, 0], odometry[:, 1:4], odometry[:, 4:])
    local = tables.get((system, _LOCAL_POSITION))
    if local is not None:
        attitude = tables.get((system, _ATTITUDE_QUATERNION), tables.get((system, _ATTITUDE)))
        turn = _at(local[:, 0], attitude) if attitude is not None else np.full((len(local), 4), np.nan)
        yield _subject(f"vehicle {system}", _NED, local[:, 0], local[:, 1:4], turn)
    setpoint = tables.get((system, _SETPOINT))
    if setpoint is not None:
        world = _FRD if frames[system, _SETPOINT] == _LOCAL_FRD else _NED
        unknown = np.full((len(setpoint), 4), np.nan)
        yield _subject(f"vehicle {system} setpoint", world, setpoint[:, 0], setpoint[:, 1:4], unknown)


def _subject(name: str, world: Rotation, time: NDArray, position: NDArray, quaternion: NDArray) -> LoggedSubject:
    turn = unit_quaternions(quaternion, tolerance=np.inf)
    known = np.isfinite(turn).all(axis=1)
    if known.any():
        turn[known] = (world * Rotation.from_quat(turn[known]) * _FRD).as_quat()
    with np.errstate(invalid="ignore"):  # a vehicle may report NaN or infinity
        return LoggedSubject(name, time, position @ world.as_matrix().T, turn)


def _at(time: NDArray, attitude: NDArray) -> NDArray:
    """Return (N, 4) the attitude at each time, NaN where none was reported nearby."""
    turn = unit_quaternions(attitude[:, 1:], tolerance=np.inf)
    known = np.isfinite(turn).all(axis=1)
    stamps, turn = attitude[known, 0], turn[known]
    found = np.full((len(time), 4), np.nan)
    if len(stamps) < 2:
        return found
    after = np.clip(np.searchsorted(stamps, time), 1, len(stamps) - 1)
    held = np.clip(time, stamps[0], stamps[-1])
    near = (np.abs(time - held) < _LONGEST_GAP) & (stamps[after] - stamps[after - 1] < _LONGEST_GAP)
    if near.any():
        found[near] = Slerp(stamps, Rotation.from_quat(turn))(held[near]).as_quat()
    return found
