"""The poses of each subject in a log of motion capture or of a vehicle, and their construction from table columns.

A format declares which of its columns holds which channel, in which unit; `subject` builds the poses.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cfplan.errors import InputError
from cfplan.flight.setpoints.packets import decompress_quaternion

Table = Mapping[Any, NDArray]  # columns, (N,) each, by the format's keys; "t" holds times, s
Columns = Mapping[str, tuple[Any, float]]  # channel: the key of its column, and the factor to SI units

PLACE = ("x", "y", "z")
QUATERNION = ("qx", "qy", "qz", "qw")
YAW_PITCH_ROLL = ("yaw", "pitch", "roll")  # about z, then the turned y, then the turned x
ROTATION_VECTOR = ("rx", "ry", "rz")
EULER_XYZ = ("ex", "ey", "ez")  # about x, then the turned y, then the turned z
MATRIX = ("xx", "yx", "zx", "xy", "yy", "zy", "xz", "yz", "zz")  # by columns: the body's x axis in the room first
COMPRESSED = ("quat",)  # as in the firmware's packets: 2 bits for the largest component, 3 × 10 for the others
POSE: Columns = {channel: (channel, 1.0) for channel in (*PLACE, *QUATERNION)}  # for tables that use these names

_LISTED = 12  # most names that an error lists
_LENGTH_TOLERANCE = 0.05  # on the length of a quaternion, which must be 1


@dataclass(frozen=True, slots=True, eq=False)
class LoggedSubject:
    """One tracked object: poses on the log's clock, NaN where it was not seen."""

    name: str
    time: NDArray  # (N,) s, ascending
    position: NDArray  # (N, 3) m
    quaternion: NDArray  # (N, 4) body→world, x y z w; NaN where only the position is known

    @property
    def seen(self) -> NDArray:
        """Return where the position is known, (N,) bool."""
        return np.isfinite(self.position).all(axis=1)

    @property
    def duration(self) -> float:
        """Return the time from the first row to the last, s."""
        return float(self.time[-1] - self.time[0]) if len(self.time) else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class MocapLog:
    """All subjects of one file."""

    format: str
    subjects: tuple[LoggedSubject, ...]
    notes: tuple[str, ...]  # assumptions and missing data, one sentence each
    truncated: bool  # the file is cut off; the subjects hold everything before that

    def select(self, names: Sequence[str], *, where: str = "") -> tuple[LoggedSubject, ...]:
        """Return the subjects with these names, or all without any. Raises InputError that lists the known names."""
        by_name = {subject.name: subject for subject in self.subjects}
        missing = [name for name in names if name not in by_name]
        if missing:
            listed = ", ".join(list(by_name)[:_LISTED]) + (", …" if len(by_name) > _LISTED else "")
            raise InputError(f"the log has no subject {missing[0]!r}", where=where, hint=f"it has: {listed}")
        return tuple(by_name[name] for name in names) if names else self.subjects


def in_order(table: Table, rows: str, notes: list[str]) -> Table:
    """Return the rows whose times increase; append a note that counts the dropped ones, which it calls `rows`."""
    time = table["t"]
    latest = np.maximum.accumulate(np.where(np.isfinite(time), time, -np.inf))
    keep = np.isfinite(time) & (time > np.r_[-np.inf, latest[:-1]])
    if keep.all():
        return table
    notes.append(f"{np.sum(~keep)} {rows} left out, as their times do not increase")
    return {key: column[keep] for key, column in table.items()}


def subject(name: str, table: Table, columns: Columns = POSE, *, where: str = "") -> LoggedSubject:
    """Return the poses in the columns; attitude columns may be absent.

    Raises InputError, if `where` names the file, at the first quaternion whose length is neither 1 nor 0.
    """
    channels = {c: np.asarray(table[key], dtype=float) * unit for c, (key, unit) in columns.items() if key in table}
    if where and set(channels) >= set(QUATERNION):
        _check_lengths(_stack(channels, QUATERNION), table["t"], name, where)
    return LoggedSubject(name, table["t"], _stack(channels, PLACE), attitude(channels))


def attitude(channels: Table) -> NDArray:
    """Return the attitude in the channels as quaternions, (N, 4), NaN where there is none."""
    for names, quaternion in _ATTITUDES.items():
        if channels.keys() >= set(names):
            return quaternion(_stack(channels, names))
    return np.full((len(next(iter(channels.values()))), 4), np.nan)


def without_zeros(table: Table, columns: Columns) -> Table:
    """Return the columns, with NaN in each row where the body was not seen: without a position, or all zeros."""
    values = np.stack([table[key] for key, _ in columns.values()])  # the position first
    values[:, np.isnan(values[:3]).any(axis=0) | (values == 0).all(axis=0)] = np.nan
    return {"t": table["t"], **dict(zip((key for key, _ in columns.values()), values, strict=True))}


def quaternions(values: NDArray, rotation: Callable[[NDArray], Rotation]) -> NDArray:
    """Return the rotation of each row as a quaternion, (N, 4), NaN where one of its values is not finite."""
    quaternion = np.full((len(values), 4), np.nan)
    known = np.isfinite(values).all(axis=1)
    if known.any():
        quaternion[known] = rotation(values[known]).as_quat()
    return quaternion


def _unit_quaternions(quaternion: NDArray) -> NDArray:
    """Return quaternions, (N, 4), of length 1; NaN where the length was 0 or not finite, as in rows without a pose."""
    with np.errstate(all="ignore"):
        length = np.linalg.norm(quaternion, axis=1, keepdims=True)
        return quaternion / np.where((length > 0) & (length < np.inf), length, np.nan)


def _from_matrices(values: NDArray) -> NDArray:
    """Return rotation matrices, (N, 9) by columns, as quaternions, (N, 4), NaN where one is no rotation."""
    matrices = values.reshape(-1, 3, 3).transpose(0, 2, 1)
    with np.errstate(all="ignore"):
        rotations = np.where((np.linalg.det(matrices) > 0)[:, None], values, np.nan)
    return quaternions(rotations, lambda known: Rotation.from_matrix(known.reshape(-1, 3, 3).transpose(0, 2, 1)))


def _from_compressed(values: NDArray) -> Rotation:
    return Rotation.from_quat(decompress_quaternion(values[:, 0]))


_ATTITUDES: dict[tuple[str, ...], Callable[[NDArray], NDArray]] = {  # the first whose channels are present is used
    QUATERNION: _unit_quaternions,
    YAW_PITCH_ROLL: partial(quaternions, rotation=partial(Rotation.from_euler, "ZYX")),
    ROTATION_VECTOR: partial(quaternions, rotation=Rotation.from_rotvec),
    EULER_XYZ: partial(quaternions, rotation=partial(Rotation.from_euler, "XYZ")),
    MATRIX: _from_matrices,
    COMPRESSED: partial(quaternions, rotation=_from_compressed),
}


def _stack(channels: Table, names: tuple[str, ...]) -> NDArray:
    return np.stack([channels[name] for name in names], axis=1)


def _check_lengths(quaternion: NDArray, time: NDArray, name: str, where: str) -> None:
    with np.errstate(all="ignore"):
        length = np.linalg.norm(quaternion, axis=1)
    wrong = np.flatnonzero((np.abs(length - 1) > _LENGTH_TOLERANCE) & (length > 0))
    if len(wrong):
        raise InputError(
            f"the quaternion of {name!r} has length {length[wrong[0]]:.3g} at {time[wrong[0]]:.3f} s",
            where=where,
            hint="the file is damaged, or its columns are not those of a quaternion; export it again",
        )
