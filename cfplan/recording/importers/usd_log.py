"""Read the log that a Crazyflie writes to its microSD card, as the firmware's usddeck.c lays it out, little endian:

u8 0xBC, u16 version, u16 event types
each type: u16 number, name\\0, u16 variables, each `group.name(T)\\0` with T the struct code of its type
records: u16 type, time (version 2: u64 µs, version 1: u32 ms), the values in order
u32 CRC-32 of everything before; missing if the vehicle lost power while writing

Firmware before 2020 wrote one event: u8 variables, each `group.name(T),` with `tick(I)`, ms, first; ~u32 CRC-32 of that
blocks: u8 rows, the rows, ~u32 CRC-32 of that
"""

import math
import re
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError
from cfplan.recording.importers.mocap_log import PLACE, POSE, Columns, MocapLog, in_order, subject

FORMAT = "Crazyflie microSD log"
HEAD = re.compile(rb"\xbc[\0-\x0f]\0|[\1-\x40]tick\(I\),")  # the first byte, and a small version; or a small width
_MAGIC = 0xBC
_MAX_EVENT_TYPES = 64  # event types, and variables of one; the firmware allows 20
_CLOCKS = {1: ("<u4", 1e-3), 2: ("<u8", 1e-6)}  # version: type of a time, and its unit in s
_CODES = {"B": "u1", "b": "i1", "H": "<u2", "h": "<i2", "I": "<u4", "i": "<i4", "f": "<f4", "e": "<f2"}
_PLACE: Columns = {axis: (axis, 1.0) for axis in PLACE}
_MILLIMETRES: Columns = {axis: (axis, 1e-3) for axis in PLACE}
_DEGREE = math.pi / 180
_ANGLES: Columns = {"roll": ("roll", _DEGREE), "pitch": ("pitch", -_DEGREE), "yaw": ("yaw", _DEGREE)}  # pitch: nose up
_ROLL_PITCH_YAW = ("roll", "pitch", "yaw")  # of ctrlLee: rad, right-handed
_KALMAN = ("stateX", "stateY", "stateZ", "q1", "q2", "q3", "q0")


def _of_group(group: str, columns: Columns) -> Columns:
    return {channel: (f"{group}.{name}", unit) for channel, (name, unit) in columns.items()}


SOURCES = {  # subject: the variables of its pose
    "mocap": _of_group("locSrv", POSE),
    "estimate": _of_group("stateEstimate", {**POSE, **_ANGLES}),
    "estimate, compressed": {
        **_of_group("stateEstimateZ", {**_MILLIMETRES, "quat": ("quat", 1.0)}),
        **{angle: (f"ctrlLee.rpy{axis}", 1.0) for angle, axis in zip(_ROLL_PITCH_YAW, PLACE, strict=True)},
    },
    "kalman": {channel: (f"kalman.{name}", 1.0) for channel, name in zip(POSE, _KALMAN, strict=True)},
    "lighthouse": _of_group("lighthouse", _PLACE),
    "setpoint": _of_group("ctrltarget", _PLACE),  # its yaw is a rate
    "setpoint, compressed": {
        **_of_group("ctrltargetZ", _MILLIMETRES),
        **{angle: (f"ctrlLee.rpyd{axis}", 1.0) for angle, axis in zip(_ROLL_PITCH_YAW, PLACE, strict=True)},
    },
}


def read(file: Path) -> MocapLog:
    """Read every logged pose: motion capture, estimate, setpoint. Times count from the first record.

    A log without its checksum was cut off: all complete records are read, and `truncated` is True.
    Raises InputError if the checksum is wrong, the head is damaged, or no variables of a pose were logged.
    """
    tables, truncated = read_tables(file)
    notes = []
    if truncated:
        notes.append("the log ends without its checksum, as when the vehicle loses power; all before that is shown")
    subjects = []
    for event, table in tables:
        logged = {name: c for name, c in SOURCES.items() if all(c[axis][0] in table for axis in PLACE)}
        if logged:
            ordered = in_order(table, f"records of {event!r}", notes)
            at = "" if event == "fixedFrequency" else f" at {event}"
            subjects += [subject(name + at, ordered, columns) for name, columns in logged.items()]
    if not subjects:
        names = [f"{event} has {', '.join([*table][1:21]) or 'none'}" for event, table in tables]
        raise InputError(
            f"no position of a group is among the variables: {'; '.join(names[:6])}",
            where=str(file),
            hint="log stateEstimate.x, .y, .z and .qx, .qy, .qz, .qw, named in the card's config.txt",
        )
    return MocapLog(FORMAT, tuple(subjects), tuple(notes), truncated)


