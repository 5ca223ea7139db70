"""Read the log that a Crazyflie writes to its microSD card, as the firmware's usddeck.c lays it out, little endian:

u8 0xBC, u16 version, u16 event types
each type: u16 number, name\\0, u16 variables, each `group.name(T)\\0` with T the struct code of its type
records: u16 type, time (version 2: u64 µs, version 1: u32 ms), the values one behind the other
u32 CRC-32 of everything before; missing where the vehicle lost power while it wrote
"""

import mmap
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cfplan.errors import InputError
from cfplan.recording.importers.mocap_log import LoggedSubject, MocapLog, ascending, unit_quaternions

FORMAT = "Crazyflie microSD log"
MAGIC = 0xBC
_MOST = 64  # event types, and variables of one; the firmware allows 20
BLOCK = 1 << 24  # bytes checked or gathered at a time
_TIMES = {1: (np.dtype("<u4"), 1e-3), 2: (np.dtype("<u8"), 1e-6)}  # of a record, and its unit in s
_CODES = {"B": "u1", "b": "i1", "H": "<u2", "h": "<i2", "I": "<u4", "i": "<i4", "f": "<f4", "e": "<f2"}


@dataclass(frozen=True, slots=True)
class _Source:
    """Variables that make a pose."""

    name: str
    position: tuple[str, ...]
    scale: float  # to m
    quaternion: tuple[str, ...] = ()
    angles: tuple[str, ...] = ()  # roll, pitch, yaw in degrees, pitch positive nose up as the firmware logs it


def _axes(group: str, names: str) -> tuple[str, ...]:
    return tuple(f"{group}.{name}" for name in names.split())


