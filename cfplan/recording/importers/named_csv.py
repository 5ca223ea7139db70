"""Read a CSV whose first line names its columns: time, position and optional attitude of one vehicle, in SI units.

crazyswarm2 writes `timestamp,x,y,z,qw,qx,qy,qz`; `cfplan export --to samples` writes `t`, position, velocity and more.
"""

import re
from pathlib import Path

from cfplan.errors import InputError
from cfplan.files.text import TIMES
from cfplan.recording.importers.csv_numbers import read_numbers
from cfplan.recording.importers.mocap_log import PLACE, QUATERNION, MocapLog, in_order, subject

FORMAT = "CSV of t, x, y, z"
_COLUMN = r"(?=(?:[^\n]*,)?[ \t\"]*(?:%s)[ \t\"]*(?:[,\r\n]|\Z))"  # in the first line
HEAD = re.compile((r"(?:\xef\xbb\xbf)?" + _COLUMN % "|".join(TIMES) + _COLUMN % "x|qw").encode())


def read(file: Path) -> MocapLog:
    """Read the vehicle, named after the file. Raises InputError if a column is missing or a cell is not a number."""
    data = file.read_bytes()
    begin = data.find(b"\n") + 1 or len(data)
    names = _names(data[:begin])
    channels = PLACE + (QUATERNION if set(QUATERNION) & set(names) else ())
    if missing := [name for name in channels if name not in names]:
        hint = "the first line must name the columns t, x, y, z and, for attitudes, qx, qy, qz and qw"
        raise InputError(f"there is no column {', '.join(missing)}", where=f"{file}:1", hint=hint)
    time = names.index(next(name for name in TIMES if name in names))
    columns = {channel: (names.index(channel), 1.0) for channel in channels}
    wanted = [time, *(column for column, _ in columns.values())]
    table, cut = read_numbers(data, begin, len(data), wanted, len(names), str(file))
    notes = ["the last line is cut off and left out"] if cut else []
    ordered = in_order({**table, "t": table[time]}, "rows", notes)
    return MocapLog(FORMAT, (subject(file.stem, ordered, columns, where=str(file)),), tuple(notes), truncated=cut)


def _names(head: bytes) -> list[str]:
    line = head.split(b"\n", 1)[0].decode("utf-8-sig", errors="replace")
    return [name.strip().strip('"') for name in line.strip("\r\n").split(",")]