def read_tables(file: Path) -> tuple[list[tuple[str, dict[str, NDArray]]], bool]:
    """Return each event with its columns by variable, "t" in s since the first record, and whether the log was cut off.

    Raises InputError as `read` does.
    """
    data = file.read_bytes()
    unit, tables, truncated = _events(data, file) if data[0] == _MAGIC else _blocks(data, file)
    starts = [float(rows["t"][0]) for _, rows in tables if len(rows)]
    if not starts:
        hint = "nothing was logged, or copy it again"
        raise InputError("the log ends before its first record", where=str(file), hint=hint)
    found = [(event, {name: rows[name] for name in rows.dtype.names or ()}) for event, rows in tables]
    for _, table in found:
        table["t"] = (table["t"].astype(float) - min(starts)) * unit
    return found, truncated


def _events(data: bytes, file: Path) -> tuple[float, list[tuple[str, NDArray]], bool]:
    """Return the unit of times in s, the rows of each event, and whether the log was cut off."""
    unit, types, begin = _head(data, file)
    records: dict[int, list[bytes]] = {number: [] for number in types}
    while (row := types.get(number := int.from_bytes(data[begin : begin + 2], "little"))) is not None:
        after = begin + 2 + row[1].itemsize
        if after > len(data):
            break
        records[number].append(data[begin + 2 : after])
        begin = after
    tables = [(name, np.frombuffer(b"".join(records[number]), row)) for number, (name, row) in types.items()]
    return unit, tables, _is_truncated(data, begin, number in types, file)


def _blocks(data: bytes, file: Path) -> tuple[float, list[tuple[str, NDArray]], bool]:
    """Return the same for a log with a text header. Raises InputError if it is damaged."""
    *variables, _ = data[1:].split(b",", data[0])
    begin, end = 0, 1 + sum(len(variable) + 1 for variable in variables)
    blocks = []
    try:
        row = _row("<u4", [variable.decode("ascii") for variable in variables[1:]])
        while end + 4 <= len(data):
            if zlib.crc32(memoryview(data)[begin:end]) ^ 0xFFFFFFFF != int.from_bytes(data[end : end + 4], "little"):
                raise ValueError
            blocks.append(data[begin + 1 : end])  # first, the header
            begin = end + 4
            end = begin + 1 + row.itemsize * data[begin] if begin < len(data) else begin
        if not blocks:
            raise ValueError
    except (ValueError, KeyError) as error:
        raise InputError(f"damaged after byte {begin}", where=str(file), hint="copy it from the card again") from error
    rest = data[begin + 1 : end]
    rows = np.frombuffer(b"".join([*blocks[1:], rest[: len(rest) // row.itemsize * row.itemsize]]), row)
    return 1e-3, [("fixedFrequency", rows)], begin < len(data)


def _row(clock: str, variables: Sequence[str]) -> np.dtype:
    """Return the type of one row: its time, then the variables `name(T)`. Raises KeyError, or ValueError."""
    parts = [variable.rstrip(")").rpartition("(") for variable in variables]
    return np.dtype([("t", clock), *((name, _CODES[code]) for name, _, code in parts)])


def _head(data: bytes, file: Path) -> tuple[float, dict[int, tuple[str, np.dtype]], int]:
    """Return the unit of times in s, name and row dtype of each event type, and the offset of the first record."""
    offset = 1

    def number(most: int = 0xFFFF) -> int:
        nonlocal offset
        (found,) = struct.unpack_from("<H", data, offset)
        if found > most:
            raise ValueError
        offset += 2
        return int(found)

    def text() -> str:
        nonlocal offset
        begin, offset = offset, data.index(b"\0", offset, offset + 256) + 1
        return data[begin : offset - 1].decode("ascii")

    try:
        version = number()
        if version not in _CLOCKS:
            message = f"version {version} of the log; versions 1 and 2 are known"
            hint = "it was written by newer firmware, or is no log of the microSD card"
            raise InputError(message, where=str(file), hint=hint)
        clock, unit = _CLOCKS[version]
        types = {}
        for _ in range(number(_MAX_EVENT_TYPES)):
            key, name = number(), text()
            types[key] = name, _row(clock, [text() for _ in range(number(_MAX_EVENT_TYPES))])
    except (struct.error, ValueError, KeyError) as error:
        message = f"the head of the log is damaged or cut off at byte {offset}"
        raise InputError(message, where=str(file), hint="copy it from the card again") from error
    return unit, types, offset


def _is_truncated(data: bytes, end: int, within_record: bool, file: Path) -> bool:
    """Return whether the log was cut off after its records. Raises InputError if it is complete but damaged."""
    rest = data[end:]
    if len(rest) == 4 and zlib.crc32(memoryview(data)[:end]) == int.from_bytes(rest, "little"):
        return False
    if len(rest) < 2 or within_record:
        return True
    message = "the checksum is wrong" if len(rest) == 4 else f"damaged at byte {end}"
    raise InputError(f"{message}: the log is damaged", where=str(file), hint="copy it from the card again")
