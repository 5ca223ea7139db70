"""Yaw along a path as a quadratic spline: ψ(s) is a parabola in each interval of the profile's grid, and C¹.

Its quadratic B-spline has N+2 coefficients, c₋₁ to c_N, on a grid of N intervals:

    ψ = (c₀ + c₁)/2,   ψ'Δs = c₁ - c₀,   ψ''Δs² = c₂ - 2c₁ + c₀       where the interval of c₀, c₁, c₂ begins

Where yaw is given before the speed, the spline is fitted to the wanted angle by least squares with a penalty on its
second differences: where that angle is undefined (vertical flight, a rest) or jumps, the spline stays
smooth. This is the yaw of the Hopf fibration; heading differs from it slightly, and not at all without tilt.
"""

from dataclasses import dataclass

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.geometry import banded
from cfplan.geometry.path import Path
from cfplan.geometry.yaw import YawMode
from cfplan.machine_code import njit
from cfplan.vehicle.profile import BoundaryState, SpeedProfile

_SAME_YAW = 1e-6  # rad, and rad per nominal second, within which a yaw counts as given
SMOOTHING_LENGTH = 0.15  # s of nominal time, over which a jump is spread
SETTLING_LENGTH, TURN = (
    1.0,
    0.3,
)  # s of nominal time, at least, and rad per nominal second, to turn from a boundary state
SAMPLES = 16  # per interval, for the direction of flight
LEVEL = 0.1  # least horizontal component of the direction of flight that defines yaw
_LEAST_WEIGHT = 1e-9  # of each coefficient's target
_REST = 1e-9  # |γ'| below which a path rests
KERNEL_WIDTH = 3.0  # nodes, standard deviation of the Gaussian that smooths given angles
KERNEL_REACH = 12  # nodes on each side, where that Gaussian ends
# ψ, ψ'Δs, ψ''Δs² where an interval begins, from its three coefficients.
AT_NODE = np.array([[1 / 2, 1 / 2, 0], [-1, 1, 0], [1, -2, 1]])


@dataclass(frozen=True, slots=True)
class YawSpline:
    """ψ in the terms of a SpeedProfile over N intervals."""

    yaw: NDArray  # (N+1,) rad at the nodes, not wrapped
    dyaw: NDArray  # (N+1,)
    ddyaw: NDArray  # (N,) constant in each interval

    @classmethod
    def along(
        cls,
        path: Path,
        nodes: int,
        mode: YawMode,
        angle: float,
        start: BoundaryState | None = None,
    ) -> "YawSpline":
        """Return the yaw that `mode` gives over `nodes` intervals: tangent, or else fixed."""
        return (cls.tangent if mode is YawMode.TANGENT else cls.fixed)(path, nodes, angle, start)

    @classmethod
    def fixed(cls, path: Path, nodes: int, angle: float, start: BoundaryState | None = None) -> "YawSpline":
        """Return one angle along the whole path, from the yaw of a boundary state if given."""
        still = start is not None and abs(start.yaw - angle) < _SAME_YAW and abs(start.dyaw) < _SAME_YAW
        if start is None or still:
            return cls(np.full(nodes + 1, start.yaw if start else angle), np.zeros(nodes + 1), np.zeros(nodes))
        angle += 2 * np.pi * np.round((start.yaw - angle) / (2 * np.pi))  # the turn of 2π that is nearest
        target = np.full(2 * nodes + 1, angle)
        return _fit(path, nodes, target, np.ones_like(target), start)

    @classmethod
    def tangent(cls, path: Path, nodes: int, angle: float, start: BoundaryState | None = None) -> "YawSpline":
        """Return the horizontal direction of flight; `angle` for a path that goes straight up or down."""
        s = np.linspace(0.0, path.end, SAMPLES * nodes + 1)
        inside = np.clip(s, 1e-4 * path.end, (1 - 1e-4) * path.end)  # at a rest end γ' = 0 has no direction
        tangent = path(inside, 1)
        tangent = tangent / np.maximum(np.linalg.norm(tangent, axis=1), 1e-300)[:, None]
        share = np.hypot(tangent[:, 0], tangent[:, 1])
        seen = share > LEVEL
        if not seen.any():
            return cls.fixed(path, nodes, angle, start)
        heading = np.unwrap(np.arctan2(tangent[seen, 1], tangent[seen, 0]))
        if start is not None:  # the turn of 2π that is nearest
            heading += 2 * np.pi * np.round((start.yaw - heading[0]) / (2 * np.pi))
        every = SAMPLES // 2
        wanted = np.interp(s[::every], s[seen], heading)
        weight = np.where(seen[::every], share[::every] ** 2, 0.0)
        return _fit(path, nodes, wanted, np.maximum(weight, 1e-6), start)

    @classmethod
    def smoothed(cls, yaw: NDArray, step: float, start: BoundaryState | None) -> "YawSpline":
        """Return a smooth spline through angles at the nodes, (N+1,), smoothed by a Gaussian.

        The first and last angle are extended beyond the ends. Yaw begins in a boundary state if given.
        """
        coefficients = _smooth(np.asarray(yaw, dtype=float))
        if start is not None:
            coefficients[:2] = end_coefficients(start.yaw, start.dyaw * step)
        return cls.from_coefficients(coefficients, step)

    @classmethod
    def from_coefficients(cls, coefficients: NDArray, step: float) -> "YawSpline":
        """Return the spline with these coefficients, (N+2,), on a grid of that step."""
        turning = coefficients[1:] - coefficients[:-1]
        return cls((coefficients[:-1] + coefficients[1:]) / 2, turning / step, (turning[1:] - turning[:-1]) / step**2)

    @classmethod
    def of(cls, profile: SpeedProfile) -> "YawSpline":
        """Return the yaw of a profile."""
        return cls(profile.yaw, profile.dyaw, profile.ddyaw)

    def coefficients(self, step: float) -> NDArray:
        """Return the (N+2,) coefficients on a grid of that step."""
        half = self.dyaw * (step / 2)
        return np.append(self.yaw - half, self.yaw[-1] + half[-1])

    def part(self, first: int, last: int) -> "YawSpline":
        """Return the intervals from `first` to before `last`."""
        return YawSpline(self.yaw[first : last + 1], self.dyaw[first : last + 1], self.ddyaw[first:last])


