"""Identify a vehicle: fit mass, thrust, motor lag, drag and latencies to its records, with their uncertainties."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from cfplan.errors import InputError
from cfplan.identification.attitude import inverse_information
from cfplan.identification.commands import PERIOD
from cfplan.identification.quantities import Identification, assemble
from cfplan.identification.signals import read_signals
from cfplan.identification.translation import BATTERY, LINEAR, FittedUnknowns, FlightModel, flight_model, slow_voltage
from cfplan.recording.record import Record

_POSE_NOISE = 1e-3  # m, unit of the misfit in the search; the uncertainties use the remaining misfit
_SHIFT_STD = 0.5e-3  # s, of the shift, besides the effect of the gyroscope's noise
_BATTERY_PRIOR = 0.1  # 1/V, standard deviation of the relative change of thrust: firmware makes up for the voltage
_LAG_RANGE = (0.01, 0.3)  # s, between which the motor lag is sought
_MAX_SHIFT = 0.1  # s, at most
_LAG_STEP, _TIME_STEP = 2e-3, 1e-3  # s, of the derivatives
_MIN_WINDOWS = 4
_SCALE = np.array([0.05, 0.01, 0.005, 0.005])


def identify(records: Sequence[Record], *, mass: float | None = None) -> Identification:
    """Identify the vehicle that flew `records`; `mass`, kg, is its weighed mass, by default that in the records.

    Raises InputError where a record holds no flight, too little of it, or that of another vehicle.
    """
    if not records:
        raise InputError("no record", hint="name at least one")
    if mass is not None and not (math.isfinite(mass) and 0.001 <= mass <= 10.0):
        raise InputError(
            f"{mass:g} kg is not the mass of a vehicle",
            where="--mass",
            hint="weigh it with its battery, and write kilograms, as 0.0331",
        )
    flights = [read_signals(record) for record in records]
    _check_same_vehicle(records)
    voltage = float(np.mean(np.concatenate([slow_voltage(flight) for flight in flights])))
    models = [flight_model(flight, voltage) for flight in flights]
    count = sum(len(model.windows) for model in models)
    if count < _MIN_WINDOWS:
        raise InputError(
            f"{count} s of flight without gaps in poses, logs and setpoints, and {_MIN_WINDOWS} are needed",
            where=str(records[0].folder),
            hint="fly flights/identify.yaml; `cfplan report` shows the gaps",
        )
    return assemble(models, fit_unknowns(models), mass=mass, voltage=voltage)


def _check_same_vehicle(records: Sequence[Record]) -> None:
    first = records[0].header.vehicle
    for record in records[1:]:
        other = record.header.vehicle
        if replace(other, name=first.name, source=first.source) != first:
            raise InputError(
                f"flown as {other.name!r}, {1e3 * other.mass:.1f} g; the first record as {first.name!r}, "
                f"{1e3 * first.mass:.1f} g",
                where=str(record.folder),
                hint="identify one vehicle at a time, from records flown with one airframe file",
            )


class _Problem:
    """The misfit of all flights as a function of the nonlinear unknowns: the lag, and three times a flight."""

    def __init__(self, models: Sequence[FlightModel]):
        self.models = models
        self._expected = np.array([model.attitude.shift for model in models])
        self._shift_stds = np.array([math.hypot(model.attitude.shift_deviation, _SHIFT_STD) for model in models])

    def start(self) -> NDArray:
        delays = [sum(model.command.delays) / 2 for model in self.models]
        times = np.column_stack([self._expected, delays, np.full(len(delays), PERIOD / 4)])
        return np.concatenate([[self.models[0].signals.airframe.motor_time_constant], times.ravel()])

    def bounds(self) -> tuple[NDArray, NDArray]:
        low, high = [_LAG_RANGE[0]], [_LAG_RANGE[1]]
        for model in self.models:
            least, most = model.command.delays
            low += [-_MAX_SHIFT, least, 0.0]
            high += [_MAX_SHIFT, max(most, least + _TIME_STEP), PERIOD]
        return np.array(low), np.array(high)

    def equations(self, unknown: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        """Return measured, regressors and the number of the window, all flights one after the other."""
        measured: list[NDArray] = []
        columns: list[NDArray] = []
        windows: list[NDArray] = []
        for model, times in zip(self.models, unknown[1:].reshape(-1, 3), strict=True):
            values, regressors, number = model.equations(unknown[0], *times)
            measured.append(values)
            columns.append(regressors)
            windows.append(number + 1000 * len(windows))
        return np.concatenate(measured), np.concatenate(columns), np.concatenate(windows)

    def solve(self, unknown: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Return the linear unknowns, the misfit (N,) m, the regressors and the windows."""
        measured, columns, windows = self.equations(unknown)
        prior = np.diag(_POSE_NOISE / self._prior_stds())[[BATTERY]]
        linear = np.linalg.lstsq(np.vstack([columns, prior]), np.append(measured, 0.0), rcond=None)[0]
        return linear, measured - columns @ linear, columns, windows

    def residual(self, unknown: NDArray) -> NDArray:
        shifts = unknown[1:].reshape(-1, 3)[:, 0]
        return np.concatenate([self.solve(unknown)[1] / _POSE_NOISE, (shifts - self._expected) / self._shift_stds])

    def jacobian(self, unknown: NDArray) -> NDArray:
        return self._differences(self.residual, unknown)

    def derivatives(self, unknown: NDArray, linear: NDArray) -> NDArray:
        """Return the derivative of the prediction by each of the unknowns, with the linear ones fixed."""

        def predicted(at: NDArray) -> NDArray:
            measured, columns, _ = self.equations(at)
            return columns @ linear - measured

        return self._differences(predicted, unknown)

    def _differences(self, function: Callable[[NDArray], NDArray], unknown: NDArray) -> NDArray:
        """Return derivatives by differences of a millisecond or two: below that the command has corners."""
        here, high, columns = function(unknown), self.bounds()[1], []
        for place in range(len(unknown)):
            step = _LAG_STEP if place == 0 else _TIME_STEP
            moved = unknown.copy()
            moved[place] += step if unknown[place] + step <= high[place] else -step
            columns.append((function(moved) - here) / (moved[place] - unknown[place]))
        return np.column_stack(columns)

    def information(self, unknown: NDArray) -> NDArray:
        """Return the prior information on the unknowns, as inverse variances."""
        known = np.zeros(LINEAR + len(unknown))
        known[:LINEAR] = self._prior_stds() ** -2
        low, high = self.bounds()
        uniform = 12.0 / (high - low) ** 2
        known[LINEAR + 1 :] = uniform[1:]
        known[LINEAR + 1 :: 3] = self._shift_stds**-2
        return known

    def _prior_stds(self) -> NDArray:
        """Return prior standard deviations of the linear unknowns, about zero."""
        airframe = self.models[0].signals.airframe
        stds = np.full(LINEAR, np.inf)
        stds[BATTERY] = _BATTERY_PRIOR * airframe.motor_thrust_max / airframe.mass
        return stds


