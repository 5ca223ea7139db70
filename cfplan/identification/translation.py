"""Translation: how the poses move under the motors' commands, given the attitude; linear in all but four unknowns.

In the axes of the markers' body, R from them to the world, F the collective command after the motors' lag:

    p̈ = R (κ F L − D Rᵀ ṗ) − g e₃          seen at p + R r, δ late

L is the airframe's lift with speed; κ (3,) is the thrust of the full command over the mass, along the thrust axis; D =
diag(d, d, d_z) the drag over the mass; r the markers' origin. Integrated twice over windows whose position and velocity
at the start are free, this is linear in κ, d, d_z, r and in the change of κ with the battery's voltage; the motors'
lag, δ and the two times of the command's steps enter nonlinearly. If masses, thrusts, drag and inertia are scaled by
one factor, the motion is the same: no record of motion determines that factor.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.signal import lfilter, savgol_filter

from cfplan.identification.attitude import STEP, AttitudeFit, fit_attitude, grid_of, smooth_attitude
from cfplan.identification.commands import CollectiveCommand, collective_command
from cfplan.identification.signals import FlightSignals
from cfplan.vehicle.airframe import GRAVITY

WINDOW = 1.0  # s over which motion is predicted from a free start
# Columns of the linear unknowns: thrust along the markers' axes, drag, origin, change of thrust with voltage.
THRUST, DRAG, AXIAL_DRAG, ORIGIN, BATTERY = slice(0, 3), 3, 4, slice(5, 8), 8
LINEAR = 9
_MIN_COVERAGE = 0.6  # fraction of a window's poses that must be present
_LONGEST_GAP = 0.06  # s without a pose or a status, in a window that counts
_VOLTAGE_SMOOTHING = 2.0  # s over which the voltage is averaged: sag under load does not reflect the state of charge
_VELOCITY_WINDOW = 15  # poses through which a cubic is drawn for the velocity that drag acts on


@dataclass(frozen=True, slots=True)
class FlightModel:
    """One flight, ready to be predicted for any of the unknowns."""

    signals: FlightSignals
    attitude: AttitudeFit
    command: CollectiveCommand
    turn: NDArray  # (G, 3, 3) markers' body→world on the grid
    windows: tuple[NDArray, ...]  # rows of the poses of each
    voltage: NDArray  # (G,) V, slow, less `reference_voltage`
    _cache: dict[tuple[float, float], NDArray] = field(default_factory=dict)

    def equations(self, lag: float, shift: float, delay: float, phase: float) -> tuple[NDArray, NDArray, NDArray]:
        """Return measured (N,) m, its regressors (N, LINEAR), and the window of each row (N,).

        The start of every window is projected out of both.
        """
        grid, signals = grid_of(self.signals), self.signals
        time = signals.pose_time - shift
        along = np.einsum("nji,nj->ni", self.turn, self._velocity(grid, time))
        lift = signals.airframe.lift_with_speed * (along[:, :2] ** 2).sum(axis=1)
        thrust = lagged(self._command(delay, phase), lag) * (1.0 + lift)
        axial = along * [0.0, 0.0, 1.0]
        accelerations = [self.turn[:, :, axis] * thrust[:, None] for axis in range(3)]
        accelerations += [-np.einsum("nij,nj->ni", self.turn, part) for part in (along - axial, axial)]
        voltage = self.turn[:, :, 2] * (thrust * self.voltage)[:, None]
        moved = [_at(grid, _twice_integrated(part), time) for part in (*accelerations, voltage)]
        turn = self.turn[np.clip(np.round((time - grid[0]) / STEP).astype(int), 0, len(grid) - 1)]
        columns = np.stack([*moved[:5], *(turn[:, :, axis] for axis in range(3)), moved[5]], axis=-1)
        measured = signals.position.copy()
        measured[:, 2] += 0.5 * GRAVITY * time**2
        parts = [_without_start(time[rows], measured[rows], columns[rows]) for rows in self.windows]
        number = [np.full(3 * len(rows), index) for index, rows in enumerate(self.windows)]
        return (
            np.concatenate([part[0] for part in parts]),
            np.concatenate([part[1] for part in parts]),
            np.concatenate(number),
        )

    def _command(self, delay: float, phase: float) -> NDArray:
        """Return the collective command; cached, as a fit requests few different ones many times."""
        key = (delay, phase)
        if key not in self._cache:
            if len(self._cache) > 50:
                self._cache.clear()
            self._cache[key] = self.command.at(delay, phase)
        return self._cache[key]

    def _velocity(self, grid: NDArray, time: NDArray) -> NDArray:
        interval = float(np.median(np.diff(time)))
        slope = savgol_filter(self.signals.position, _VELOCITY_WINDOW, 3, deriv=1, delta=interval, axis=0)
        return _at(time, slope, grid)


@dataclass(frozen=True, slots=True)
class FittedUnknowns:
    """The unknowns at the optimum."""

    linear: NDArray  # (LINEAR,) by the columns above
    lag: float  # s
    times: NDArray  # (R, 3) s, each record's shift of poses, delay of setpoints, phase of predictions
    covariance: NDArray  # of linear, lag, and the times of each record
    rms: float  # m, of the residual


def flight_model(signals: FlightSignals, reference_voltage: float) -> FlightModel:
    """Return the model of a flight; `reference_voltage`, V, is the voltage of the stated thrust."""
    attitude = fit_attitude(signals)
    turn = smooth_attitude(signals, attitude)
    return FlightModel(
        signals=signals,
        attitude=attitude,
        command=collective_command(signals),
        turn=turn.as_matrix(),
        windows=tuple(_windows(signals)),
        voltage=np.interp(grid_of(signals), signals.status_time, slow_voltage(signals)) - reference_voltage,
    )


def slow_voltage(signals: FlightSignals) -> NDArray:
    """Return the voltage (M,), V, averaged over seconds."""
    count = max(1, round(_VOLTAGE_SMOOTHING / float(np.median(np.diff(signals.status_time)))))
    return uniform_filter1d(signals.voltage, count, mode="nearest")


def lagged(command: NDArray, lag: float) -> NDArray:
    """Return the response of a first-order lag, s, to a command that is linear between the grid's points."""
    decay = np.exp(-STEP / lag)
    share = lag / STEP * (1.0 - decay)
    now, before = 1.0 - share, share - decay
    return lfilter([now, before], [1.0, -decay], command, zi=[command[0] * (1.0 - now)])[0]


