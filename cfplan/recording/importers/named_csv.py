"""Read CSV and TSV whose first lines name their columns: times and poses of one vehicle or of several bodies.

A format is a row of LAYOUTS: the names of its columns and their units. Motive and QTM name the bodies above them.
"""

import csv
import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cfplan.errors import InputError
from cfplan.files.text import TIMES, UNITS, is_number
from cfplan.recording.importers.csv_numbers import decimal_point, line_at, read_numbers
from cfplan.recording.importers.mocap_log import (
    MATRIX,
    PLACE,
    POSE,
    QUATERNION,
    Columns,
    MocapLog,
    in_order,
    subject,
    without_zeros,
)  # fmt: skip
from cfplan.recording.importers.usd_log import SOURCES

FORMAT = "CSV of t, x, y, z (or of cfclient, Motive, QTM, TUM or EuRoC)"
_MARK = b"\xef\xbb\xbf"  # byte order mark, which some programs write first
_ROW = rb"[ \t\"]*[+-]?[\d.][\d.eE+-]*\"?[ \t]*[,;\t ]"  # the first cell is a number
_COLUMN = r"(?=(?:[^\n]*[,;\t ])?[ \t\"#]*(?:%s)[ \t\"]*(?:[,;\t\r\n ]|\Z))"  # in the first line
_NAMED = (_COLUMN % "|".join(TIMES) + _COLUMN % "x|qw").encode()
HEAD = re.compile(
    rb"(?:\xef\xbb\xbf)?(?:Format Version,|FILE_VERSION\t|NO_OF_FRAMES\t|(?:[^\n\0]*\n){0,20}?%s|(?i:%s))"
    % (_ROW, _NAMED)
)
_FIRST_ROW = re.compile(rb"^" + _ROW, re.MULTILINE)
_CELL = re.compile(r"[\s\"']*(.*?)\s*(?:[\[(](.*)[\])])?[\s\"']*")  # a name, and its unit
_HINT = "the first line must name the columns t, x, y, z and, for attitudes, qx, qy, qz and qw"


def _pose(place: str, turn: str) -> Columns:
    """Return the columns of a pose by patterns of their names, with the axis in the place of `?`."""
    return {c: ((turn if c in QUATERNION else place).replace("?", c[-1]), 1.0) for c in POSE}


LAYOUTS: dict[str, tuple[float, Mapping[str, Columns]]] = {
    # format: the unit of its times in s, if the header names none, and each subject's columns; "" is the file's name
    "CSV of t, x, y, z": (1.0, {"": POSE}),
    "CSV of t, p_x, p_y, p_z": (1.0, {"": _pose("p_?", "q_?")}),
    "TUM trajectory": (1.0, {"": _pose("t?", "q?")}),
    "EuRoC ground truth": (1e-9, {"": _pose("p_rs_r_?", "q_rs_?")}),
    "cfclient log": (1e-3, {s: {c: (key.lower(), unit) for c, (key, unit) in SOURCES[s].items()} for s in SOURCES}),
}
_UNNAMED = {4: ("t", *PLACE), 8: ("t", "tx", "ty", "tz", *QUATERNION)}  # columns without names, by their number
_MOTIVE: Columns = {  # the axis that Motive exports as y is up: its z is -y here
    "x": ("Position X", 1.0), "y": ("Position Z", -1.0), "z": ("Position Y", 1.0),
    "qx": ("Rotation X", 1.0), "qy": ("Rotation Z", -1.0), "qz": ("Rotation Y", 1.0), "qw": ("Rotation W", 1.0),
}  # fmt: skip
_MILLIMETRES: Columns = {axis: (column, 1e-3) for column, axis in enumerate(PLACE)}
_QTM: dict[str, tuple[int, Columns]] = {  # by the line with the names: how many columns each has, and which are read
    "BODY_NAMES": (16, {**_MILLIMETRES, **{entry: (7 + column, 1.0) for column, entry in enumerate(MATRIX)}}),
    "MARKER_NAMES": (3, _MILLIMETRES),
}


