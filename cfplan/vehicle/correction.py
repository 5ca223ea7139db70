"""Correction of a plan: a shift of its positions by the repeated deviation of earlier flights.

The shift is a B-spline over the plan's time, constant with four derivatives at both ends. A corrected
trajectory is again a trajectory, along γ(s) + δ(t(s)) with the same profile, so it is certified, encoded and flown like
any other.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError
from cfplan.geometry.path import Path
from cfplan.geometry.polynomials import hermite, padded, shifted
from cfplan.vehicle.profile import ProfileSample
from cfplan.vehicle.trajectory import Trajectory

DEGREE = 5  # for a continuous fourth derivative, as snap determines angular acceleration
_ORDERS = 5  # the shift and four derivatives
_AT_REST = DEGREE - 1  # copies of a coefficient beyond an end, which make the spline constant there
_LONGEST_PIECE = 0.1  # s, within which a polynomial of degree 9 approximates the shift to 1e-7 m
_SAME = 1e-9  # fraction of a path's s, within which two ends of pieces coincide
_HERMITE = hermite(_ORDERS)


@dataclass(frozen=True, slots=True, eq=False)
class PlanCorrection:
    """A shift over the time of a plan, constant before its start and after its end.

    Raises InputError if there is no coefficient, a number is not finite, or the duration is not positive.
    """

    coefficients: NDArray  # (J, 3) m, of B-splines of DEGREE with evenly spaced knots
    duration: float  # s, of the plan

    def __post_init__(self) -> None:
        shifts = np.array(self.coefficients, dtype=float).reshape(-1, 3)
        if not (len(shifts) and np.isfinite(shifts).all() and np.isfinite(self.duration) and self.duration > 0.0):
            raise InputError("a correction is empty, not finite, or has no duration", where="correction",
                             hint="learn it anew from a flight")  # fmt: skip
        shifts.setflags(write=False)
        object.__setattr__(self, "coefficients", shifts)

    def at(self, times: NDArray) -> NDArray:
        """Return the shift and four derivatives by time, (N, 5, 3), at times of the plan, (N,) s."""
        from scipy.interpolate import BSpline  # slow to import

        own = np.clip(times, 0.0, self.duration)
        table = np.pad(self.coefficients, ((_AT_REST, _AT_REST), (0, 0)), mode="edge")
        shift = BSpline(knots_of(self.duration, len(self.coefficients)), table, DEGREE)
        return np.stack([shift(own, nu=order) for order in range(_ORDERS)], axis=1)


def knots_of(duration: float, count: int) -> NDArray:
    """Return the knots, s, of a correction of `count` coefficients."""
    inner = count + 2 * _AT_REST - DEGREE
    return duration * (np.arange(-DEGREE, inner + DEGREE + 1) / inner)


def fit_correction(times: NDArray, shifts: NDArray, duration: float, spacing: float) -> PlanCorrection:
    """Return the correction nearest to shifts, (N, 3) m at times, (N,) s, with knots about `spacing`, s, apart.

    This is a low-pass filter without phase shift, with a cut-off frequency of 1 / (2 spacing). Neighbouring times must
    be closer than the spacing.
    """
    from scipy.interpolate import BSpline

    count = max(round(duration / spacing) - 2 * _AT_REST + DEGREE, 1)
    matrix = BSpline.design_matrix(np.clip(times, 0.0, duration), knots_of(duration, count), DEGREE).toarray()
    first, last = matrix[:, : _AT_REST + 1].sum(axis=1), matrix[:, -_AT_REST - 1 :].sum(axis=1)
    if count == 1:
        matrix = np.ones((len(times), 1))
    else:
        matrix = np.column_stack([first, matrix[:, _AT_REST + 1 : -_AT_REST - 1], last])
    return PlanCorrection(np.linalg.lstsq(matrix, shifts, rcond=None)[0], duration)


def corrected(trajectory: Trajectory, correction: PlanCorrection) -> Trajectory:
    """Return the trajectory along the shifted path, with the same speed profile and yaw.

    Raises InputError if the correction is for a plan of another duration.
    """
    if abs(correction.duration - trajectory.duration) > _SAME * trajectory.duration:
        raise InputError(
            f"the correction is of a plan of {correction.duration:.3f} s, not {trajectory.duration:.3f} s",
            where="correction", hint="fly the plan of the flights that it was learned from",
        )  # fmt: skip
    path, (grid, interval) = trajectory.path, _grid(trajectory)
    length = np.diff(grid)
    scale = (length[:, None] ** np.arange(_ORDERS))[:, :, None]
    sides = [_by_path(trajectory, correction, s, trajectory.profile.at(s, interval)) for s in (grid[:-1], grid[1:])]
    unit = _HERMITE @ np.concatenate([each * scale for each in sides], axis=1)  # (M, 10, 3) on [0, 1]
    shift = unit / (length[:, None] ** np.arange(2 * _ORDERS))[:, :, None]

    breaks = np.unique(np.concatenate([path.breaks, grid]))
    breaks = np.concatenate([breaks[:1], breaks[1:-1][np.diff(breaks)[:-1] > _SAME * path.end], [path.end]])
    middle, origins = 0.5 * (breaks[:-1] + breaks[1:]), np.append(breaks[:-2], path.end)
    of_path = np.clip(np.searchsorted(path.breaks, middle) - 1, 0, len(path.origins) - 1)
    of_grid = np.clip(np.searchsorted(grid, middle) - 1, 0, len(shift) - 1)
    count = max(2 * _ORDERS, path.coefficients.shape[1])
    table = shifted(padded(shift[of_grid], count), origins - grid[of_grid])
    table[[0, -1], 1:_ORDERS] = 0.0  # up to rounding
    table += shifted(padded(path.coefficients[of_path], count), origins - path.origins[of_path])
    return Trajectory(Path(breaks, table), trajectory.profile, trajectory.airframe)


def _grid(trajectory: Trajectory) -> tuple[NDArray, NDArray]:
    """Return the ends of the polynomials of the shift, (M + 1,) s of the path, and the profile's interval of each."""
    s = trajectory.profile.s
    parts = np.maximum(np.ceil(np.diff(trajectory.time_at(s)) / _LONGEST_PIECE).astype(int), 1)
    parts[0] = max(parts[0], 3 - len(parts))  # a path has at least two pieces
    inner = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(s[:-1], s[1:], parts, strict=True)]
    return np.append(np.concatenate(inner), trajectory.path.end), np.repeat(np.arange(len(parts)), parts)


def _by_path(trajectory: Trajectory, correction: PlanCorrection, s: NDArray, sample: ProfileSample) -> NDArray:
    """Return the shift and four derivatives by s, (M, 5, 3), at s, (M,), where the profile is `sample`."""
    h, dh, ddh, dddh = (each[:, None] for each in (sample.h, sample.dh, sample.ddh, sample.dddh))
    t1 = h**-0.5  # of t(s)
    t2 = -0.5 * dh * t1**3
    t3 = 0.75 * dh**2 * t1**5 - 0.5 * ddh * t1**3
    t4 = -1.875 * dh**3 * t1**7 + 2.25 * dh * ddh * t1**5 - 0.5 * dddh * t1**3
    d0, d1, d2, d3, d4 = np.moveaxis(correction.at(trajectory.time_at(s)), 1, 0)
    return np.stack([
        d0,
        d1 * t1,
        d2 * t1**2 + d1 * t2,
        d3 * t1**3 + 3.0 * d2 * t1 * t2 + d1 * t3,
        d4 * t1**4 + 6.0 * d3 * t1**2 * t2 + d2 * (3.0 * t2**2 + 4.0 * t1 * t3) + d1 * t4,
    ], axis=1)  # fmt: skip
