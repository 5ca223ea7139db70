"""Refuse implausible times, places and values when a record or a log is read."""

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError
from cfplan.numbers import coordinates

LONGEST = 12 * 3600.0  # s, from the first time to the last; longer spans cost memory and minutes in comparing times
_LATEST = 1e11  # s; microseconds taken for seconds are later
_FARTHEST = 1e4  # m, from the origin
_LARGEST = 1e11  # of any number, in SI; squares of larger ones would overflow in drawing


def check_times(time: NDArray, name: str, *, where: str) -> None:
    """Raise InputError if a time, (N,) s, is not finite or implausible, or if the times span too long."""
    if len(time) == 0:
        return
    wrong = np.flatnonzero(~(np.abs(time) <= _LATEST))
    if len(wrong):
        raise InputError(
            f"time {int(wrong[0]) + 1} of {name} is {float(time[wrong[0]]):g} s",
            where=where,
            hint="the file is damaged, or its times are not in the unit that its format has",
        )
    span = float(np.max(time) - np.min(time))
    if span > LONGEST:
        raise InputError(
            f"the times of {name} span {span:g} s, more than {LONGEST / 3600:g} h",
            where=where,
            hint="a time is damaged, or the log must be cut into flights",
        )


def check_places(position: NDArray, name: str, *, where: str) -> None:
    """Raise InputError if a position, (N, 3) m, is implausibly far away; NaN means not seen."""
    wrong = np.flatnonzero((np.abs(position) > _FARTHEST).any(axis=1))
    if len(wrong):
        raise InputError(
            f"position {int(wrong[0]) + 1} of {name} is {coordinates(position[wrong[0]], 'g')} m",
            where=where,
            hint="the file is damaged, or its lengths are not in the unit that its format has",
        )


def check_values(values: NDArray, name: str, *, where: str) -> None:
    """Raise InputError if a number, (N,) or (N, K), is implausibly large; NaN means not known."""
    if values.dtype.kind != "f":
        return
    wrong = np.argwhere(np.abs(values) > _LARGEST)
    if len(wrong):
        raise InputError(
            f"number {int(wrong[0, 0]) + 1} of {name} is {float(values[tuple(wrong[0])]):g}",
            where=where,
            hint="the file is damaged, or was changed since",
        )
