"""SpeedProfiles and splines on their grid: from coefficients and back, and penalised splines through samples."""

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import sparse
from scipy.interpolate import BSpline
from scipy.linalg import solveh_banded

from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.yaw_spline import YawTrack


def profile_through(
    grid: NDArray, s: NDArray, h: NDArray, yaw: NDArray, *, h_stiffness: float = 0.0, yaw_stiffness: float = 0.0
) -> SpeedProfile:
    """The profile on `grid`, (N+1,) uniform, nearest to h and yaw, both (K,), at s, (K,) ascending.

    Errors of h count relative to h. The stiffnesses weigh the squared jumps of h''' (relative to h) and of ψ'' between
    the intervals, in units of one interval, against the mean squared error. Where samples are sparse a little
    stiffness is what fills in.
    """
    speed = _fit(grid, s, h, 1.0 / np.square(h), 3, h_stiffness)
    turn = _fit(grid, s, yaw, np.ones_like(yaw), 2, yaw_stiffness)
    middle = 0.5 * (grid[1:] + grid[:-1])
    return SpeedProfile(
        s=grid, h=speed(grid), dh=speed(grid, 1), ddh=speed(grid, 2), dddh=speed(middle, 3),
        yaw=turn(grid), dyaw=turn(grid, 1), ddyaw=turn(middle, 2),
    )  # fmt: skip


def spline_profile(cubic: NDArray, end: float, yaw: YawTrack) -> SpeedProfile:
    """The profile whose h is the cubic B-spline with these coefficients, (N+3,), on the grid from 0 to `end`."""
    return SpeedProfile(*_h_on_grid(cubic, end), yaw.yaw, yaw.dyaw, yaw.ddyaw)


@njit(cache=True)
def _h_on_grid(cubic: NDArray, end: float) -> tuple[NDArray, NDArray, NDArray, NDArray, NDArray]:
    """s, and h with two derivatives, at nodes; the third in intervals."""
    count = len(cubic) - 3
    step = end / count
    s, h, dh, ddh = np.empty(count + 1), np.empty(count + 1), np.empty(count + 1), np.empty(count + 1)
    dddh = np.empty(count)
    for n in range(count + 1):
        rise, next_rise = cubic[n + 1] - cubic[n], cubic[n + 2] - cubic[n + 1]
        second = next_rise - rise
        s[n], h[n] = n * step, cubic[n + 1] + second / 6
        dh[n], ddh[n] = (next_rise + rise) / (2 * step), second / step**2
        if n < count:
            dddh[n] = (cubic[n + 3] - cubic[n + 2] - next_rise - second) / step**3
    s[count] = end
    return s, h, dh, ddh, dddh


def h_coefficients(profile: SpeedProfile) -> NDArray:
    """(N+3,) the coefficients of h as a cubic B-spline on its grid."""
    step = profile.s[1] - profile.s[0]
    inner = profile.h - profile.ddh * step**2 / 6
    before = inner[1] - 2 * step * profile.dh[0]
    return np.concatenate([[before], inner, [inner[-2] + 2 * step * profile.dh[-1]]])


def yaw_of(profile: SpeedProfile) -> YawTrack:
    """Yaw all along."""
    return YawTrack(profile.yaw, profile.dyaw, profile.ddyaw)


def _fit(grid: NDArray, s: NDArray, values: NDArray, weights: NDArray, degree: int, stiffness: float) -> BSpline:
    step = grid[1] - grid[0]
    # Knots go on beyond the ends at the same spacing, so that differences of coefficients are derivatives everywhere.
    knots = grid[0] + step * np.arange(-degree, len(grid) + degree)
    count = len(grid) - 1 + degree
    inside = np.clip(s, knots[degree], knots[-degree - 1])  # the last knot may differ from the end by rounding
    basis = BSpline.design_matrix(inside, knots, degree)
    normal = basis.T @ sparse.diags_array(weights / len(s)) @ basis
    target = basis.T @ (weights * values) / len(s)
    # The (degree + 1)-th difference of the coefficients is the jump of the highest derivative at an inner knot.
    difference = _difference(count, degree + 1)
    local = np.interp(np.arange(count - degree - 1) + (degree + 1) / 2, _coefficient(grid, s, count), weights)
    # A floor keeps the problem regular where an interval has no sample.
    normal += difference.T @ sparse.diags_array((stiffness + 1e-9) * local / count) @ difference
    bands = np.zeros((degree + 2, count))
    for offset in range(degree + 2):
        bands[degree + 1 - offset, offset:] = normal.diagonal(offset)
    return BSpline(knots, solveh_banded(bands, target), degree)


def _difference(count: int, order: int) -> sparse.csr_array:
    """(count - order, count): the difference of that order."""
    matrix = sparse.eye_array(count, format="csr")
    for _ in range(order):
        matrix = matrix[1:] - matrix[:-1]
    return matrix


def _coefficient(grid: NDArray, s: NDArray, count: int) -> NDArray:
    """Which coefficient each s, ascending, touches most, as a fraction of an index."""
    return (s - grid[0]) / (grid[-1] - grid[0]) * (count - 1)
