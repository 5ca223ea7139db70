"""Read a CSV whose first line names its columns: one vehicle a file, time, place and, if there, attitude, in SI units.

crazyswarm2 writes `timestamp,x,y,z,qw,qx,qy,qz`, and `cfplan export --to samples` `t`, places, velocities and more.
"""

import mmap
from pathlib import Path

import numpy as np

from cfplan.errors import InputError
from cfplan.recording.importers.csv_numbers import Lines, numbers
from cfplan.recording.importers.mocap_log import LoggedSubject, MocapLog, ascending, unit_quaternions

FORMAT = "CSV of t, x, y, z"
TIMES = ("t", "time", "timestamp")  # what the column of times may be called
PLACE, QUATERNION = ("x", "y", "z"), ("qx", "qy", "qz", "qw")


def recognises(file: Path, head: bytes) -> bool:
    """Return whether the first line names the columns."""
    names = _names(head)
    return bool(set(TIMES) & set(names)) and bool({"x", "qw"} & set(names))


def read(file: Path) -> MocapLog:
    """Read the one vehicle, named as the file is. Raises InputError where a column is missing or a number is none."""
    with file.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        begin = data.find(b"\n") + 1 or len(data)
        names = _names(data[:begin])
        time = next(name for name in TIMES if name in names)
        columns = (time, *PLACE, *(QUATERNION if set(QUATERNION) & set(names) else ()))
        missing = [name for name in columns if name not in names]
        if missing:
            raise InputError(
                f"there is no column {', '.join(missing)}",
                where=f"{file}:1",
                hint="the first line names the columns t, x, y, z, and where attitudes are known qx, qy, qz and qw",
            )
        wanted = [names.index(name) for name in columns]
        values, cut = numbers(data, Lines(begin, len(data), ",", len(names), wanted), file)
    keep = ascending(values[:, 0])
    notes = ["the last line is cut off and left out"] if cut else []
    if not keep.all():
        notes.append(f"{np.sum(~keep)} rows left out, as their times do not grow")
    values = values[keep]
    try:
        quaternion = unit_quaternions(values[:, 4:]) if len(columns) > 4 else np.full((len(values), 4), np.nan)
    except ValueError as error:
        row, length = error.args
        raise InputError(
            f"the quaternion has length {length:.3g} at {values[row, 0]:.3f} s",
            where=str(file),
            hint="the file is damaged, or its columns are in another order",
        ) from None
    subject = LoggedSubject(file.stem, values[:, 0], values[:, 1:4], quaternion)
    return MocapLog(FORMAT, (subject,), tuple(notes), truncated=cut)


def _names(head: bytes) -> list[str]:
    line = head.split(b"\n", 1)[0].decode("utf-8-sig", errors="replace")
    return [name.strip().strip('"') for name in line.strip("\r\n").split(",")]
