"""Derivatives of min-snap paths by their segment times and points, by one adjoint solve of their banded equations.

The equations of least snap, M d = f, give the derivatives d at the points. A function of times, points and d changes
with times and points directly, and through d by λ·(∂f - ∂M d), where M λ is its derivative by d
(Wang et al., "Geometrically constrained trajectory optimization for multicopters", 2022).
"""

import numpy as np
from numpy.typing import NDArray

from cfplan.geometry.min_snap import ENERGY, HERMITE, REST, derivatives_at, solve_adjoint

_POWERS = np.tile(np.arange(4), 2)  # of a segment's time, by which the values at its ends scale


def _bases() -> NDArray:
    """Return (6, 8, 8): for each order of derivative, the matrix from values at both ends of [0, 1] to coefficients."""
    bases = [HERMITE]
    for _ in range(5):
        bases.append(np.vstack([bases[-1][1:] * np.arange(1, 8)[:, None], np.zeros(8)]))
    return np.array(bases)


_BASES = _bases()


def gradient_by_times_and_points(
    points: NDArray, times: NDArray, s: NDArray, by_path: NDArray, start: NDArray | None = REST
) -> tuple[NDArray, NDArray]:
    """Return the gradient of a function of a path by its segment times, (K-1,), and its points, (K, 3).

    `by_path`, (5, 3, P), is its gradient by γ to γ'''' at the places s, (P,), along the path that pieces_through() lays
    through these points, at rest at the end. The places keep their s when the breaks between pieces move.
    """
    count = len(times)
    breaks = np.concatenate([[0.0], np.cumsum(times)])
    piece = np.clip(np.searchsorted(breaks, s, side="right") - 1, 0, count - 1)
    time = times[piece]
    u = (s - breaks[piece]) / time
    units = times[:, None] ** np.arange(1, 4)
    ends = np.zeros((count, 8, 3))  # values at both ends, in units of the segment's time, from its left point on
    ends[:, 4] = np.diff(points, axis=0)
    derivatives = derivatives_at(points, times, start, rest_end=True)
    ends[:, 1:4], ends[:, 5:] = derivatives[:-1] * units[..., None], derivatives[1:] * units[..., None]

    basis = u[:, None] ** np.arange(8) @ _BASES  # (6, P, 8)
    path = np.einsum(
        "kpr,pri->kip", basis, ends[piece]
    )  # γ to γ⁽⁵⁾ in units of the segment's time, from its left point
    weights = by_path * (time ** -np.arange(5.0)[:, None])[:, None]
    moved = (weights * path[1:]).sum(axis=(0, 1)) / time  # by s
    scaled = (np.arange(5)[:, None, None] * weights * path[:5]).sum(axis=(0, 1)) / time
    by_ends, by_left = np.zeros((count, 8, 3)), np.zeros((count, 3))
    np.add.at(by_ends, piece, np.einsum("kip,kpr->pri", weights, basis[:5]))
    np.add.at(by_left, piece, by_path[0].T)

    later = np.bincount(piece, moved, count)
    by_times = -np.bincount(piece, scaled + u * moved, count) - (later.sum() - later.cumsum())
    by_times += (_POWERS[:, None] * by_ends * ends).sum(axis=(1, 2)) / times

    by_derivatives = np.zeros((len(points), 3, 3))
    by_derivatives[:-1] += by_ends[:, 1:4] * units[..., None]
    by_derivatives[1:] += by_ends[:, 5:] * units[..., None]
    adjoint = solve_adjoint(points, times, by_derivatives, start, rest_end=True)
    factors = np.zeros((count, 8, 3))  # the adjoint at both ends, in the same units
    factors[:, 1:4], factors[:, 5:] = adjoint[:-1] * units[..., None], adjoint[1:] * units[..., None]
    stiffness = times**-7.0
    by_energy = ENERGY * (_POWERS[:, None] + _POWERS - 7)
    by_times -= np.einsum("nri,rc,nci->n", factors, by_energy, ends) * stiffness / times
    by_step = by_ends[:, 4] - np.einsum("nri,r->ni", factors, ENERGY[:, 4]) * stiffness[:, None]

    by_points = np.zeros_like(points)
    by_points[:-1] += by_left - by_step
    by_points[1:] += by_step
    return by_times, by_points
