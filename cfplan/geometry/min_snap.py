"""Minimum-snap paths: degree-7 pieces through waypoints, after Mellinger and Kumar (2011).

The curve through given points with the least ∫|γ''''|² ds is a C⁶ spline of degree 7. Its unknowns are γ', γ'', γ'''
at the waypoints. Their normal equations are block-tridiagonal and positive definite, so a banded Cholesky solves them
in linear time, after scaling to a unit diagonal because segments differ in length.
"""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cfplan.errors import InputError
from cfplan.geometry.banded import solve_columns
from cfplan.geometry.path import Path
from cfplan.geometry.polynomials import hermite
from cfplan.geometry.rest import rest_path, with_rest_ends
from cfplan.machine_code import njit

MIN_SPACING = 0.01  # m; closer neighbouring waypoints count as one point mistyped
MIN_DENSE_SPACING = 0.001  # m, the same for lists of points
REMOVE_HINT = "remove one of them"
MAX_COORDINATE = 1e5  # m from the origin along each axis: beyond this rounding costs millimetres
REST = np.zeros((3, 3))  # γ', γ'', γ''' at an end that rests


def _snap_energy() -> NDArray:
    """Return (8, 8), the quadratic form in the coefficients that gives ∫ of the squared fourth derivative on [0, 1]."""
    power = np.arange(8)
    fourth = power * (power - 1) * (power - 2) * (power - 3)
    exponent = np.maximum(power[:, None] + power - 7, 1)
    return np.outer(fourth, fourth) / exponent


HERMITE = hermite(4)  # values at the ends of [0, 1] to coefficients
ENERGY = HERMITE.T @ _snap_energy() @ HERMITE  # the quadratic form in those values


def min_snap(waypoints: ArrayLike, *, nominal_speed: float = 1.0, times: ArrayLike | None = None) -> Path:
    """Return the path of least snap through waypoints, (K, 3) m, at rest at both ends.

    Each segment takes its straight length over the nominal speed, m/s, so at 1 m/s s is roughly the distance flown, m;
    or `times`, (K-1,) s, if given.

    Raises:
        InputError: fewer than two waypoints, two in a row closer than MIN_SPACING, numbers that are not finite, times
            that are not positive.
    """
    points, spans = _checked(waypoints, nominal_speed, MIN_SPACING)
    times = spans if times is None else check_times(points, times)
    return least_snap(points, times)


def least_snap(points: NDArray, times: NDArray) -> Path:
    """Return the path of min_snap() through points, (K, 3) m, with times, (K-1,) s, without its checks."""
    return rest_path(times, pieces_through(points, times, start=REST, rest_end=True))


def centripetal_times(points: ArrayLike) -> NDArray:
    """Return nominal times, (K-1,) s, for segments between points, (K, 3) m: the root of each straight length.

    If lengths differ much, the curve swings out far less than with times in proportion to lengths, and is flown faster
    (centripetal parameterisation, after Lee, "Choosing nodes in parametric curve interpolation", 1989).
    """
    return np.asarray(np.sqrt(np.linalg.norm(np.diff(np.asarray(points, dtype=float), axis=0), axis=1)))


def smooth_through(points: ArrayLike) -> Path:
    """Return the path of least snap with free ends, then brought to rest, through dense points, (K, 3) m, K at least 4.

    Rest imposed on a first segment of a few centimetres would make the path oscillate; here only the timing changes.
    """
    points, times = _checked(points, 1.0, MIN_DENSE_SPACING)
    if len(points) < 4:
        raise InputError(
            f"a smooth path with free ends needs at least four points, not {len(points)}",
            where="points",
            hint="give more points, or lay a path of least snap through these",
        )
    return with_rest_ends(times, pieces_through(points, times, start=None, rest_end=False))


def spaced(points: NDArray) -> NDArray:
    """Return points, (K, 3) m, without those closer than MIN_SPACING to the last point that is kept."""
    kept: list[NDArray] = []
    for point in points:
        if not kept or not math.dist(point, kept[-1]) < MIN_SPACING:  # NaN is kept, to be refused later
            kept.append(point)
    return np.array(kept).reshape(-1, 3)