def _windows(signals: FlightSignals) -> list[NDArray]:
    """Return the rows of the poses in each window without a gap."""
    expected = WINDOW / float(np.median(np.diff(signals.pose_time)))
    found = []
    for number in range(int(signals.duration / WINDOW)):
        begin = number * WINDOW
        rows = np.flatnonzero((signals.pose_time >= begin) & (signals.pose_time < begin + WINDOW))
        edges = (begin, begin + WINDOW)
        streams = (signals.pose_time[rows], signals.status_time, signals.sent_time, signals.estimate_time)
        if len(rows) >= _MIN_COVERAGE * expected and max(_gap(times, *edges) for times in streams) < _LONGEST_GAP:
            found.append(rows)
    return found


def _gap(times: NDArray, begin: float, end: float) -> float:
    """Return the longest time, s, without a message between two times."""
    inside = times[(times > begin) & (times < end)]
    return float(np.max(np.diff(np.concatenate([[begin], inside, [end]]))))


def _at(known: NDArray, values: NDArray, wanted: NDArray) -> NDArray:
    return np.column_stack([np.interp(wanted, known, axis) for axis in values.T])


def _twice_integrated(acceleration: NDArray) -> NDArray:
    return _integrated(_integrated(acceleration))


def _integrated(values: NDArray) -> NDArray:
    out = np.zeros_like(values)
    out[1:] = np.cumsum((values[1:] + values[:-1]) * (STEP / 2), axis=0)
    return out


def _without_start(time: NDArray, measured: NDArray, columns: NDArray) -> tuple[NDArray, NDArray]:
    """Take a straight line in time, the window's free start, out of both; rows by time, then axis."""
    start = np.linalg.qr(np.column_stack([np.ones(len(time)), time - time.mean()]))[0]

    def project(values: NDArray) -> NDArray:
        flat = values.reshape(len(time), -1)
        return (flat - start @ (start.T @ flat)).reshape(3 * len(time), -1)

    return project(measured)[:, 0], project(columns)