@dataclass(frozen=True, slots=True)
class _Head:
    """The columns of a file."""

    format: str
    subjects: Mapping[str, Columns]  # by their numbers, from 0
    time: int = -1  # the column of the times
    unit: float = 1.0  # of the times, s
    rate: float = math.nan  # Hz, of the rows, if no column holds times
    zeros: bool = False  # whether rows of zeros stand for a body that was not seen
    notes: tuple[str, ...] = ()


def read(file: Path) -> MocapLog:
    """Read every subject; an unnamed one is named after the file.

    Raises InputError if a column is missing, a unit is unknown, or a cell is not a number.
    """
    data = file.read_bytes().removeprefix(_MARK)
    row = _FIRST_ROW.search(data)
    begin = row.start() if row else len(data)
    lines = [line for line in data[:begin].decode("utf-8", errors="replace").splitlines() if line.strip(' \t,;"')]
    lines = lines or [""]
    first = data[begin : data.find(b"\n", begin) + 1 or len(data)].decode("utf-8", errors="replace").strip("\r\n")
    sample = first or lines[-1]
    delimiter = max("\t;,", key=sample.count)
    if delimiter not in sample or (delimiter == "," and re.search(r"\d,\d+ +[-\d]", first)):  # or decimal commas
        delimiter = " "
    if delimiter == " ":  # several count as one
        data = data[:begin] + b"\n".join(b" ".join(line.split()) for line in data[begin:].splitlines())
        first = " ".join(first.split())
    where, cells = f"{file}:{max(line_at(data, begin) - 1, 1)}", first.split(delimiter)
    head = _head(lines, cells, delimiter, where)
    if not row:
        raise InputError("no rows of numbers below the header", where=where, hint="export the log again")
    wanted = {head.time, *(column for columns in head.subjects.values() for column, _ in columns.values())} - {-1}
    point, width = decimal_point(data, begin, len(data), delimiter), max(len(cells), *(column + 1 for column in wanted))
    table, cut = read_numbers(
        data, begin, len(data), sorted(wanted), width, str(file), delimiter=delimiter, point=point
    )
    notes = [*head.notes, "the last line is cut off and left out"] if cut else [*head.notes]
    count = len(next(iter(table.values())))
    time = table[head.time] * head.unit if head.time >= 0 else np.arange(count) / head.rate
    rows = in_order({**table, "t": time}, "rows", notes)
    subjects = tuple(
        subject(name or file.stem, without_zeros(rows, columns) if head.zeros else rows, columns, where=str(file))
        for name, columns in head.subjects.items()
    )
    return MocapLog(head.format, subjects, tuple(notes), truncated=cut)


def _head(lines: Sequence[str], row: Sequence[str], delimiter: str, where: str) -> _Head:
    if lines[0].startswith("Format Version,"):
        return _motive(lines, where)
    if lines[0].startswith(("FILE_VERSION\t", "NO_OF_FRAMES\t")):
        return _qtm(lines, len(row), where)
    return _named(lines[-1], row, delimiter, where)


