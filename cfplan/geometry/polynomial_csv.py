"""Polynomial trajectory files of Crazyswarm: each row a duration and 4 × 8 coefficients."""

import math
import pathlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError
from cfplan.files.text import read_table
from cfplan.geometry.min_snap import smooth_through
from cfplan.geometry.polynomials import derivatives_on, end_values, intervals_of, largest_values
from cfplan.geometry.rest import close_joints, with_rest_ends
from cfplan.geometry.timed_samples import distances

ROW = "duration, x^0 to x^7, y^0 to y^7, z^0 to z^7, yaw^0 to yaw^7"
_COLUMNS = 1 + 4 * 8
_MIN_DURATION = 0.001  # s
_POSITION_STEP = 0.001  # m allowed between pieces
_SPACING = 0.04  # m between samples of a curve whose snap jumps
_TIMES = 50  # moments per piece, between which samples are placed
_MOST_SAMPLES = 50_000
_DERIVATIVE_STEP = 0.02  # tolerance between pieces, of the largest derivative: covers six decimals
_HEADER = ["duration", *(f"{axis}^{power}" for axis in ("x", "y", "z", "yaw") for power in range(8))]
_NAMES = ("position", "velocity", "acceleration", "jerk", "snap")
_UNITS = ("m", "m/s", "m/s²", "m/s³", "m/s⁴")


def read_polynomials(file: pathlib.Path, *, laps: int = 1) -> tuple[Any, ...]:
    """Return the curve of a polynomial file, at rest at both ends, and the points (K, 3) m where its rows meet.

    The file's timing and its yaw are not used: the planner times the path, and the yaw mode gives the yaw. Where snap
    jumps between rows, the curve is drawn smoothly through samples, and a note says how far it is from them.

    Raises:
        InputError: rows of another length, durations too short, jumps up to jerk between rows; names the line.
    """
    rows, lines = read_table(file, _COLUMNS, ROW)
    durations = rows[:, 0]
    if (durations < _MIN_DURATION).any():
        bad = int(np.argmax(durations < _MIN_DURATION))
        raise InputError(
            f"a duration must be at least {_MIN_DURATION} s, not {durations[bad]:g}",
            where=f"{file}:{lines[bad]}",
            hint="the first number of a row is the duration of the piece in seconds",
        )
    table = rows[:, 1:25].reshape(-1, 3, 8).transpose(0, 2, 1)
    durations, table = np.tile(durations, laps), np.tile(table, (laps, 1, 1))
    jumps = _check_pieces(file, lines * laps, durations, table)
    corners = np.concatenate([table[:, 0], end_values(durations[-1:], table[-1:])[1][:, 0]])
    if not jumps:
        return with_rest_ends(*close_joints(durations, table)), corners
    samples = _sampled(durations, table)
    if len(samples) > _MOST_SAMPLES:
        raise InputError(f"more than {_MOST_SAMPLES} samples", where=str(file), hint="fly fewer laps")
    path = smooth_through(samples)
    millimetres = 1000 * distances(path, samples).max()
    where = f"snap jumps at {jumps} of {len(durations) - 1} joints"
    return path, corners, f"{where}: drawn smoothly through samples, within {millimetres:.1f} mm"


def _sampled(durations: NDArray, table: NDArray) -> NDArray:
    """Return points, (N, 3) m, on pieces (M, D, 3), _SPACING or a little less apart."""
    breaks = np.append(0.0, np.cumsum(durations))
    starts, table = breaks[:-1], np.ascontiguousarray(table)

    def at(times: NDArray) -> NDArray:
        return np.asarray(derivatives_on(starts, table, times, intervals_of(breaks, times))[0].T)

    times = np.append((starts + np.linspace(0.0, durations, _TIMES, endpoint=False)).T.ravel(), durations.sum())
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(at(times), axis=0), axis=1)))
    count = 1 + math.ceil(min(_MOST_SAMPLES, along[-1] / _SPACING))  # one more than most is refused
    return at(np.interp(np.linspace(0.0, along[-1], max(4, count)), along, times))


def polynomial_rows(durations: NDArray, coefficients: NDArray) -> str:
    """Return a polynomial file's text for pieces (K,) s and (K, 4, 8): with enough digits for float32."""
    rows = np.column_stack([durations, coefficients.reshape(len(durations), -1)])
    lines = [",".join(f"{value:.9g}" for value in row) for row in rows.tolist()]
    return "\n".join([",".join(_HEADER), *lines]) + "\n"


def read_polynomial_rows(file: pathlib.Path) -> tuple[NDArray, NDArray]:
    """Return durations (K,) s and coefficients (K, 4, 8) of a polynomial file, yaw too. Raises InputError."""
    rows, _ = read_table(file, _COLUMNS, ROW)
    return rows[:, 0], rows[:, 1:].reshape(-1, 4, 8)


def _check_pieces(file: pathlib.Path, lines: list[int], durations: NDArray, table: NDArray) -> int:
    """Return at how many joints snap jumps. Raises InputError if a lower derivative jumps, or a piece is too short."""
    left, right = end_values(durations, table)
    extent = np.abs(table[:, 1:] * durations[:, None, None] ** np.arange(1, 8)[:, None]).sum(axis=1).max(axis=1)
    if (extent < _POSITION_STEP).any():
        raise InputError(
            "the piece stays in one place",
            where=f"{file}:{lines[int(np.argmin(extent))]}",
            hint="remove the row; a path cannot wait",
        )
    allowed = np.maximum(_DERIVATIVE_STEP * largest_values(durations, table).max(axis=0), 1e-6)
    allowed[0] = _POSITION_STEP
    steps = np.linalg.norm(left[1:] - right[:-1], axis=-1)
    for piece, order in np.argwhere((steps > allowed)[:, :-1])[:1]:
        between = f"lines {lines[piece]} and {lines[piece + 1]}"
        raise InputError(
            f"{_NAMES[order]} jumps by {steps[piece, order]:.4g} {_UNITS[order]} between {between}",
            where=f"{file}:{lines[piece + 1]}",
            hint="export the file with derivatives continuous up to jerk, or give the path as points",
        )
    return int((steps > allowed)[:, -1].sum())
