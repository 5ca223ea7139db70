"""Reference motions of logged flights: from polynomials, from a plan, or from the logged setpoints."""

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from cfplan.errors import InputError
from cfplan.geometry.polynomial_csv import read_polynomial_rows
from cfplan.geometry.polynomials import derivatives_on, intervals_of
from cfplan.simulation.engine.lee import REFERENCE_SIZE
from cfplan.vehicle.trajectory import Trajectory

SETPOINT_PERIOD = 0.010  # s, between setpoints of the vehicle's commander, or of the stream
POSITION, YAW = slice(0, 3), 12  # columns of a reference's rows
_STEP = 0.005  # s, of the samples
_SMOOTHING = 0.20  # s, smoothing for the derivatives of logged setpoints, a staircase of 10 ms and 1 mm


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceMotion:
    """A densely sampled motion, at rest before its start and after its end."""

    source: str
    time: NDArray  # (K,) s
    rows: NDArray  # (K, 14) as in `lee`: position, velocity, acceleration, jerk, yaw, yaw rate
    sent_time: NDArray = field(default_factory=partial(np.empty, 0))  # (L,) s
    sent: NDArray = field(default_factory=partial(np.empty, (0, 20)))
    """(L, 20) full-state setpoints as `mellinger` takes them, where a computer streamed them."""

    def at(self, time: NDArray) -> NDArray:
        """Return the reference, (N, 14), at these times, s."""
        rows = np.column_stack([np.interp(time, self.time, column) for column in self.rows.T])
        rests = (time < self.time[0]) | (time > self.time[-1])
        rows[np.ix_(rests, [*range(3, YAW), YAW + 1])] = 0.0
        return rows

    def moved(self, start: float, offset: NDArray) -> "ReferenceMotion":
        """Return the reference shifted by `start`, s, in time and `offset`, (3,) m, in place."""
        rows = self.rows.copy()
        rows[:, POSITION] += offset
        return replace(self, time=self.time + start, rows=rows, sent_time=self.sent_time + start)

    def sent_at(self, time: NDArray) -> NDArray:
        """Return the full-state setpoint, (N, 20), that is in force at each time."""
        return self.sent[np.searchsorted(self.sent_time, time, side="right").clip(1) - 1]


def reference_of_polynomials(file: Path, time_scale: float = 1.0) -> ReferenceMotion:
    """Return the motion of a polynomial file of Crazyswarm, `time_scale` times as long. Raises InputError."""
    if not time_scale > 0.0:
        hint = "0.5 flies the polynomials in half their time"
        raise InputError(f"the time scale must be positive, not {time_scale:g}", where=str(file), hint=hint)
    durations, table = read_polynomial_rows(file)
    breaks = np.append(0.0, np.cumsum(durations))
    time = np.arange(0.0, breaks[-1] * time_scale + _STEP, _STEP)
    inside = np.minimum(time / time_scale, breaks[-1])
    table, piece = np.ascontiguousarray(table.swapaxes(1, 2)), intervals_of(breaks, inside)
    values = derivatives_on(breaks[:-1], table, inside, piece)
    rows = np.zeros((len(time), REFERENCE_SIZE))
    for order in range(4):
        rows[:, 3 * order : 3 * order + 3] = values[order, :3].T / time_scale**order
    rows[:, YAW], rows[:, YAW + 1] = values[0, 3], values[1, 3] / time_scale
    return ReferenceMotion(file.name, time, rows)


def reference_of_trajectory(trajectory: Trajectory, name: str) -> ReferenceMotion:
    """Return the motion of a plan."""
    time = np.arange(0.0, trajectory.duration + _STEP, _STEP)
    state = trajectory.at(np.minimum(time, trajectory.duration))
    rows = np.zeros((len(time), REFERENCE_SIZE))
    rows[:, 0:3], rows[:, 3:6], rows[:, 6:9] = state.position, state.velocity, state.acceleration
    rows[:, 9:12] = np.gradient(state.acceleration, time, axis=0)
    rows[:, YAW] = np.unwrap(state.yaw)
    rows[:, YAW + 1] = np.gradient(rows[:, YAW], time)
    return ReferenceMotion(name, time, rows)


def reference_of_setpoints(time: NDArray, setpoint: NDArray, yaw: NDArray | None = None) -> ReferenceMotion:
    """Return the motion of logged setpoints: position, velocity, and acceleration where logged, (N, 6 or 9); yaw (N,).

    A vehicle logs them as a staircase, so each is assigned to the middle of the time that it holds. Derivatives
    that are not logged are computed from the others.
    """
    grid = np.arange(time[0], time[-1], _STEP)
    known = np.column_stack([np.interp(grid, time, column) for column in setpoint.T])
    window = 2 * round(_SMOOTHING / 2 / _STEP) + 1

    def smooth(values: NDArray, derivative: int = 0) -> NDArray:
        return np.asarray(savgol_filter(values, window, 3, deriv=derivative, delta=_STEP, axis=0))

    rows = np.zeros((len(grid), REFERENCE_SIZE))
    rows[:, 0:3], rows[:, 3:6] = smooth(known[:, 0:3]), smooth(known[:, 3:6])
    rows[:, 6:9] = smooth(known[:, 6:9]) if setpoint.shape[1] > 6 else smooth(known[:, 3:6], 1)
    rows[:, 9:12] = smooth(rows[:, 6:9], 1)
    if yaw is not None:
        rows[:, YAW] = np.interp(grid, time, np.unwrap(yaw))
        rows[:, YAW + 1] = smooth(rows[:, YAW], 1)
    return ReferenceMotion("logged setpoints", grid, rows)
