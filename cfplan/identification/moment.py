"""Moment: what the motors hold against the air on average, in proportion to the body's velocity.

    arm T (motors' difference, after their lag) = J dω/dt + ω × Jω ∓ M v + constant        about x and y

The log samples single motors fifty times a second, and they follow the gyroscope's noise at five hundred, so one sample
says little. The moment lasts as long as the velocity does, so thousands of samples say it to a few percent. Turning
goes with the velocity's third derivative, nearly at right angles to it: a wrong lag or inertia hardly matters.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from cfplan.identification.attitude import STEP, grid_of
from cfplan.identification.translation import FittedUnknowns, FlightModel, lagged
from cfplan.vehicle.airframe import MOTOR_TORQUE_SIGNS

_SMOOTHING = 0.02  # s
_STRIDE = 10  # of the grid
_DRIFT = 1e-6  # N m, by which the motors' torques change without a cause that is modelled: 0.04 % of one's in hover


@dataclass(frozen=True, slots=True)
class MomentFit:
    """The moment about one axis for each m/s, with its standard deviation, N m s/m."""

    value: float
    deviation: float


def fit_moments(models: Sequence[FlightModel], solution: FittedUnknowns, full_thrust: float) -> list[MomentFit]:
    """Return the moments about x by velocity along y, and about -y by velocity along x.

    `full_thrust` is that of one motor at the full command, N.
    """
    flights = list(enumerate(models))
    return [_fit([_columns(model, solution, k, full_thrust, axis) for k, model in flights]) for axis in (0, 1)]


def _columns(
    model: FlightModel, solution: FittedUnknowns, flight: int, full_thrust: float, axis: int
) -> tuple[NDArray, NDArray, NDArray]:
    """Return torque (N,), regressors (N, 2) of turning and velocity, and the window of each row; their means are 0."""
    signals, grid = model.signals, grid_of(model.signals)
    airframe, other = signals.airframe, 1 - axis

    def on_grid(values: NDArray) -> NDArray:
        return np.interp(grid, signals.status_time, values)

    slope = airframe.arm * full_thrust * (1.0 - airframe.thrust_curvature)
    rate = [on_grid(signals.gyro[:, k] - model.attitude.gyro_bias[k]) for k in range(3)]
    jx, jy, jz = airframe.inertia
    gyroscopic = (jz - jy) * rate[1] * rate[2] if axis == 0 else (jx - jz) * rate[0] * rate[2]
    torque = lagged(slope * on_grid(signals.command @ MOTOR_TORQUE_SIGNS[axis]), solution.lag) - gyroscopic
    velocity = model.velocity(grid, signals.pose_time - solution.times[flight, 0])
    along = Rotation.from_rotvec(model.attitude.mounting).apply(np.einsum("nji,nj->ni", model.turn, velocity))
    held = (-1.0 if axis == 0 else 1.0) * along[:, other]
    smooth = [gaussian_filter1d(each, _SMOOTHING / STEP) for each in (torque, rate[axis], held)]
    number = np.full(len(grid), -1)
    for window, rows in enumerate(model.windows):
        inside = (grid >= signals.pose_time[rows[0]]) & (grid <= signals.pose_time[rows[-1]])
        number[inside] = window + 1000 * flight
    keep = np.flatnonzero(number >= 0)[::_STRIDE]
    torque, turning, held = (each[keep] for each in (smooth[0], np.gradient(smooth[1], STEP), smooth[2]))
    columns = np.column_stack([turning, held])
    return torque - torque.mean(), columns - columns.mean(axis=0), number[keep]


def _fit(flights: list[tuple[NDArray, NDArray, NDArray]]) -> MomentFit:
    """Return the moment by least squares; its deviation by clusters, a window each (White 1980), and drift."""
    torque, columns, number = (np.concatenate(parts) for parts in zip(*flights, strict=True))
    inverse = np.linalg.pinv(columns.T @ columns)
    solved = inverse @ (columns.T @ torque)
    misfit = torque - columns @ solved
    scores = np.array([columns[number == n].T @ misfit[number == n] for n in np.unique(number)])
    covariance = inverse @ (scores.T @ scores) @ inverse * len(scores) / max(len(scores) - 2, 1)
    drift = _DRIFT / max(float(np.sqrt(np.mean(columns[:, 1] ** 2))), 1e-9)
    return MomentFit(float(solved[1]), math.hypot(covariance[1, 1] ** 0.5, drift))