def _named(line: str, row: Sequence[str], delimiter: str, where: str) -> _Head:
    """Return the columns that the line names, or those of a file without names."""
    text = line.strip().lstrip("#").strip()
    named = [_CELL.fullmatch(cell) for cell in (text.split() or [""] if delimiter == " " else text.split(delimiter))]
    names, units = zip(*((cell[1].lower(), (cell[2] or "").lower()) for cell in named if cell), strict=True)
    notes: tuple[str, ...] = ()
    if (not text or line.lstrip().startswith("#")) and not set(TIMES) & set(names) and len(row) in _UNNAMED:
        names = _UNNAMED[len(row)]
        units, notes = ("",) * len(names), (f"no line names the columns: taken as {', '.join(names)}",)
    times = [name for name in TIMES if name in names]
    for form, (unit, layout) in LAYOUTS.items():
        subjects, used = {}, {names.index(name) for name in times[:1]}
        for subject_name, columns in layout.items():
            found = {c: (names.index(key), k) for c, (key, k) in columns.items() if key in names}
            if found.keys() >= set(PLACE):
                subjects[subject_name] = {c: (i, k * UNITS.get(units[i], 1.0)) for c, (i, k) in found.items()}
                used |= {column for column, _ in found.values()}
                missing = [columns[c][0] for c in QUATERNION if c in columns and c not in found]
                if form != "cfclient log" and 0 < len(missing) < len(QUATERNION):
                    raise InputError(f"there is no column {', '.join(missing)}", where=where, hint=_HINT)
        if subjects and times:
            if unknown := [units[column] for column in used if units[column] and units[column] not in UNITS]:
                raise InputError(f"the unit {unknown[0]!r} is unknown", where=where, hint=f"known: {', '.join(UNITS)}")
            time = names.index(times[0])
            return _Head(form, subjects, time, UNITS.get(units[time], unit), notes=notes)
    missing = [name for name in PLACE if name not in names] + ["t"] * (not times)
    listed = ", ".join(filter(None, names[:12]))
    raise InputError(
        f"there is no column {', '.join(missing)}", where=where, hint=f"{_HINT}; it names: {listed or 'none'}"
    )


def _motive(lines: Sequence[str], where: str) -> _Head:
    """Return the columns of rigid bodies and markers in an export of Motive.

    Its head ends with rows of the kind, the name and an identity, more in some versions, the property, and the axis.
    """
    first: list[str] = []
    rows: list[list[str]] = []
    axes: list[str] = []
    with suppress(csv.Error, ValueError):  # a damaged head, or one that is too short
        first, *rows, axes = csv.reader(lines)
    unit = dict(zip(first[::2], first[1::2], strict=False)).get("Length Units", "Meters").lower()
    times = [column for column, axis in enumerate(axes) if axis.lower().startswith("time")]
    if unit not in UNITS or len(rows) < 3 or not times:
        message = f"the unit of lengths is {unit[:20]!r}" if unit not in UNITS else "the head is not that of Motive"
        raise InputError(message, where=where, hint="export it again, in meters and with its header")
    found: dict[str, dict[str, int]] = {}
    for column, (kind, name, what, axis) in enumerate(zip(rows[0], rows[1], rows[-1], axes, strict=False)):
        if kind in ("Rigid Body", "Marker"):
            found.setdefault(name, {})[f"{what} {axis}"] = column
    subjects = {
        name: {c: (there[k], u * (UNITS[unit] if c in PLACE else 1)) for c, (k, u) in _MOTIVE.items() if k in there}
        for name, there in found.items()
        if {"Position X", "Position Y", "Position Z"} <= there.keys()
    }
    notes = ["Motive's y axis is taken as up, as it exports unless told otherwise"]
    if any("Rotation X" in there and "Rotation W" not in there for there in found.values()):
        notes.append("angles of Motive are not read: export its rotations as quaternions")
    return _Head("Motive CSV", subjects, times[0], notes=tuple(notes))


def _qtm(lines: Sequence[str], width: int, where: str) -> _Head:
    """Return the columns of the bodies or the markers in an export of Qualisys Track Manager, at a fixed rate."""
    entries = {key: values for key, *values in (line.rstrip("\t").split("\t") for line in lines)}
    key = next((key for key in _QTM if key in entries), "")
    rate = (entries.get("FREQUENCY") or [""])[0]
    size, columns = _QTM.get(key, (0, {}))
    names = [name for name in entries.get(key, []) if name] if key else []
    before = 2 if lines[-1].startswith("Frame\t") else 0  # Frame and Time
    if not names or not is_number(rate) or not float(rate) > 0 or width < before + size * len(names):
        message = "no bodies or markers with a frequency and all their columns"
        raise InputError(message, where=where, hint="export 6D or 3D data from QTM, with the header")
    subjects = {
        name: {c: (before + size * place + column, unit) for c, (column, unit) in columns.items()}
        for place, name in enumerate(names)
    }
    return _Head("QTM TSV", subjects, rate=float(rate), zeros=True)
