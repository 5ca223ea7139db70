"""h as a cubic B-spline on the profile's grid: coefficients to derivatives and back, and fits through samples.

On a grid of N intervals the spline has N+3 coefficients, c₋₁ to c_N+1. With Δs the step of the grid, at node n

    h = (c₋ + 4c + c₊)/6,   h'Δs = (c₊ - c₋)/2,   h''Δs² = c₋ - 2c + c₊       with c = c_n, c₋ and c₊ its neighbours

and h'''Δs³ is their third difference in the interval. h lies between the least and the largest coefficient.
yaw_spline.py does the same for yaw, a quadratic spline on the same grid.
"""

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.geometry.banded import solve_definite
from cfplan.machine_code import njit
from cfplan.vehicle.profile import SpeedProfile, h_within
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


@njit
def spline_at(cubic: NDArray, end: float, nodes: int) -> tuple[NDArray, NDArray, NDArray]:
    """Return h with two derivatives, (nodes+1,) each, of the spline with coefficients (N+3,) on another such grid."""
    s, h, dh, ddh, dddh = _on_grid(cubic, end)
    values, slopes, bends = np.empty(nodes + 1), np.empty(nodes + 1), np.empty(nodes + 1)
    k, step = 0, end / nodes
    for n in range(nodes + 1):
        place = n * step if n < nodes else end
        while k < len(dddh) - 1 and s[k + 1] <= place:
            k += 1
        values[n], slopes[n], bends[n], _ = h_within(place - s[k], h[k], dh[k], ddh[k], dddh[k])
    return values, slopes, bends


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
    """Return the weights in h of an interval's four coefficients, at a place from 0 to 1 within it."""
    x = place
    return (
        (1 - x) ** 3 / 6,
        (3 * x**3 - 6 * x**2 + 4) / 6,
        (-3 * x**3 + 3 * x**2 + 3 * x + 1) / 6,
        x**3 / 6,
    )


def _quadratic_weights_at(place: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """Return the weights of the three coefficients of a quadratic spline, likewise."""
    return (1 - place) ** 2 / 2, (1 + 2 * place - 2 * place**2) / 2, place**2 / 2


def profile_through(
    grid: NDArray, s: NDArray, h: NDArray, yaw: NDArray, *, h_stiffness: float = 0.0, yaw_stiffness: float = 0.0
) -> SpeedProfile:
    """Return the profile on `grid`, (N+1,) uniform, nearest to h and yaw, both (K,), at s, (K,) ascending.

    Errors of h count relative to h. The stiffnesses weigh the squared jumps of h''' (relative to h) and of ψ'' between
    the intervals, in units of one interval, against the mean squared error. Where samples are sparse, a little
    stiffness fills in.
    """
    turning = _fit(grid, s, yaw, np.ones_like(yaw), 2, yaw_stiffness)
    track = YawSpline.from_coefficients(turning, grid[1] - grid[0])
    return speed_through(grid, s, h, track, stiffness=h_stiffness)


def speed_through(grid: NDArray, s: NDArray, h: NDArray, yaw: YawSpline, *, stiffness: float = 0.0) -> SpeedProfile:
    """Return the result of profile_through(), with the given yaw."""
    speed = _fit(grid, s, h, 1.0 / np.square(h), 3, stiffness)
    _, values, dh, ddh, dddh = _on_grid(speed, float(grid[-1] - grid[0]))
    return SpeedProfile(grid, values, dh, ddh, dddh, yaw.yaw, yaw.dyaw, yaw.ddyaw)


def _fit(grid: NDArray, s: NDArray, values: NDArray, weights: NDArray, degree: int, stiffness: float) -> NDArray:
    """Return the coefficients, (N + degree,), of the spline of degree 2 or 3 that is nearest to the samples."""
    count = len(grid) - 1 + degree
    place = np.clip((s - grid[0]) / (grid[1] - grid[0]), 0.0, len(grid) - 1.0)  # the end may differ by rounding
    interval = np.minimum(place.astype(int), len(grid) - 2)
    basis = (weights_at if degree == 3 else _quadratic_weights_at)(place - interval)
    shares = weights / len(s)
    # The (degree + 1)-th difference of the coefficients is the jump of the highest derivative at an inner knot.
    difference = np.diff(np.eye(degree + 2), degree + 1, axis=0)[0]
    knot = np.arange(count - degree - 1)
    local = np.interp(knot + (degree + 1) / 2, _coefficient(grid, s, count), weights)
    stiff = (stiffness + 1e-9) * local / count  # the floor keeps the problem regular if an interval has no sample
    matrix, target = np.zeros((count, degree + 2)), np.zeros(count)
    for i in range(degree + 2):
        if i <= degree:
            target += np.bincount(interval + i, basis[i] * shares * values, count)
        for j in range(i, degree + 2):
            band = matrix[:, j - i]
            band += np.bincount(knot + j, stiff * difference[i] * difference[j], count)
            if j <= degree:
                band += np.bincount(interval + j, shares * basis[i] * basis[j], count)
    return solve_definite(matrix, target[:, None])[:, 0]


def _coefficient(grid: NDArray, s: NDArray, count: int) -> NDArray:
    """Return the fractional index of the coefficient with most influence at each s, ascending."""
    return (s - grid[0]) / (grid[-1] - grid[0]) * (count - 1)
