"""The poses of each subject in a log of motion capture or of a vehicle, and what all importers assemble them with."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cfplan.errors import InputError

_LISTED = 12  # names that an error lists at most
_LENGTH_TOLERANCE = 0.05  # of a quaternion whose length must be 1


@dataclass(frozen=True, slots=True, eq=False)
class LoggedSubject:
    """One tracked object: poses on the log's clock, NaN where it was not seen."""

    name: str
    time: NDArray  # (N,) s, ascending
    position: NDArray  # (N, 3) m
    quaternion: NDArray  # (N, 4) body→world, x y z w; NaN where only the position is known

    @property
    def seen(self) -> NDArray:
        """Return (N,) whether there is a position."""
        return np.isfinite(self.position).all(axis=1)

    @property
    def duration(self) -> float:
        """Return s from the first row to the last."""
        return float(self.time[-1] - self.time[0]) if len(self.time) else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class MocapLog:
    """All subjects of one file."""

    format: str
    subjects: tuple[LoggedSubject, ...]
    notes: tuple[str, ...]  # what was assumed and what is missing, one sentence each
    truncated: bool  # the file ends before its time; the subjects hold all that can be read

    def select(self, names: Sequence[str], *, where: str = "") -> tuple[LoggedSubject, ...]:
        """Return the subjects of these names, all where none is given. Raises InputError that lists the known names."""
        by_name = {subject.name: subject for subject in self.subjects}
        missing = [name for name in names if name not in by_name]
        if missing:
            listed = ", ".join(list(by_name)[:_LISTED]) + (", …" if len(by_name) > _LISTED else "")
            raise InputError(f"the log has no subject {missing[0]!r}", where=where, hint=f"it has: {listed}")
        return tuple(by_name[name] for name in names) if names else self.subjects


def growing(time: NDArray, rows: str, notes: list[str]) -> NDArray:
    """Return (N,) whether a time is later than all before it; a note counts the others of these `rows`."""
    latest = np.maximum.accumulate(np.where(np.isfinite(time), time, -np.inf))
    keep = np.isfinite(time) & (time > np.r_[-np.inf, latest[:-1]])
    if not keep.all():
        notes.append(f"{np.sum(~keep)} {rows} left out, as their times do not grow")
    return keep


def unknown_rotations(count: int) -> NDArray:
    """Return (N, 4) quaternions of NaN."""
    return np.full((count, 4), np.nan)


def quaternions(values: NDArray, rotation: Callable[[NDArray], Rotation]) -> NDArray:
    """Return (N, 4) of the rotation that each row states, NaN where one of its values is not finite."""
    quaternion = unknown_rotations(len(values))
    known = np.isfinite(values).all(axis=1)
    if known.any():
        quaternion[known] = rotation(values[known]).as_quat()
    return quaternion


def unit_quaternions(quaternion: NDArray) -> NDArray:
    """Return them (N, 4) with length 1; NaN where that is 0 or not finite, as in logs where nothing was seen."""
    with np.errstate(all="ignore"):
        length = np.linalg.norm(quaternion, axis=1, keepdims=True)
        return quaternion / np.where((length > 0) & (length < np.inf), length, np.nan)


def check_lengths(quaternion: NDArray, time: NDArray, name: str, *, where: str) -> None:
    """Raise InputError at the first quaternion, of (N, 4), whose length is neither 1 nor 0: it is something else."""
    with np.errstate(all="ignore"):
        length = np.linalg.norm(quaternion, axis=1)
    wrong = np.flatnonzero((np.abs(length - 1) > _LENGTH_TOLERANCE) & (length > 0))
    if len(wrong):
        raise InputError(
            f"the quaternion of {name!r} has length {length[wrong[0]]:.3g} at {time[wrong[0]]:.3f} s",
            where=where,
            hint="the file is damaged, or its columns are not those of a quaternion; export it again",
        )