def check_points(
    points: NDArray,
    spacing: float = MIN_SPACING,
    where: Callable[[int], str] | None = None,
    near_hint: str = REMOVE_HINT,
) -> None:
    """Refuse too few points, points too far from the origin, and neighbours closer than `spacing`, m.

    `where` turns the index of a point into the place that error messages name; `near_hint` helps with near neighbours.
    """
    where = where or (lambda index: f"waypoint {index + 1}")
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(
            f"each waypoint must be x, y, z; the array has shape {points.shape}",
            where="waypoints",
            hint="give an array (K, 3) in metres",
        )
    if len(points) < 2:
        raise InputError(
            f"a path needs at least two waypoints, not {len(points)}", where="waypoints", hint="give a start and an end"
        )
    bad = ~(np.abs(points) <= MAX_COORDINATE).all(axis=1)
    if bad.any():
        index = int(np.argmax(bad))
        raise InputError(
            f"coordinates must be numbers within {MAX_COORDINATE:g} m of the origin, not {points[index].tolist()}",
            where=where(index),
            hint="give metres in the frame of the room",
        )
    distances = np.linalg.norm(np.diff(points, axis=0), axis=1)
    near = int(np.argmin(distances))
    if distances[near] < spacing:
        raise InputError(
            f"waypoints {near + 1} and {near + 2} are {distances[near]:.4f} m apart, less than {spacing} m",
            where=where(near + 1),
            hint=near_hint if distances[near] else f"{REMOVE_HINT}: a path cannot wait at a waypoint",
        )


def check_times(points: NDArray, times: ArrayLike) -> NDArray:
    """Return the nominal times of the segments between points, (K-1,) s. Raises InputError if they are invalid."""
    spans = np.asarray(times, dtype=float)
    if spans.shape != (len(points) - 1,) or not (np.isfinite(spans).all() and (spans > 0.0).all()):
        raise InputError(
            f"{len(points) - 1} segments need as many positive times, not {spans.tolist()}",
            where="times",
            hint="leave them out to have them chosen",
        )
    return spans


def _checked(waypoints: ArrayLike, nominal_speed: float, spacing: float) -> tuple[NDArray, NDArray]:
    points = np.asarray(waypoints, dtype=float)
    check_points(points, spacing)
    if not (np.isfinite(nominal_speed) and nominal_speed > 0.0):
        raise InputError(
            f"the nominal speed must be positive, not {nominal_speed}", where="nominal_speed", hint="1 m/s is usual"
        )
    return points, np.linalg.norm(np.diff(points, axis=0), axis=1) / nominal_speed


def pieces_through(points: NDArray, times: NDArray, start: NDArray | None, rest_end: bool) -> NDArray:
    """Return (K-1, 8, 3), the polynomial of each segment about its left end, with the least snap.

    Segment i goes from points[i] to points[i + 1], (K, 3) m, in times[i], s. `start`, (3, 3), is γ', γ'', γ''' at the
    first point, None if they are free; the end rests or is free.
    """
    return np.asarray(_pieces(derivatives_at(points, times, start, rest_end), points, times, HERMITE))


def derivatives_at(points: NDArray, times: NDArray, start: NDArray | None, rest_end: bool) -> NDArray:
    """Return γ', γ'', γ''' with the least snap at each point, (K, 3, 3); see pieces_through()."""
    given = np.zeros((len(points), 3, 3))
    if start is not None:
        given[0] = start
    derivatives, definite = solve_derivatives(points, times, given, *unknown(points, start, rest_end))
    if not definite:
        far = int(np.argmax(times))
        raise InputError(
            f"from the point before it is {np.linalg.norm(points[far + 1] - points[far]):g} m, others are "
            f"{np.linalg.norm(np.diff(points, axis=0), axis=1).min():g} m apart: no smooth path joins these",
            where=f"waypoint {far + 2}",
            hint="correct the mistyped coordinate, or add points between",
        )
    return np.asarray(derivatives)


def unknown(points: NDArray, start: NDArray | None, rest_end: bool) -> tuple[int, int]:
    """Return the first point whose derivatives are unknown, and the end of these points."""
    return 0 if start is None else 1, len(points) - 1 if rest_end else len(points)


@njit(error_model="numpy")
def solve_derivatives(points: NDArray, times: NDArray, given: NDArray, first: int, last: int) -> tuple[NDArray, bool]:
    """Return γ', γ'', γ''' with the least snap at each point, (K, 3, 3), and whether there are any.

    They are unknown from point `first` on, before `last`, as unknown() returns them; elsewhere `given`, (K, 3, 3), has
    them.
    """
    derivatives = given.copy()
    if last <= first:
        return derivatives, True
    matrix, force = _equations(derivatives, points, times, first, last, ENERGY)
    solution, definite = _solve_scaled(matrix, force)
    derivatives[first:last] = solution.reshape(-1, 3, 3)
    return derivatives, definite


