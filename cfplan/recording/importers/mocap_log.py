"""The poses of each subject in a log of motion capture or of a vehicle: what every importer returns."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError

_LISTED = 12  # names that an error lists at most


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


def unit_quaternions(quaternion: NDArray, *, tolerance: float = 0.05) -> NDArray:
    """Return them (N, 4) with length 1; NaN where the length is 0 or NaN, as in logs where nothing was seen.

    Raises ValueError naming the first row whose length is off by more than the tolerance: that is no quaternion.
    """
    with np.errstate(all="ignore"):  # what is absurd becomes NaN, or has a wrong length
        length = np.linalg.norm(quaternion, axis=1)
    wrong = np.flatnonzero((np.abs(length - 1) > tolerance) & (length > 0))
    if len(wrong):
        raise ValueError(int(wrong[0]), float(length[wrong[0]]))
    with np.errstate(all="ignore"):
        return quaternion / np.where((length > 0) & (length < np.inf), length, np.nan)[:, None]


def ascending(time: NDArray) -> NDArray:
    """Return which rows to keep so that time only grows: each that is later than all before it."""
    if len(time) == 0:
        return np.zeros(0, dtype=bool)
    latest = np.maximum.accumulate(np.where(np.isfinite(time), time, -np.inf))
    return np.isfinite(time) & (time > np.r_[-np.inf, latest[:-1]])