SOURCES = (
    _Source("mocap", _axes("locSrv", "x y z"), 1.0, _axes("locSrv", "qx qy qz qw")),
    _Source("estimate", _axes("stateEstimate", "x y z"), 1.0, _axes("stateEstimate", "qx qy qz qw"),
            _axes("stateEstimate", "roll pitch yaw")),
    _Source("estimate, compressed", _axes("stateEstimateZ", "x y z"), 1e-3),
    _Source("kalman", _axes("kalman", "stateX stateY stateZ"), 1.0, _axes("kalman", "q1 q2 q3 q0")),
    _Source("lighthouse", _axes("lighthouse", "x y z"), 1.0),
    _Source("setpoint", _axes("ctrltarget", "x y z"), 1.0, (), _axes("ctrltarget", "roll pitch yaw")),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class _EventType:
    """One kind of record."""

    name: str
    row: np.dtype


def recognises(file: Path, head: bytes) -> bool:
    """Return whether it has the log's first byte and a small version."""
    return len(head) >= 3 and head[0] == MAGIC and int.from_bytes(head[1:3], "little") < 16


def read(file: Path, *, block: int = BLOCK) -> MocapLog:
    """Read every pose that was logged: motion capture, estimate, setpoint. Times count from the first record.

    Without its checksum the log was cut off: all whole records are read, and `truncated` says so.
    Raises InputError where the checksum is wrong, the head is damaged, or no variables of a pose were logged.
    """
    with file.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        version, types, begin = _head(data, file)
        places, end = _places(data, types, begin)
        truncated = _check_end(data, types, end, file, block)
        tables = {
            types[number].name: _rows(data, types[number].row, np.array(offsets, dtype=np.int64), block)
            for number, offsets in places.items()
        }
    starts = [float(rows["time"][0]) for rows in tables.values() if len(rows)]
    if not starts:
        raise InputError(
            "the log ends before its first record", where=str(file), hint="nothing was logged, or copy it again"
        )
    scale = _TIMES[version][1]
    subjects, notes = [], []
    for event, rows in tables.items():
        found = [_subject(source, rows, min(starts), scale) for source in SOURCES if _has(rows, source.position)]
        subjects += found if event == "fixedFrequency" else [_renamed(subject, event) for subject in found]
    if not subjects:
        logged = sorted({name for kind in types.values() for name in (kind.row.names or ())[1:]})
        raise InputError(
            f"no position was logged; the variables are {', '.join(logged[:20]) or 'none'}",
            where=str(file),
            hint="log stateEstimate.x, .y, .z and .qx, .qy, .qz, .qw, named in the card's config.txt",
        )
    if truncated:
        notes.append("the log ends without its checksum, as when the vehicle loses power; all before that is shown")
    return MocapLog(FORMAT, tuple(subjects), tuple(notes), truncated)


def _head(data: mmap.mmap, file: Path) -> tuple[int, dict[int, _EventType], int]:
    try:
        version, count = struct.unpack_from("<HH", data, 1)
        if version not in _TIMES:
            raise InputError(
                f"version {version} of the log; versions 1 and 2 are known",
                where=str(file),
                hint="it was written by newer firmware, or is no log of the microSD card",
            )
        offset, types = 5, {}
        if count > _MOST:
            raise ValueError(f"{count} kinds of records")
        for _ in range(count):
            (number,) = struct.unpack_from("<H", data, offset)
            name, offset = _text(data, offset + 2)
            (variables,) = struct.unpack_from("<H", data, offset)
            offset += 2
            if variables > _MOST:
                raise ValueError(f"{variables} variables")
            columns: list[tuple[str, str]] = []
            for _ in range(variables):
                text, offset = _text(data, offset)
                variable, _, code = text.rstrip(")").rpartition("(")
                if variable in dict(columns):
                    raise ValueError(f"{variable} twice")
                columns.append((variable, _CODES[code]))
            types[number] = _EventType(name, np.dtype([("time", _TIMES[version][0]), *columns]))
    except (struct.error, ValueError, KeyError) as error:
        raise InputError(
            f"the head of the log is damaged or cut off ({error})", where=str(file), hint="copy it from the card again"
        ) from error
    return version, types, offset


def _text(data: mmap.mmap, offset: int) -> tuple[str, int]:
    end = data.find(b"\0", offset, offset + 256)
    if end < 0:
        raise ValueError("a name without end")
    return data[offset:end].decode("ascii"), end + 1


def _places(data: mmap.mmap, types: dict[int, _EventType], begin: int) -> tuple[dict[int, list[int]], int]:
    """Return where the rows of each type begin, after their number, and where the last whole record ends."""
    sizes = {number: 2 + kind.row.itemsize for number, kind in types.items()}
    places: dict[int, list[int]] = {number: [] for number in types}
    last = len(data)
    while begin + 2 <= last:
        number = data[begin] | data[begin + 1] << 8
        size = sizes.get(number)
        if size is None or begin + size > last:
            break
        places[number].append(begin + 2)
        begin += size
    return places, begin


def _check_end(data: mmap.mmap, types: dict[int, _EventType], end: int, file: Path, block: int) -> bool:
    """Return whether the log was cut off. Raises InputError where it is whole but damaged."""
    rest = len(data) - end
    if rest == 4 and _checksum(data, end, block) == int.from_bytes(data[end:], "little"):
        return False
    if rest < 2 or (data[end] | data[end + 1] << 8) in types:  # a record that was not written to its end
        return True
    what = "the checksum is wrong" if rest == 4 else f"damaged at byte {end}"
    raise InputError(f"{what}: the log is damaged", where=str(file), hint="copy it from the card again")


def _checksum(data: mmap.mmap, end: int, block: int) -> int:
    value = 0
    for start in range(0, end, block):
        value = zlib.crc32(data[start : min(start + block, end)], value)
    return value


def _rows(data: mmap.mmap, row: np.dtype, offsets: NDArray, block: int) -> NDArray:
    """Return (N,) of the row's type, gathered a block at a time."""
    whole = np.frombuffer(data, dtype=np.uint8)
    rows = np.empty(len(offsets), dtype=row)
    step = max(1, block // row.itemsize)
    for start in range(0, len(offsets), step):
        picked = whole[offsets[start : start + step, None] + np.arange(row.itemsize)]
        rows[start : start + step] = picked.view(row)[:, 0]
    return rows


def _has(rows: NDArray, names: tuple[str, ...]) -> bool:
    return bool(names) and set(names) <= set(rows.dtype.names or ())


def _table(rows: NDArray, names: tuple[str, ...]) -> NDArray:
    return np.stack([rows[name].astype(float) for name in names], axis=1)


def _subject(source: _Source, rows: NDArray, start: float, scale: float) -> LoggedSubject:
    time = (rows["time"].astype(float) - start) * scale
    keep = ascending(time)
    rows = rows[keep]
    position = _table(rows, source.position) * source.scale
    quaternion = np.full((len(rows), 4), np.nan)
    if _has(rows, source.quaternion):
        with np.errstate(invalid="ignore"):
            quaternion = unit_quaternions(_table(rows, source.quaternion), tolerance=np.inf)
    elif _has(rows, source.angles):
        roll, pitch, yaw = _table(rows, source.angles).T
        known = np.isfinite(roll + pitch + yaw)
        turn = np.stack([yaw, -pitch, roll], axis=1)[known]  # the firmware's pitch counts the other way
        quaternion[known] = Rotation.from_euler("ZYX", turn, degrees=True).as_quat()
    return LoggedSubject(source.name, time[keep], position, quaternion)


def _renamed(subject: LoggedSubject, event: str) -> LoggedSubject:
    return LoggedSubject(f"{subject.name} at {event}", subject.time, subject.position, subject.quaternion)