@njit(error_model="numpy")
def solve_adjoint(points: NDArray, times: NDArray, right: NDArray, first: int, last: int) -> NDArray:
    """Return the solution of solve_derivatives()'s equations for another right side, (K, 3, 3); 0 where given."""
    result = np.zeros((len(points), 3, 3))
    if last > first:
        matrix, _ = _equations(result, points, times, first, last, ENERGY)
        solution, _ = _solve_scaled(matrix, right[first:last].copy().reshape(-1, 3))
        result[first:last] = solution.reshape(-1, 3, 3)
    return result


@njit(error_model="numpy")
def _equations(
    derivatives: NDArray, points: NDArray, times: NDArray, first: int, last: int, unit_energy: NDArray
) -> tuple[NDArray, NDArray]:
    """Return the banded matrix and the right sides of the equations of least snap.

    Unknown are γ', γ'', γ''' at waypoints from `first` on, before `last`; elsewhere `derivatives`, (K, 3, 3), has them.
    """
    size = 3 * (last - first)
    matrix, force = np.zeros((size, 6)), np.zeros((size, 3))
    power = np.ones(4)
    for i in range(len(times)):
        # In units of each segment's time T the energy is a constant matrix; T^-7 and powers of T scale it back.
        for order in range(1, 4):
            power[order] = power[order - 1] * times[i]
        unit = 1.0 / (power[3] * power[3] * times[i])
        left, right = 3 * (i - first), 3 * (i + 1 - first)
        left_free, right_free = first <= i, i + 1 < last
        for a in range(3):
            for b in range(3):
                scale = power[a + 1] * power[b + 1] * unit
                if left_free and a >= b:
                    matrix[left + a, a - b] += unit_energy[a + 1, b + 1] * scale
                if right_free and a >= b:
                    matrix[right + a, a - b] += unit_energy[a + 5, b + 5] * scale
                beside = unit_energy[a + 5, b + 1] * scale
                if left_free and right_free:
                    matrix[right + a, 3 + a - b] += beside
                elif right_free:  # the left end is given; a right end that is not free rests
                    for axis in range(3):
                        force[right + a, axis] -= beside * derivatives[i, b, axis]
            for axis in range(3):
                moved = (points[i + 1, axis] - points[i, axis]) * power[a + 1] * unit
                if left_free:
                    force[left + a, axis] -= unit_energy[a + 1, 4] * moved
                if right_free:
                    force[right + a, axis] -= unit_energy[a + 5, 4] * moved
    return matrix, force


@njit(error_model="numpy")
def _solve_scaled(matrix: NDArray, force: NDArray) -> tuple[NDArray, bool]:
    """Solve with the diagonal scaled to 1; both arrays are changed. Return the solution, and whether there is one."""
    scale = 1.0 / np.sqrt(matrix[:, 0])
    for row in range(len(matrix)):
        for offset in range(min(row, matrix.shape[1] - 1) + 1):
            matrix[row, offset] *= scale[row] * scale[row - offset]
        for axis in range(3):
            force[row, axis] *= scale[row]
    solution, definite = solve_columns(matrix, force)
    for row in range(len(matrix)):
        for axis in range(3):
            solution[row, axis] *= scale[row]
    return solution, definite


@njit(error_model="numpy")
def _pieces(derivatives: NDArray, points: NDArray, times: NDArray, hermite: NDArray) -> NDArray:
    """Return (K-1, 8, 3), the polynomials that join points with these derivatives, each about its left end."""
    table = np.zeros((len(times), 8, 3))
    ends = np.zeros(8)
    for i in range(len(times)):
        for axis in range(3):
            ends[4] = points[i + 1, axis] - points[i, axis]
            power = 1.0
            for order in range(3):
                power *= times[i]
                ends[order + 1] = derivatives[i, order, axis] * power
                ends[order + 5] = derivatives[i + 1, order, axis] * power
            power = 1.0
            for row in range(1, 8):
                power *= times[i]
                value = 0.0
                for column in range(8):
                    value += hermite[row, column] * ends[column]
                table[i, row, axis] = value / power
            # Added last, as far from the origin it would cost short segments their precision.
            table[i, 0, axis] = points[i, axis]
    return table
