"""Read the log that a Crazyflie writes to its microSD card, as the firmware's usddeck.c lays it out, little endian:

u8 0xBC, u16 version, u16 event types
each type: u16 number, name\\0, u16 variables, each `group.name(T)\\0` with T the struct code of its type
records: u16 type, time (version 2: u64 µs, version 1: u32 ms), the values one behind the other
u32 CRC-32 of everything before; missing where the vehicle lost power while it wrote
"""

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cfplan.errors import InputError
from cfplan.recording.importers.mocap_log import (
    LoggedSubject,
    MocapLog,
    growing,
    quaternions,
    unit_quaternions,
    unknown_rotations,
)  # fmt: skip

FORMAT = "Crazyflie microSD log"
MAGIC = 0xBC
_MOST = 64  # event types, and variables of one; the firmware allows 20
_CLOCKS = {1: ("<u4", 1e-3), 2: ("<u8", 1e-6)}  # version: type of a time, and its unit in s
_CODES = {"B": "u1", "b": "i1", "H": "<u2", "h": "<i2", "I": "<u4", "i": "<i4", "f": "<f4", "e": "<f2"}


@dataclass(frozen=True, slots=True)
class _Source:
    """Variables of a group that make a pose."""

    name: str
    group: str
    position: str = "x y z"
    unit: float = 1.0  # m
    quaternion: str = ""
    angles: str = ""  # in degrees, pitch positive nose up as the firmware logs it


SOURCES = (
    _Source("mocap", "locSrv", quaternion="qx qy qz qw"),
    _Source("estimate", "stateEstimate", quaternion="qx qy qz qw", angles="roll pitch yaw"),
    _Source("estimate, compressed", "stateEstimateZ", unit=1e-3),
    _Source("kalman", "kalman", "stateX stateY stateZ", quaternion="q1 q2 q3 q0"),
    _Source("lighthouse", "lighthouse"),
    _Source("setpoint", "ctrltarget", angles="roll pitch yaw"),
)


def recognises(file: Path, head: bytes) -> bool:
    """Return whether it has the log's first byte and a small version."""
    return len(head) >= 3 and head[0] == MAGIC and int.from_bytes(head[1:3], "little") < 16


def read(file: Path) -> MocapLog:
    """Read every pose that was logged: motion capture, estimate, setpoint. Times count from the first record.

    Without its checksum the log was cut off: all whole records are read, and `truncated` says so.
    Raises InputError where the checksum is wrong, the head is damaged, or no variables of a pose were logged.
    """
    data = file.read_bytes()
    unit, types, begin = _head(data, file)
    records: dict[int, list[bytes]] = {number: [] for number in types}
    while (row := types.get(number := int.from_bytes(data[begin : begin + 2], "little"))) is not None:
        after = begin + 2 + row[1].itemsize
        if after > len(data):
            break
        records[number].append(data[begin + 2 : after])
        begin = after
    truncated = _is_truncated(data, begin, number in types, file)
    tables = [(name, np.frombuffer(b"".join(records[number]), row)) for number, (name, row) in types.items()]
    starts = [float(rows["time"][0]) for _, rows in tables if len(rows)]
    if not starts:
        hint = "nothing was logged, or copy it again"
        raise InputError("the log ends before its first record", where=str(file), hint=hint)
    subjects, notes = [], []
    if truncated:
        notes.append("the log ends without its checksum, as when the vehicle loses power; all before that is shown")
    for event, rows in tables:
        time = (rows["time"].astype(float) - min(starts)) * unit
        found = [source for source in SOURCES if _table(rows, source, source.position) is not None]
        if found:
            keep = growing(time, f"records of {event!r}", notes)
            at = "" if event == "fixedFrequency" else f" at {event}"
            subjects += [_subject(source, source.name + at, time[keep], rows[keep]) for source in found]
    if not subjects:
        logged = sorted({name for _, rows in tables for name in (rows.dtype.names or ())[1:]})
        raise InputError(
            f"no position was logged; the variables are {', '.join(logged[:20]) or 'none'}",
            where=str(file),
            hint="log stateEstimate.x, .y, .z and .qx, .qy, .qz, .qw, named in the card's config.txt",
        )
    return MocapLog(FORMAT, tuple(subjects), tuple(notes), truncated)


def _head(data: bytes, file: Path) -> tuple[float, dict[int, tuple[str, np.dtype]], int]:
    """Return the unit of times in s, name and row of each type, and where the records begin."""
    offset = 1

    def number() -> int:
        nonlocal offset
        offset += 2
        return int(struct.unpack_from("<H", data, offset - 2)[0])

    def text() -> str:
        nonlocal offset
        begin, end = offset, data.find(b"\0", offset, offset + 256)
        if end < 0:
            raise ValueError("a name without end")
        offset = end + 1
        return data[begin:end].decode("ascii")

    def count(what: str) -> range:
        if (found := number()) > _MOST:
            raise ValueError(f"{found} {what}")
        return range(found)

    try:
        version = number()
        if version not in _CLOCKS:
            raise InputError(
                f"version {version} of the log; versions 1 and 2 are known",
                where=str(file),
                hint="it was written by newer firmware, or is no log of the microSD card",
            )
        clock, unit = _CLOCKS[version]
        types = {}
        for _ in count("kinds of records"):
            key, name = number(), text()
            columns = [text().rstrip(")").rpartition("(") for _ in count("variables")]
            row = [("time", clock), *((variable, _CODES[code]) for variable, _, code in columns)]
            types[key] = name, np.dtype(row)
    except (struct.error, ValueError, KeyError) as error:
        message = f"the head of the log is damaged or cut off ({error})"
        raise InputError(message, where=str(file), hint="copy it from the card again") from error
    return unit, types, offset


def _is_truncated(data: bytes, end: int, within_record: bool, file: Path) -> bool:
    """Return whether the log was cut off behind its records. Raises InputError where it is whole but damaged."""
    rest = data[end:]
    if len(rest) == 4 and zlib.crc32(memoryview(data)[:end]) == int.from_bytes(rest, "little"):
        return False
    if len(rest) < 2 or within_record:
        return True
    what = "the checksum is wrong" if len(rest) == 4 else f"damaged at byte {end}"
    raise InputError(f"{what}: the log is damaged", where=str(file), hint="copy it from the card again")


def _table(rows: NDArray, source: _Source, names: str) -> NDArray | None:
    """Return (N, K) the variables of these names; None where one was not logged."""
    variables = [f"{source.group}.{name}" for name in names.split()]
    if not variables or not set(variables) <= set(rows.dtype.names or ()):
        return None
    return np.stack([rows[variable].astype(float) for variable in variables], axis=1)


def _subject(source: _Source, name: str, time: NDArray, rows: NDArray) -> LoggedSubject:
    position = np.asarray(_table(rows, source, source.position)) * source.unit
    if (turn := _table(rows, source, source.quaternion)) is not None:
        return LoggedSubject(name, time, position, unit_quaternions(turn))
    if (turn := _table(rows, source, source.angles)) is not None:
        nose_up = turn[:, ::-1] * [1, -1, 1]  # the firmware's pitch counts the other way
        turned = quaternions(nose_up, lambda angles: Rotation.from_euler("ZYX", angles, degrees=True))
        return LoggedSubject(name, time, position, turned)
    return LoggedSubject(name, time, position, unknown_rotations(len(time)))
