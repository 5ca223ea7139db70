"""Minimum-snap paths: degree-7 pieces through waypoints, after Mellinger and Kumar (2011).

The curve through given points with the least ∫|γ''''|² ds is a C⁶ spline of degree 7. Its unknowns are γ', γ'', γ'''
at the waypoints. Their normal equations are block-tridiagonal and positive definite, so a banded Cholesky solves them
in linear time, after scaling to a unit diagonal because segments differ in length.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cfplan.errors import InputError
from cfplan.geometry.banded import solve_definite
from cfplan.geometry.path import Path
from cfplan.geometry.polynomials import hermite
from cfplan.geometry.rest import rest_path, with_rest_ends

MIN_SPACING = 0.01  # m, two waypoints in a row that are closer are one point mistyped
MIN_DENSE_SPACING = 0.001  # m, the same for lists of points
MAX_COORDINATE = 1e5  # m from the origin along each axis: beyond this rounding costs millimetres
REST = np.zeros((3, 3))  # γ', γ'', γ''' at an end that rests


def _snap_energy() -> NDArray:
    """Return (8, 8), the quadratic form in the coefficients that gives ∫ of the squared fourth derivative on [0, 1]."""
    power = np.arange(8)
    fourth = power * (power - 1) * (power - 2) * (power - 3)
    exponent = np.maximum(power[:, None] + power - 7, 1)
    return np.outer(fourth, fourth) / exponent


_HERMITE = hermite(4)
_ENERGY = _HERMITE.T @ _snap_energy() @ _HERMITE


def min_snap(waypoints: ArrayLike, *, nominal_speed: float = 1.0, times: ArrayLike | None = None) -> Path:
    """Return the path of least snap through waypoints, (K, 3) m, at rest at both ends.

    Each segment takes its straight length over the nominal speed, m/s, so at 1 m/s s is roughly the distance flown, m;
    or as long as `times`, (K-1,) s, say.

    Raises:
        InputError: fewer than two waypoints, two in a row closer than MIN_SPACING, numbers that are not finite, times
            that are not positive.
    """
    points, spans = _checked(waypoints, nominal_speed, MIN_SPACING)
    times = spans if times is None else check_times(points, times)
    return rest_path(times, pieces_through(points, times, start=REST, rest_end=True))


def centripetal_times(points: ArrayLike) -> NDArray:
    """Return nominal times, (K-1,) s, for segments between points, (K, 3) m: the root of each straight length.

    Where lengths differ much, the curve swings out far less than with times like the lengths, and is flown sooner
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


def check_points(points: NDArray, spacing: float = MIN_SPACING, where: Callable[[int], str] | None = None) -> None:
    """Refuse too few points, points too far from the origin, and neighbours closer than `spacing`, m.

    `where` turns the index of a point into the place that error messages name.
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
            hint="remove one of them",
        )


def check_times(points: NDArray, times: ArrayLike) -> NDArray:
    """Return the nominal times of the segments between points, (K-1,) s. Raises InputError where they are none."""
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
    first point, None where they are free; the end rests or is free.
    """
    derivatives = _waypoint_derivatives(points, times, start, rest_end)
    powers = times[:, None] ** np.arange(4)
    left = np.concatenate([np.zeros((len(times), 1, 3)), derivatives[:-1]], axis=1)  # (K-1, 4, 3)
    right = np.concatenate([np.diff(points, axis=0)[:, None], derivatives[1:]], axis=1)
    ends = np.concatenate([left * powers[..., None], right * powers[..., None]], axis=1)
    table = (_HERMITE @ ends) / times[:, None, None] ** np.arange(8)[:, None]
    table[:, 0] = points[:-1]  # added last: far from the origin it would cost the short segments their digits
    return table


def _waypoint_derivatives(points: NDArray, times: NDArray, start: NDArray | None, rest_end: bool) -> NDArray:
    """Return (K, 3, 3), γ', γ'', γ''' at each waypoint with the least snap."""
    count = len(points)
    # In units of each segment's time T the energy is a constant matrix; T^-7 and powers of T scale it back.
    powers = times[:, None] ** np.tile(np.arange(4), 2)
    energy = _ENERGY * powers[:, :, None] * powers[:, None, :] / times[:, None, None] ** 7

    diagonal = np.zeros((count, 3, 3))
    diagonal[:-1] += energy[:, 1:4, 1:4]
    diagonal[1:] += energy[:, 5:8, 5:8]
    beside = energy[:, 1:4, 5:8]
    force = np.zeros((count, 3, 3))
    ends = np.stack([points[:-1] - points[:-1], points[1:] - points[:-1]], axis=1)  # moving a segment costs nothing
    force[:-1] -= energy[:, 1:4][:, :, [0, 4]] @ ends
    force[1:] -= energy[:, 5:8][:, :, [0, 4]] @ ends

    first, last = 0 if start is None else 1, count - 1 if rest_end else count
    solution = np.zeros((count, 3, 3))
    if start is not None:
        solution[0] = start
        force[1] -= beside[0].T @ start
    if last > first:
        try:
            solution[first:last] = _solve_block_tridiagonal(
                diagonal[first:last], beside[first : last - 1], force[first:last]
            )
        except np.linalg.LinAlgError:
            far = int(np.argmax(times))
            raise InputError(
                f"from the point before it is {np.linalg.norm(points[far + 1] - points[far]):g} m, others are "
                f"{np.linalg.norm(np.diff(points, axis=0), axis=1).min():g} m apart: no smooth path joins these",
                where=f"waypoint {far + 2}",
                hint="correct the coordinate that slipped, or add points between",
            ) from None
    return solution


def _solve_block_tridiagonal(diagonal: NDArray, beside: NDArray, force: NDArray) -> NDArray:
    """Solve a symmetric positive definite system of 3 × 3 blocks.

    The diagonal is (n, 3, 3), the blocks right of it (n-1, 3, 3), the right-hand side `force` (n, 3, 3).
    """
    count = 3 * len(diagonal)
    scale = 1.0 / np.sqrt(np.diagonal(diagonal, axis1=1, axis2=2))  # (n, 3)
    diagonal = diagonal * scale[:, :, None] * scale[:, None, :]
    beside = beside * scale[:-1, :, None] * scale[1:, None, :]
    matrix = np.zeros((count, 6))
    for row in range(3):
        for column in range(3):
            if column >= row:
                matrix[column::3, column - row] = diagonal[:, row, column]
            matrix[3 + column :: 3, 3 + column - row] = beside[:, row, column]
    flat = solve_definite(matrix, (force * scale[..., None]).reshape(count, 3))
    return flat.reshape(-1, 3, 3) * scale[..., None]
