"""Bring a path to rest at both ends, and make it C⁴ where its pieces join.

A path from a file may move at its ends, or stop there with an acceleration. It is re-timed: p(σ(s)), where away from
the ends σ is s plus a constant, and near them σ' = I_u(a, 5) with u = s / L and I the regularised incomplete beta
function. This σ is a monotone polynomial that meets σ' = 1 with C⁵ and behaves as σ' ~ s^a at the end: a = 3 takes γ',
γ'', γ''' to 0 from any motion, a = 1 from rest with an acceleration. The curve in space does not change. The
composition is stored as piecewise polynomials again; on short pieces a few terms of its Taylor series reach double
precision.
"""

from math import comb, factorial

import numpy as np
from numpy.typing import NDArray

from cfplan.geometry.path import Path
from cfplan.geometry.polynomials import composed, end_values, hermite, largest_values, padded, reversed_pieces, shifted

WARP = 1.5  # s of nominal time to accelerate; at most half of the path
_WARP_PIECES = 16
_TERMS = 16  # Taylor terms kept of the composition
_NEGLIGIBLE = np.array([1e-3, 1e-2, 1e-1])  # γ', γ'', γ''' at 1 m/s; below this an end counts as at rest
_ROUNDED = np.array(
    [1e-3, 3e-3, 1e-2]
)  # the same, relative to the largest along the piece: six decimals of a slow file
_HERMITE = hermite(5)


def with_rest_ends(durations: NDArray, table: NDArray) -> Path:
    """Return the path of pieces (M, D, 3), brought to rest at both ends.

    Piece i is expanded about its left end and lasts durations[i]. s is scaled so that the mean
    of |γ'| is 1: nominal seconds at 1 m/s, independent of the source's own speed.
    """
    durations, table = _at_nominal_speed(durations, table)
    half = durations.sum() / 2
    for _ in range(2):  # the start, then the end as the start of the reversed path
        durations, table = _with_rest_start(durations, table, half)
        durations, table = reversed_pieces(durations, table)
    return rest_path(durations, table)


def rest_path(durations: NDArray, table: NDArray) -> Path:
    """Return a Path of pieces that rest at both ends, with the rounding errors there set to zero."""
    if len(durations) == 1:  # two pieces, so that each end is the origin of one
        durations = np.repeat(durations / 2, 2)
        table = np.concatenate([table, shifted(table, durations[:1])])
    table = table.copy()
    table[-1] = shifted(table[-1:], durations[-1:])[0]
    table[0, 1:4] = 0.0
    table[-1, 1:4] = 0.0
    return Path(np.concatenate([[0.0], np.cumsum(durations)]), table)


def close_joints(durations: NDArray, table: NDArray) -> tuple[NDArray, NDArray]:
    """Return the pieces made C⁴ where they join, each side moved by half of the step between them.

    What is added to each piece is the Hermite polynomial of degree 9 with these end values.
    """
    left, right = end_values(durations, table)
    step = (left[1:] - right[:-1]) / 2
    left_change, right_change = np.zeros_like(left), np.zeros_like(right)
    left_change[1:], right_change[:-1] = -step, step
    return durations, _changed(durations, table, left_change, right_change, slice(None))


def _changed(durations: NDArray, table: NDArray, left: NDArray, right: NDArray, pieces: slice) -> NDArray:
    """Return the pieces with polynomials of degree 9 added that have these end values, (n, 5, 3) each."""
    times = durations[pieces, None, None]
    powers = times ** np.arange(5)[:, None]
    result = padded(table, max(table.shape[1], 10))
    result[pieces, :10] += (
        _HERMITE @ np.concatenate([left * powers, right * powers], axis=1) / (times ** np.arange(10)[:, None])
    )
    return result


def _at_nominal_speed(durations: NDArray, table: NDArray) -> tuple[NDArray, NDArray]:
    breaks = np.concatenate([[0.0], np.cumsum(durations)])
    about_right = table.copy()
    about_right[-1] = shifted(table[-1:], durations[-1:])[0]
    stretch = Path(breaks, about_right).length / breaks[-1]
    return durations * stretch, table / stretch ** np.arange(table.shape[1])[:, None]


