"""Derivatives of min-snap paths by their segment times and points, by one adjoint solve of their banded equations.

The equations of least snap, M d = f, give the derivatives d at the points. A function of times, points and d changes
with times and points directly, and through d by λ·(∂f - ∂M d), where M λ is its derivative by d
(Wang et al., "Geometrically constrained trajectory optimization for multicopters", 2022).
"""

import numpy as np
from numpy.typing import NDArray

from cfplan.geometry.min_snap import ENERGY, HERMITE, REST, derivatives_at, solve_adjoint
from cfplan.geometry.polynomials import intervals_of
from cfplan.machine_code import njit


def _bases() -> NDArray:
    """Return (6, 8, 8): for each order of derivative, the matrix from values at both ends of [0, 1] to coefficients."""
    bases = [HERMITE]
    for _ in range(5):
        bases.append(np.vstack([bases[-1][1:] * np.arange(1, 8)[:, None], np.zeros(8)]))
    return np.array(bases)


BASES = _bases()


def gradient_by_times_and_points(
    points: NDArray, times: NDArray, s: NDArray, by_path: NDArray, start: NDArray | None = REST
) -> tuple[NDArray, NDArray]:
    """Return the gradient of a function of a path by its segment times, (K-1,), and its points, (K, 3).

    `by_path`, (5, 3, P), is its gradient by γ to γ'''' at the places s, (P,), along the path that pieces_through() lays
    through these points, at rest at the end. The places keep their s when the breaks between pieces move.
    """
    derivatives = derivatives_at(points, times, start, rest_end=True)
    # Sums over the places of each piece: by the values at its ends, in units of its time, and by its left point; what
    # its places contribute when they move by s, and when its time scales.
    by_ends, by_left, moved, scaled = _sum_over_places(points, times, derivatives, s, by_path, BASES)
    by_times, by_points = gradient_by_ends(points, times, derivatives, by_ends, by_left, 0 if start is None else 1)
    return by_times - scaled - (moved.sum() - moved.cumsum()), by_points


@njit(error_model="numpy")
def gradient_by_ends(
    points: NDArray, times: NDArray, derivatives: NDArray, by_ends: NDArray, by_left: NDArray, known: int
) -> tuple[NDArray, NDArray]:
    """Return the gradient by segment times, (K-1,), and points, (K, 3), of a function of the values at pieces' ends.

    `by_ends`, (K-1, 8, 3), is its gradient by ends_of(), `by_left`, (K-1, 3), that by the left point of each piece.
    Derivatives are given at the first `known` points, 0 or 1, and at the last.
    """
    count = len(times)
    right = np.zeros((count + 1, 3, 3))
    for n in range(count):
        unit = 1.0
        for order in range(3):
            unit *= times[n]
            for axis in range(3):
                right[n, order, axis] += by_ends[n, 1 + order, axis] * unit
                right[n + 1, order, axis] += by_ends[n, 5 + order, axis] * unit
    adjoint = solve_adjoint(points, times, right, known, count)
    ends, factors = ends_of(points, times, derivatives), ends_of(np.zeros_like(points), times, adjoint)
    by_times, by_points = np.zeros(count), np.zeros_like(points)
    for n in range(count):
        stiffness = times[n] ** -7.0
        for axis in range(3):
            by_step, scaled = by_ends[n, 4, axis], 0.0
            for row in range(8):
                power = row % 4
                factor = factors[n, row, axis] * stiffness
                scaled += power * by_ends[n, row, axis] * ends[n, row, axis]
                by_step -= factor * ENERGY[row, 4]
                for column in range(8):
                    scaled -= factor * ENERGY[row, column] * (power + column % 4 - 7) * ends[n, column, axis]
            by_times[n] += scaled / times[n]
            by_points[n, axis] += by_left[n, axis] - by_step
            by_points[n + 1, axis] += by_step
    return by_times, by_points


@njit(error_model="numpy")
def ends_of(points: NDArray, times: NDArray, derivatives: NDArray) -> NDArray:
    """Return (K-1, 8, 3), values at both ends of each piece, in units of its time, from its left point on."""
    ends = np.zeros((len(times), 8, 3))
    for n in range(len(times)):
        unit = 1.0
        for order in range(3):
            unit *= times[n]
            for axis in range(3):
                ends[n, 1 + order, axis] = derivatives[n, order, axis] * unit
                ends[n, 5 + order, axis] = derivatives[n + 1, order, axis] * unit
        for axis in range(3):
            ends[n, 4, axis] = points[n + 1, axis] - points[n, axis]
    return ends


@njit(error_model="numpy")
def _sum_over_places(
    points: NDArray, times: NDArray, derivatives: NDArray, s: NDArray, by_path: NDArray, bases: NDArray
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Return the gradient by the values at both ends of each piece, (K-1, 8, 3), and by its left point, (K-1, 3).

    And what the places of each piece contribute when they move by s, (K-1,), and when its time scales, (K-1,).
    """
    count = len(times)
    breaks = np.zeros(count + 1)
    for n in range(count):
        breaks[n + 1] = breaks[n] + times[n]
    by_ends, by_left = np.zeros((count, 8, 3)), np.zeros((count, 3))
    moved, scaled = np.zeros(count), np.zeros(count)
    ends, basis = np.zeros((8, 3)), np.zeros((6, 8))
    for place, piece in enumerate(intervals_of(breaks, s)):
        time = times[piece]
        u = (s[place] - breaks[piece]) / time
        for order in range(6):
            for end in range(8):
                value = 0.0
                for power in range(7, -1, -1):
                    value = value * u + bases[order, power, end]
                basis[order, end] = value
        for axis in range(3):
            unit = time
            for order in range(3):
                ends[1 + order, axis] = derivatives[piece, order, axis] * unit
                ends[5 + order, axis] = derivatives[piece + 1, order, axis] * unit
                unit *= time
            ends[4, axis] = points[piece + 1, axis] - points[piece, axis]
            by_left[piece, axis] += by_path[0, axis, place]
            moves = scales = 0.0
            unit = 1.0
            for order in range(5):
                weight = by_path[order, axis, place] / unit
                unit *= time
                here = onward = 0.0
                for end in range(8):
                    by_ends[piece, end, axis] += weight * basis[order, end]
                    here += basis[order, end] * ends[end, axis]
                    onward += basis[order + 1, end] * ends[end, axis]
                moves += weight * onward / time
                scales += order * weight * here / time
            moved[piece] += moves
            scaled[piece] += scales + u * moves
    return by_ends, by_left, moved, scaled
