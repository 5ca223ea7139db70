"""Attitude: fit the gyroscope to the poses. The fit gives the poses' latency and the mounting of the markers.

The gyroscope turns the vehicle's axes on the vehicle's clock, the poses those of the markers' body on motion capture's.
Over short spans both turn by the same rotation vector, seen in axes that differ by the mounting M and at times that
differ by the latency: φ_poses(t) = Mᵀ (φ_gyro(t − δ) − b T), with the gyroscope's bias b. No thrust, drag or other
model of the vehicle is involved.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from cfplan.errors import InputError
from cfplan.identification.signals import FlightSignals
from cfplan.machine_code import njit
from cfplan.vehicle.rotations import product

STEP = 0.001  # s, of the grid on which everything is integrated
_MARGIN = 0.2  # s of the grid before and behind the flight
_SPAN = 12  # poses over which turns are compared: 0.12 s at 100 Hz
# rad rms over such a span, least turn that exceeds noise; largest misfit of the poses, as a fraction of it
_MIN_TURN, _MAX_TURN_MISFIT = 0.02, 0.6
_MIN_INFORMATION, _REGULARISATION = 1e-6, 1e-9
_SMOOTHING = 0.25  # s, by which the slow difference of poses and gyroscope is smoothed


@dataclass(frozen=True, slots=True)
class AttitudeFit:
    """The fit of the gyroscope to the poses; deviations are standard deviations."""

    shift: float  # s, delay of the poses behind their time stamps
    shift_deviation: float
    mounting: NDArray  # (3,) rad, rotation vector from the vehicle's axes to the markers' body's
    mounting_deviation: NDArray  # (3,) rad
    gyro_bias: NDArray  # (3,) rad/s


def grid_of(signals: FlightSignals) -> NDArray:
    """Return the times, s, at which everything is integrated."""
    return np.arange(-_MARGIN, signals.duration + _MARGIN, STEP)


def fit_attitude(signals: FlightSignals) -> AttitudeFit:
    """Fit the poses' shift in time, the mounting and the gyroscope's bias to the turns of the flight.

    Raises InputError where the poses are those of another body.
    """
    grid = grid_of(signals)
    turned = _integrate(_rates(signals)(grid[:-1] + STEP / 2))
    inside = (signals.pose_time > 0) & (signals.pose_time < signals.duration)
    time, seen = signals.pose_time[inside], Rotation.from_quat(signals.quaternion[inside])
    first = np.arange(0, len(time) - _SPAN, _SPAN)
    begin, end = time[first], time[first + _SPAN]
    by_poses = (seen[first].inv() * seen[first + _SPAN]).as_rotvec()

    def residual(unknown: NDArray) -> NDArray:
        by_gyro = (_at(grid, turned, begin - unknown[0]).inv() * _at(grid, turned, end - unknown[0])).as_rotvec()
        by_gyro -= unknown[4:7] * (end - begin)[:, None]
        return (Rotation.from_rotvec(unknown[1:4]).inv().apply(by_gyro) - by_poses).ravel()

    found = least_squares(residual, np.zeros(7), x_scale=[0.01] * 7, loss="soft_l1", f_scale=0.02)
    spread = found.fun @ found.fun / max(len(found.fun) - 7, 1)
    turned_by = np.sqrt(np.mean((_at(grid, turned, begin).inv() * _at(grid, turned, end)).as_rotvec() ** 2))
    if turned_by > _MIN_TURN and np.sqrt(spread) > _MAX_TURN_MISFIT * turned_by:
        raise InputError(
            "the poses do not turn as the vehicle's gyroscope says",
            hint="is the body that was tracked the vehicle? `cfplan replay` shows both",
        )
    deviation = np.sqrt(np.diag(inverse_information(found.jac.T @ found.jac)) * spread)
    return AttitudeFit(float(found.x[0]), float(deviation[0]), found.x[1:4], deviation[1:4], found.x[4:7])


def smooth_attitude(signals: FlightSignals, fit: AttitudeFit) -> Rotation:
    """Return the attitude of the markers' body on the grid: fast turns by the gyroscope, slow ones by the poses."""
    grid = grid_of(signals)
    rates = _rates(signals)(grid[:-1] + STEP / 2) - fit.gyro_bias
    turned = _integrate(Rotation.from_rotvec(fit.mounting).inv().apply(rates))
    time = signals.pose_time - fit.shift
    inside = (time > grid[0]) & (time < grid[-1])
    time = time[inside]
    apart = Rotation.from_quat(signals.quaternion[inside]) * _at(grid, turned, time).inv()
    middle = apart[len(time) // 2]
    slow = gaussian_filter1d((apart * middle.inv()).as_rotvec(), _SMOOTHING / np.median(np.diff(time)), axis=0)
    on_grid = np.column_stack([np.interp(grid, time, axis) for axis in slow.T])
    return Rotation.from_rotvec(on_grid) * middle * Rotation.from_quat(turned)


def inverse_information(information: NDArray) -> NDArray:
    """Return the inverse of an information matrix (N, N), large without information; units may differ widely."""
    size = np.sqrt(np.maximum(np.diag(information), _MIN_INFORMATION))
    scaled = information / np.outer(size, size) + _REGULARISATION * np.eye(len(size))
    return np.linalg.inv(scaled) / np.outer(size, size)


def _rates(signals: FlightSignals) -> CubicSpline:
    return CubicSpline(signals.status_time, signals.gyro)


def _at(grid: NDArray, turned: NDArray, time: NDArray) -> Rotation:
    place = np.clip(((time - grid[0]) / STEP).astype(int), 0, len(grid) - 2)
    weight = ((time - grid[place]) / STEP)[:, None]
    return Rotation.from_quat(turned[place] * (1 - weight) + turned[place + 1] * weight)


@njit
def _integrate(rates: NDArray) -> NDArray:
    """Return the attitudes (N + 1, 4) that body rates (N, 3), rad/s, each for a STEP, turn the identity into."""
    out = np.zeros((len(rates) + 1, 4))
    out[0, 3] = 1.0
    for n in range(len(rates)):
        x, y, z = rates[n, 0], rates[n, 1], rates[n, 2]
        rate = np.sqrt(x * x + y * y + z * z)
        half = 0.5 * rate * STEP
        share = 0.5 * STEP if half < 1e-9 else np.sin(half) / rate
        turned = product(out[n], (x * share, y * share, z * share, np.cos(half)))
        norm = np.sqrt(turned[0] ** 2 + turned[1] ** 2 + turned[2] ** 2 + turned[3] ** 2)
        for axis in range(4):
            out[n + 1, axis] = turned[axis] / norm
    return out