def _with_rest_start(durations: NDArray, table: NDArray, most: float) -> tuple[NDArray, NDArray]:
    start = end_values(durations[:1], table[:1])[0][0]
    values = np.linalg.norm(start[1:4], axis=-1)
    largest = largest_values(durations[:1], table[:1])[0, 1:4]
    if (values > np.maximum(_NEGLIGIBLE, _ROUNDED * largest)).any():
        return _warped(durations, table, 3 if values[0] > _NEGLIGIBLE[0] else 1, most)
    change = np.zeros((1, 5, 3))
    change[0, 1:4] = -start[1:4]
    return durations, _changed(durations, table, change, np.zeros((1, 5, 3)), slice(0, 1))


def _warped(durations: NDArray, table: NDArray, flatness: int, most: float) -> tuple[NDArray, NDArray]:
    """Return the pieces with their start re-timed by σ, which takes at most `most`, s, of their time."""
    sigma = _warp(flatness)
    reach = np.polynomial.polynomial.polyval(1.0, sigma)  # σ(L) / L
    breaks = np.concatenate([[0.0], np.cumsum(durations)])
    length = min(WARP, most / reach)
    u = _warp_grid(sigma, breaks / length)

    pieces = []
    for start in u[:-1]:
        local = shifted(np.repeat(sigma[None, :, None], 3, axis=2), np.array([start]))[0, :, 0]
        local *= length ** (1.0 - np.arange(len(local)))
        at = local[0]
        piece = min(int(np.searchsorted(breaks, at + 1e-12 * length, side="right")) - 1, len(durations) - 1)
        outer = shifted(table[piece : piece + 1], np.array([at - breaks[piece]]))[0]
        local[0] = 0.0
        pieces.append(composed(outer, local, _TERMS))

    joint = length * reach
    after = int(np.searchsorted(breaks, joint + 1e-9 * breaks[-1], side="right")) - 1
    cut = max(joint - breaks[after], 0.0)
    rest, rest_durations = table[after:].copy(), durations[after:].copy()
    rest[0] = shifted(rest[:1], np.array([cut]))[0]
    rest_durations[0] -= cut
    count = max(_TERMS, table.shape[1])
    return (
        np.concatenate([np.diff(u) * length, rest_durations]),
        np.concatenate([padded(np.array(pieces), count), padded(rest, count)]),
    )


def _warp_grid(sigma: NDArray, breaks: NDArray) -> NDArray:
    """Return the u in [0, 1] where pieces of the re-timed part meet: a uniform grid and every break, in units of L."""
    u = np.linspace(0.0, 1.0, _WARP_PIECES + 1)
    reach = np.polynomial.polynomial.polyval(1.0, sigma)
    joints = _inverse(sigma, breaks[(breaks > 0.0) & (breaks < reach * (1 - 1e-9))])
    if not len(joints):
        return u
    apart = np.abs(u[:, None] - joints).min(axis=1) > 0.25 / _WARP_PIECES  # much shorter pieces would lose digits
    apart[[0, -1]] = True
    return np.sort(np.concatenate([u[apart], joints]))


def _warp(flatness: int) -> NDArray:
    """Return the coefficients of σ(u) on [0, 1], where σ'' = u^(a-1) (1-u)^4 / B(a, 5)."""
    a = flatness
    norm = factorial(a + 4) / (factorial(a - 1) * factorial(4))
    sigma = np.zeros(a + 6)
    for k in range(5):
        sigma[a + 1 + k] = norm * (-1) ** k * comb(4, k) / ((a + k) * (a + 1 + k))
    return sigma


def _inverse(sigma: NDArray, values: NDArray) -> NDArray:
    """Return the u with σ(u) = value, by bisection, since σ is monotone."""
    low, high = np.zeros_like(values), np.ones_like(values)
    for _ in range(60):
        middle = (low + high) / 2
        below = np.polynomial.polynomial.polyval(middle, sigma) < values
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return (low + high) / 2