def end_coefficients(yaw: float, turn: float) -> tuple[float, float]:
    """Return the two coefficients about a node where the spline has this ψ and this ψ'Δs."""
    return yaw - turn / 2, yaw + turn / 2


@njit(error_model="numpy")
def _smooth(yaw: NDArray) -> NDArray:
    """Return (N+2,) coefficients of smoothed angles, (N+1,): means of neighbours, level at both ends."""
    last = len(yaw) - 1
    weights, total = np.empty(2 * KERNEL_REACH + 1), 0.0
    for k in range(len(weights)):
        weights[k] = np.exp(-0.5 * ((k - KERNEL_REACH) / KERNEL_WIDTH) ** 2)
        total += weights[k]
    smooth = np.zeros(len(yaw))
    for k in range(len(weights)):
        share, ahead = weights[k] / total, k - KERNEL_REACH
        for n in range(len(yaw)):
            smooth[n] += share * yaw[min(max(n + ahead, 0), last)]
    out = np.empty(len(yaw) + 1)
    for n in range(last):
        out[n + 1] = (smooth[n + 1] + smooth[n]) / 2
    out[0], out[last + 1] = out[1], out[last]
    return out


def _turn_from(start: BoundaryState, target: NDArray, spacing: float, end: float) -> NDArray:
    """Return what to add to a target, one value each `spacing`, so that it turns gently from a boundary state's yaw."""
    away, turning = start.yaw - target[0], start.dyaw - (target[1] - target[0]) / spacing
    length = min(max(SETTLING_LENGTH, abs(away) / TURN), end)
    x = np.minimum(np.arange(len(target)) * (spacing / length), 1.0)
    return np.asarray((1 - x) ** 3 * ((1 + 3 * x + 6 * x**2) * away + x * (1 + 3 * x) * length * turning))


def _fit(path: Path, nodes: int, target: NDArray, weight: NDArray, start: BoundaryState | None) -> YawSpline:
    """Fit to a target at nodes and midpoints, (2 nodes + 1,)."""
    step, size = path.end / nodes, nodes + 2
    known, own = np.full(size, np.nan), np.ones(size, dtype=np.int64)
    if start is not None:
        target = target + _turn_from(start, target, step / 2, path.end)
        known[:2], own[:2] = end_coefficients(start.yaw, start.dyaw * step), 0
    elif np.linalg.norm(path(0.0, 1)) < _REST:  # nothing turns there: the first two are equal
        own[1] = 0
    if np.linalg.norm(path(path.end, 1)) < _REST:
        own[-1] = 0
    coefficients = _fitted(target, weight, (SMOOTHING_LENGTH / step) ** 4, own.cumsum() - 1, known)
    return YawSpline.from_coefficients(coefficients, step)


@njit(error_model="numpy")
def _fitted(target: NDArray, weight: NDArray, smoothing: float, slots: NDArray, known: NDArray) -> NDArray:
    """Return the (N+2,) coefficients of the least squares fit to a target at nodes and midpoints, (2N+1,).

    `slots`, (N+2,), is which unknown each coefficient is, unless it is `known`, where that is not NaN.
    """
    nodes = (len(target) - 1) // 2
    matrix, right = np.zeros((slots[-1] + 1, 3)), np.zeros(slots[-1] + 1)
    for k in range(nodes + 2):
        if np.isnan(known[k]):  # for a unique solution where nothing has a weight
            matrix[slots[k], 0] += _LEAST_WEIGHT
            right[slots[k]] += _LEAST_WEIGHT * target[min(2 * k, 2 * nodes)]
    for k in range(nodes):
        _add_row(matrix, right, slots, known, k, (1 / 2, 1 / 2, 0.0), weight[2 * k], target[2 * k])
        _add_row(matrix, right, slots, known, k, (1 / 8, 6 / 8, 1 / 8), weight[2 * k + 1], target[2 * k + 1])
        _add_row(matrix, right, slots, known, k, (1.0, -2.0, 1.0), smoothing, 0.0)
    _add_row(matrix, right, slots, known, nodes - 1, (0.0, 1 / 2, 1 / 2), weight[-1], target[-1])
    factor, _ = banded.factorise(matrix, 0.0, 0.0)
    unknown = banded.solve(factor, right)
    coefficients = known.copy()
    for k in range(nodes + 2):
        if np.isnan(known[k]):
            coefficients[k] = unknown[slots[k]]
    return coefficients


@register_jitable
def _add_row(matrix, right, slots, known, first, values, weight, target):
    """Add to the normal equations that these three coefficients times `values` should be the target."""
    for a in range(3):
        if not np.isnan(known[first + a]):
            target -= values[a] * known[first + a]
    for a in range(3):
        if np.isnan(known[first + a]):
            i = slots[first + a]
            right[i] += weight * values[a] * target
            for b in range(3):
                j = slots[first + b]
                if np.isnan(known[first + b]) and j <= i:
                    matrix[i, i - j] += weight * values[a] * values[b]
