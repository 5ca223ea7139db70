"""Random waypoints and random perturbations of a path, both from a seed."""

from math import factorial

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BSpline

from cfplan.errors import InputError
from cfplan.geometry.path import Path
from cfplan.geometry.polynomials import padded, shifted

SPACING = 0.5  # m, least distance between waypoints in a row
KNOT_SPACING = 1.0  # s of nominal time between knots of a perturbation
_DRAWS_PER_WAYPOINT = 1000  # per waypoint
_DEGREE = 5  # of a perturbation: C⁴, as a path must be


def generator(seed: int | np.random.SeedSequence) -> np.random.Generator:
    """Return a generator of random numbers that are the same on every machine."""
    sequence = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
    return np.random.Generator(np.random.PCG64(sequence))


def random_waypoints(
    seed: int | np.random.SeedSequence,
    box: ArrayLike,
    count_range: tuple[int, int] = (3, 6),
    *,
    spacing: float = SPACING,
) -> NDArray:
    """Draw waypoints, (K, 3) m, uniform in a box (2, 3) of low and high corner.

    K is uniform in count_range, both ends included. Waypoints in a row are at least `spacing`, m, apart.

    Raises:
        InputError: not a box, fewer than two waypoints, or a box too small for the spacing.
    """
    low, high = np.asarray(box, dtype=float)
    if not (np.isfinite([low, high]).all() and (low <= high).all()):
        raise InputError(
            f"a box needs a low and a high corner, not {np.asarray(box).tolist()}",
            where="box",
            hint="give the low corner first, in metres",
        )
    if not 2 <= count_range[0] <= count_range[1]:
        raise InputError(
            f"a path needs at least two waypoints, not {count_range[0]} to {count_range[1]}",
            where="waypoints",
            hint="give the least number first, and at least 2",
        )
    random = generator(seed)
    count = int(random.integers(count_range[0], count_range[1], endpoint=True))
    points = [random.uniform(low, high)]
    for _ in range(_DRAWS_PER_WAYPOINT * count):
        if len(points) == count:
            break
        point = random.uniform(low, high)
        if np.linalg.norm(point - points[-1]) >= spacing:
            points.append(point)
    else:
        raise InputError(
            f"no room for waypoints {spacing} m apart in a box of {(high - low).tolist()} m",
            where="box",
            hint="give a larger box",
        )
    return np.array(points)


def perturbed(path: Path, epsilon: float, seed: int | np.random.SeedSequence) -> Path:
    """Return a perturbation of γ from the family π_ε(γ): piecewise polynomial, C⁴, within ε, m, of γ at every s.

    (The paper's "Robustness against Perturbations" requires this at the nodes; here it holds between them too.)
    The perturbation is a quintic B-spline whose control points are uniform in a ball of radius ε. A B-spline lies in
    the convex hull of its control points, which gives the bound. Three control points at each end equal a fourth, so
    a rest end stays at rest.
    """
    if not (np.isfinite(epsilon) and epsilon >= 0.0):
        raise InputError(
            f"a perturbation must be at least 0, not {epsilon}", where="epsilon", hint="give metres, as 0.05"
        )
    spans = max(5, round(path.end / KNOT_SPACING))
    knots = np.linspace(0.0, path.end, spans + 1)
    control = _in_ball(generator(seed), spans + _DEGREE, epsilon)
    control[:3], control[-3:] = control[3], control[-4]
    breaks, table = _sum(path, knots, _spline_pieces(knots, control))
    for end in (0, -1):  # rounding must not move a rest end
        table[end, 1:4] = path.coefficients[end, 1:4]
    return Path(breaks, table)


def _sum(path: Path, knots: NDArray, pieces: NDArray) -> tuple[NDArray, NDArray]:
    """Return breaks and coefficients of γ plus pieces (M, D, 3), each about its left knot, on the same range of s."""
    breaks = np.union1d(path.breaks, knots)
    breaks = breaks[np.diff(breaks, append=np.inf) > 1e-9 * path.end]  # a knot may equal a break up to rounding
    origins = breaks[:-1].copy()
    origins[-1] = path.end

    middles = (breaks[:-1] + breaks[1:]) / 2
    ours = np.searchsorted(path.breaks, middles) - 1
    theirs = np.searchsorted(knots, middles) - 1
    our_origins = path.breaks[:-1].copy()
    our_origins[-1] = path.end
    count = max(path.coefficients.shape[1], pieces.shape[1])
    table = padded(shifted(path.coefficients[ours], origins - our_origins[ours]), count)
    return breaks, table + padded(shifted(pieces[theirs], origins - knots[theirs]), count)


def _in_ball(random: np.random.Generator, count: int, radius: float) -> NDArray:
    direction = random.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return direction * radius * np.cbrt(random.uniform(size=(count, 1)))


def _spline_pieces(knots: NDArray, control: NDArray) -> NDArray:
    """Return (M, 6, 3), the clamped B-spline's polynomials about their left knots."""
    clamped = np.concatenate([np.repeat(knots[0], _DEGREE), knots, np.repeat(knots[-1], _DEGREE)])
    spline = BSpline(clamped, control, _DEGREE)
    return np.stack([spline(knots[:-1], order) / factorial(order) for order in range(_DEGREE + 1)], axis=1)
