"""h as a cubic B-spline on the profile's grid: coefficients to derivatives and back, and fits through samples.

On a grid of N intervals the spline has N+3 coefficients, c₋₁ to c_N+1. With Δs the step of the grid, at node n

    h = (c₋ + 4c + c₊)/6,   h'Δs = (c₊ - c₋)/2,   h''Δs² = c₋ - 2c + c₊       with c = c_n, c₋ and c₊ its neighbours

and h'''Δs³ is their third difference in the interval. h lies between the least and the largest coefficient. Of yaw, a
quadratic spline on the same grid, yaw_spline.py has the same.
"""

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray
from scipy import sparse
from scipy.interpolate import BSpline
from scipy.linalg import solveh_banded

from cfplan.machine_code import njit
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.rotations import Scalar
from cfplan.vehicle.yaw_spline import YawSpline

# h, h'Δs, h''Δs², h'''Δs³ where an interval begins, from its four coefficients.
AT_NODE = np.array([[1 / 6, 4 / 6, 1 / 6, 0], [-1 / 2, 0, 1 / 2, 0], [1, -2, 1, 0], [-1, 3, -3, 1]])


def spline_profile(coefficients: NDArray, end: float, yaw: YawSpline) -> SpeedProfile:
    """Return the profile whose h is the spline with these coefficients, (N+3,), on the grid from 0 to `end`."""
    s, h, dh, ddh, dddh = _on_grid(coefficients, end)
    return SpeedProfile(s, h, dh, ddh, dddh, yaw.yaw, yaw.dyaw, yaw.ddyaw)


@njit
def _on_grid(cubic: NDArray, end: float) -> tuple[NDArray, NDArray, NDArray, NDArray, NDArray]:
    """Return s, and h with two derivatives, at nodes; the third in intervals."""
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
    """Return the (N+3,) coefficients of a profile's h."""
    return coefficients_of(profile.h, profile.dh, profile.ddh, profile.s[1] - profile.s[0])


def coefficients_of(h: NDArray, dh: NDArray, ddh: NDArray, step: float) -> NDArray:
    """Return the (N+3,) coefficients of the spline that has these h, h', h'', (N+1,) each, at its nodes."""
    inner = h - ddh * step**2 / 6
    return np.concatenate([[inner[1] - 2 * step * dh[0]], inner, [inner[-2] + 2 * step * dh[-1]]])


@register_jitable
def node_coefficients(h: Scalar, slope: Scalar, bend: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """Return the three coefficients about a node where the spline has this h, h'Δs and h''Δs²."""
    return h - slope + bend / 3, h - bend / 6, h + slope + bend / 3


@register_jitable
def node_values(before: Scalar, here: Scalar, after: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """Return h, h'Δs and h''Δs² at the node with these three coefficients about it."""
    return (before + 4 * here + after) / 6, (after - before) / 2, before - 2 * here + after


def weights_at(place: Scalar) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """Return what each of an interval's four coefficients weighs in h at a place from 0 to 1 within it."""
    x = place
    return (
        (1 - x) ** 3 / 6,
        (3 * x**3 - 6 * x**2 + 4) / 6,
        (-3 * x**3 + 3 * x**2 + 3 * x + 1) / 6,
        x**3 / 6,
    )


def profile_through(
    grid: NDArray, s: NDArray, h: NDArray, yaw: NDArray, *, h_stiffness: float = 0.0, yaw_stiffness: float = 0.0
) -> SpeedProfile:
    """Return the profile on `grid`, (N+1,) uniform, nearest to h and yaw, both (K,), at s, (K,) ascending.

    Errors of h count relative to h. The stiffnesses weigh the squared jumps of h''' (relative to h) and of ψ'' between
    the intervals, in units of one interval, against the mean squared error. Where samples are sparse a little
    stiffness is what fills in.
    """
    turn = _fit(grid, s, yaw, np.ones_like(yaw), 2, yaw_stiffness)
    track = YawSpline(turn(grid), turn(grid, 1), turn(_middles(grid), 2))
    return speed_through(grid, s, h, track, stiffness=h_stiffness)


def speed_through(grid: NDArray, s: NDArray, h: NDArray, yaw: YawSpline, *, stiffness: float = 0.0) -> SpeedProfile:
    """Return what profile_through() does, with yaw as given."""
    speed = _fit(grid, s, h, 1.0 / np.square(h), 3, stiffness)
    return SpeedProfile(
        grid, speed(grid), speed(grid, 1), speed(grid, 2), speed(_middles(grid), 3), yaw.yaw, yaw.dyaw, yaw.ddyaw
    )


def _middles(grid: NDArray) -> NDArray:
    return 0.5 * (grid[1:] + grid[:-1])


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
    """Return (count - order, count): the difference of that order."""
    matrix = sparse.eye_array(count, format="csr")
    for _ in range(order):
        matrix = matrix[1:] - matrix[:-1]
    return matrix


def _coefficient(grid: NDArray, s: NDArray, count: int) -> NDArray:
    """Return which coefficient each s, ascending, touches most, as a fraction of an index."""
    return (s - grid[0]) / (grid[-1] - grid[0]) * (count - 1)