def fit_unknowns(models: Sequence[FlightModel]) -> FittedUnknowns:
    problem = _Problem(models)
    start, bounds = problem.start(), problem.bounds()
    found = least_squares(
        problem.residual,
        np.clip(start, bounds[0] + 1e-5, bounds[1] - 1e-5),
        jac=problem.jacobian,
        bounds=bounds,
        x_scale=np.concatenate([_SCALE[:1], np.tile(_SCALE[1:], len(models))]),
        loss="soft_l1",
        f_scale=5.0,
        ftol=1e-5,
        xtol=1e-5,
        max_nfev=25,
    )
    linear, misfit, columns, windows = problem.solve(found.x)
    return FittedUnknowns(
        linear=linear,
        lag=float(found.x[0]),
        times=found.x[1:].reshape(-1, 3),
        covariance=_covariance(problem, found.x, linear, misfit, columns, windows),
        rms=float(np.sqrt(np.mean(misfit**2))),
    )


def _covariance(
    problem: _Problem, unknown: NDArray, linear: NDArray, misfit: NDArray, columns: NDArray, windows: NDArray
) -> NDArray:
    """Return the covariance of all unknowns.

    The residual is not white noise: its correlation within a window is estimated from the misfit itself, by clusters
    (White 1980), as one factor for all unknowns, as there are few windows. Priors are added as information.
    """
    jacobian = np.column_stack([columns, problem.derivatives(unknown, linear)])
    variance = float(np.mean(misfit**2))
    inverse = inverse_information(jacobian.T @ jacobian / variance + np.diag(problem.information(unknown)))
    scores = np.array([jacobian[windows == n].T @ misfit[windows == n] for n in np.unique(windows)]) / variance
    free = len(unknown) + LINEAR
    inflation = float(np.einsum("ni,ij,nj->", scores, inverse, scores)) / free * len(scores) / max(len(scores) - 1, 1)
    return inverse * max(inflation, 1.0)
