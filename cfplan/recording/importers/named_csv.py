"""Read a CSV whose first line names its columns: one vehicle a file, time, place and, if there, attitude, in SI units.

crazyswarm2 writes `timestamp,x,y,z,qw,qx,qy,qz`, and `cfplan export --to samples` `t`, places, velocities and more.
"""

from pathlib import Path

from cfplan.errors import InputError
from cfplan.recording.importers.csv_numbers import read_numbers
from cfplan.recording.importers.mocap_log import (
    LoggedSubject,
    MocapLog,
    check_lengths,
    growing,
    unit_quaternions,
    unknown_rotations,
)  # fmt: skip

FORMAT = "CSV of t, x, y, z"
TIMES = ("t", "time", "timestamp")  # what the column of times may be called
PLACE, QUATERNION = ("x", "y", "z"), ("qx", "qy", "qz", "qw")


def recognises(file: Path, head: bytes) -> bool:
    """Return whether the first line names the columns."""
    names = _names(head)
    return bool(set(TIMES) & set(names)) and bool({"x", "qw"} & set(names))


def read(file: Path) -> MocapLog:
    """Read the one vehicle, named as the file is. Raises InputError where a column is missing or a number is none."""
    data = file.read_bytes()
    begin = data.find(b"\n") + 1 or len(data)
    names = _names(data[:begin])
    turned = bool(set(QUATERNION) & set(names))
    wanted = (next(name for name in TIMES if name in names), *PLACE, *(QUATERNION if turned else ()))
    missing = [name for name in wanted if name not in names]
    if missing:
        raise InputError(
            f"there is no column {', '.join(missing)}",
            where=f"{file}:1",
            hint="the first line names the columns t, x, y, z, and where attitudes are known qx, qy, qz and qw",
        )
    columns = [names.index(name) for name in wanted]
    values, cut = read_numbers(data, begin, len(data), columns, len(names), str(file))
    notes = ["the last line is cut off and left out"] if cut else []
    values = values[growing(values[:, 0], "rows", notes)]
    time, position, quaternion = values[:, 0], values[:, 1:4], values[:, 4:]
    if turned:
        check_lengths(quaternion, time, file.stem, where=str(file))
    quaternion = unit_quaternions(quaternion) if turned else unknown_rotations(len(time))
    return MocapLog(FORMAT, (LoggedSubject(file.stem, time, position, quaternion),), tuple(notes), truncated=cut)


def _names(head: bytes) -> list[str]:
    line = head.split(b"\n", 1)[0].decode("utf-8-sig", errors="replace")
    return [name.strip().strip('"') for name in line.strip("\r\n").split(",")]
