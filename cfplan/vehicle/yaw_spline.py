"""Yaw that is given before the speed: ψ(s) as a parabola in each interval, C¹.

A quadratic spline on the profile's grid, fitted to the wanted angle by least squares with a penalty on its second
differences: where the wanted angle is undefined (flight straight up, a rest) or turns at once, the spline goes smoothly
across. It is the yaw of the Hopf fibration; heading differs from it by a little that vanishes with tilt.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bmat, csr_matrix, diags
from scipy.sparse.linalg import spsolve

from cfplan.geometry.path import Path
from cfplan.vehicle.profile import BoundaryState

SMOOTHING_LENGTH = 0.15
# s of nominal time, over which a sudden turn is spread
SAMPLES = 16
# an interval, where the direction of flight is followed
LEVEL = 0.1
# horizontal share of the direction of flight below which it says nothing of yaw


@dataclass(frozen=True, slots=True)
class YawTrack:
    """ψ in the profile's own terms."""

    yaw: NDArray
    # (N+1,) rad at the nodes
    dyaw: NDArray
    # (N+1,)
    ddyaw: NDArray
    # (N,) constant in each interval

    def part(self, first: int, last: int) -> "YawTrack":
        """The intervals from `first` to before `last`."""
        return YawTrack(self.yaw[first : last + 1], self.dyaw[first : last + 1], self.ddyaw[first:last])


def fixed_yaw(path: Path, nodes: int, angle: float, start: BoundaryState | None, end: BoundaryState | None) -> YawTrack:
    """One angle all along; from and to the yaw of boundary states where given."""
    if start is None and end is None:
        return YawTrack(np.full(nodes + 1, angle), np.zeros(nodes + 1), np.zeros(nodes))
    target = np.full(2 * nodes + 1, angle)
    return _fit(path, nodes, target, np.ones_like(target), start, end)


def tangent_yaw(
    path: Path, nodes: int, angle: float, start: BoundaryState | None, end: BoundaryState | None
) -> YawTrack:
    """Along the horizontal direction of flight; `angle` for a path that goes straight up or down."""
    s = np.linspace(0.0, path.end, SAMPLES * nodes + 1)
    inside = np.clip(s, 1e-4 * path.end, (1 - 1e-4) * path.end)  # at a rest end γ' = 0 has no direction
    tangent = path(inside, 1)
    tangent = tangent / np.maximum(np.linalg.norm(tangent, axis=1), 1e-300)[:, None]
    share = np.hypot(tangent[:, 0], tangent[:, 1])
    seen = share > LEVEL
    if not seen.any():
        return fixed_yaw(path, nodes, angle, start, end)
    heading = np.unwrap(np.arctan2(tangent[seen, 1], tangent[seen, 0]))
    if start is not None:  # the turn of 2π that is nearest
        heading += 2 * np.pi * np.round((start.yaw - heading[0]) / (2 * np.pi))
    wanted = np.interp(s, s[seen], heading)
    weight = np.where(seen, share**2, 0.0)
    every = SAMPLES // 2
    return _fit(path, nodes, wanted[::every], np.maximum(weight[::every], 1e-6), start, end)


def _fit(
    path: Path,
    nodes: int,
    target: NDArray,
    weight: NDArray,
    start: BoundaryState | None,
    end: BoundaryState | None,
) -> YawTrack:
    """Fit to a target at nodes and midpoints, (2 nodes + 1,)."""
    step = path.end / nodes
    size = nodes + 2
    ones = np.ones(size)
    at_nodes = diags([ones[:-1] / 2, ones[:-1] / 2], [0, 1], shape=(nodes + 1, size))
    at_middles = diags([ones / 8, 6 * ones / 8, ones / 8], [0, 1, 2], shape=(nodes, size))
    bend = diags([ones, -2 * ones, ones], [0, 1, 2], shape=(nodes, size))
    fit = at_nodes.T @ diags(weight[::2]) @ at_nodes + at_middles.T @ diags(weight[1::2]) @ at_middles
    matrix = fit + (SMOOTHING_LENGTH / step) ** 4 * (bend.T @ bend) + 1e-9 * diags(ones)
    right = at_nodes.T @ (weight[::2] * target[::2]) + at_middles.T @ (weight[1::2] * target[1::2])
    right += 1e-9 * target[np.minimum(2 * np.arange(size), 2 * nodes)]

    rows, values = [], []
    for boundary, s, first in ((start, 0.0, 0), (end, path.end, size - 2)):
        value, slope = np.zeros(size), np.zeros(size)
        value[first : first + 2] = 0.5
        slope[first : first + 2] = -1.0, 1.0
        if boundary is not None:
            rows += [value, slope]
            values += [boundary.yaw, boundary.dyaw * step]
        elif np.linalg.norm(path(s, 1)) < 1e-9:  # at rest nothing turns
            rows.append(slope)
            values.append(0.0)
    if rows:
        held = csr_matrix(np.array(rows))
        matrix = bmat([[matrix, held.T], [held, None]])
        right = np.concatenate([right, values])
    spline = spsolve(matrix.tocsc(), right)[:size]
    return YawTrack(
        yaw=(spline[:-1] + spline[1:]) / 2,
        dyaw=np.diff(spline) / step,
        ddyaw=np.diff(spline, 2) / step**2,
    )
