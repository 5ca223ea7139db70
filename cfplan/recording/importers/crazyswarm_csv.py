"""crazyswarm2's CSV of states: one vehicle a file, `timestamp,x,y,z,qw,qx,qy,qz`, SI units, w first."""

from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import csv

from cfplan.errors import InputError
from cfplan.recording.importers.mocap_log import MocapLog, Subject, ascending, unit_quaternions

FORMAT = "crazyswarm2 CSV"
COLUMNS = ("timestamp", "x", "y", "z", "qx", "qy", "qz", "qw")


def recognises(file: Path, head: bytes) -> bool:
    """By the names on its first line."""
    names = _names(head)
    return "timestamp" in names and bool({"x", "qw"} & set(names))


def read(file: Path) -> MocapLog:
    """The one vehicle, named as the file is. Raises InputError where a column or a number is not what it should be."""
    with file.open("rb") as stream:
        first = stream.readline()
        names = _names(first)
        missing = [name for name in COLUMNS if name not in names]
        if missing:
            raise InputError(f"there is no column {', '.join(missing)}", where=f"{file}:1")
        cut: list[str] = []
        try:
            table = csv.read_csv(
                stream,
                read_options=csv.ReadOptions(column_names=names, use_threads=False),
                parse_options=csv.ParseOptions(invalid_row_handler=lambda row: _skip(cut, row)),
                convert_options=csv.ConvertOptions(
                    include_columns=list(COLUMNS), column_types=dict.fromkeys(COLUMNS, pa.float64())
                ),
            )
        except pa.ArrowInvalid as error:
            if "Empty CSV" in str(error):
                raise InputError("there is no row beneath the columns' names", where=str(file)) from None
            raise InputError(f"a cell is not a number ({_one_line(error)})", where=str(file)) from error
    if len(cut) > 1 or (cut and _whole_lines(file)):
        raise InputError(f"{len(names)} columns, but there is a row {cut[0][:60]!r}", where=str(file))
    values = np.stack([table[name].to_numpy() for name in COLUMNS], axis=1)
    keep = ascending(values[:, 0])
    notes = ["the last line is cut off and left out"] if cut else []
    if not keep.all():
        notes.append(f"{np.sum(~keep)} rows left out, as their times do not grow")
    values = values[keep]
    try:
        quaternion = unit_quaternions(values[:, 4:])
    except ValueError as error:
        row, length = error.args
        raise InputError(f"the quaternion has length {length:.3g} at {values[row, 0]:.3f} s", where=str(file)) from None
    subject = Subject(file.stem, values[:, 0], values[:, 1:4], quaternion)
    return MocapLog(FORMAT, (subject,), tuple(notes), truncated=bool(cut))


def _names(head: bytes) -> list[str]:
    line = head.split(b"\n", 1)[0].decode("utf-8-sig", errors="replace")
    return [name.strip().strip('"') for name in line.strip("\r\n").split(",")]


def _skip(cut: list[str], row: csv.InvalidRow) -> str:
    cut.append(row.text or "")
    return "skip"


def _whole_lines(file: Path) -> bool:
    with file.open("rb") as stream:
        stream.seek(-1, 2)
        return stream.read(1) == b"\n"


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:160]
