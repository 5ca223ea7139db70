"""Features: the inputs of the networks, and how their output becomes h and yaw; the same in training and in flight.

Everything is given per step of the grid, so that only the geometry of the nodes counts: with g⁽ᵏ⁾ = γ⁽ᵏ⁾Δsᵏ, neither
the place nor the heading of a window matters, nor the unit of s. h is given as the coefficients of its cubic B-spline
on the grid (uᵢ = hᵢ - h″ᵢΔs²/6), as log √u/Δs, intervals a second, less a cheap reference: what each limit alone would
allow at constant h, as a soft minimum (planners/expert/initial_guess.py has the same bounds). Where the path rests,
only its fourth derivative bounds the reference, as it bounds h.
"""

import math
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.geometry.path import Path, horner_step
from cfplan.machine_code import njit
from cfplan.safety.feasibility import spare_thrust, spare_turning
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.profile import BoundaryState
from cfplan.vehicle.profile_spline import node_coefficients

VERSION = 1  # of all features here: a model works only with those that it was trained on
SOFTNESS = 6.0  # power of the soft minimum
ROOM = 4.0  # in log, at which the distance of a limit's bound from the reference is cut off
TINY = 1e-9  # m, least size of a derivative per step
LEAST_SHARE = 0.1  # of h, least coefficient where h bends sharply within a step

# Columns of a node table: g, g', g'', g''', the reference rate, and how far above it each limit's own bound is.
POSITION, REFERENCE, ROOMS, COLUMNS = slice(0, 3), 12, slice(13, 17), 17
# After them, the same in every row of a window: rest at start and end, start known, its rate and two differences, its
# yaw from the heading, as cos and sin of twice it because half a turn changes nothing, and its change of yaw a step.
INPUTS = COLUMNS + 9
OUTPUTS = 3  # at a node: log rate over the reference, cos and sin of the yaw turned since the start of the window


class Bounds(NamedTuple):
    """The limits as bounds on the path's derivatives, for h' = 0 and a thrust axis near the vertical."""

    speed: float  # m/s, |γ'|√h
    acceleration: float  # m/s², |γ''|h
    jerk: float  # m/s³, |γ'''|h^1.5
    snap: float  # m/s⁴, |γ''''|h²


def bounds(airframe: Airframe, limits: PlanLimits) -> Bounds:
    """Return the bounds of a vehicle within limits."""
    up, _ = spare_thrust(airframe, limits)
    return Bounds(
        speed=float(limits.speed),
        acceleration=float(min(limits.acceleration, GRAVITY * math.tan(min(limits.tilt, 1.0)), 4 * up / airframe.mass)),
        jerk=float(GRAVITY * limits.angular_velocity),
        snap=float(GRAVITY * min(limits.angular_acceleration, 0.5 * spare_turning(airframe, limits))),
    )


def start_coefficients(state: BoundaryState, step: float) -> tuple[float, float, float]:
    """Return u₋₁, u₀, u₁ of the spline with this state at its first node."""
    return node_coefficients(state.h, state.dh * step, state.ddh * step * step)


def start_logs(state: BoundaryState, step: float) -> tuple[float, float, float]:
    """Return log √u/Δs of u₋₁, u₀, u₁ for this state."""
    return coefficient_logs(state.h, state.dh * step, state.ddh * step * step, step)


@njit
def coefficient_logs(h: float, slope: float, bend: float, step: float) -> tuple[float, float, float]:
    """Return log √u/Δs of u₋₁, u₀, u₁ from h, h'Δs, h''Δs²; coefficients near or below zero are raised."""
    least, unit = LEAST_SHARE * h, math.log(step)
    before, here, after = node_coefficients(h, slope, bend)
    return (
        0.5 * math.log(max(before, least)) - unit,
        0.5 * math.log(max(here, least)) - unit,
        0.5 * math.log(max(after, least)) - unit,
    )


@register_jitable
def start_features(before: float, first: float, after: float) -> tuple[float, float, float]:
    """Return the features of a window's start: a log rate, and its first and second difference."""
    return first, after - before, after + before - 2.0 * first


def rests(path: Path, s: float) -> bool:
    """Return whether the path rests at s."""
    return math.hypot(*path(s, 1)) < TINY


def node_features(path: Path, first: float, step: float, count: int, bound: Bounds) -> NDArray:
    """Return (count, COLUMNS): the features of the nodes first, first + step, …"""
    table = np.empty((count, COLUMNS))
    fill_node_features(table, path.breaks, path.coefficients, first, step, bound)
    return table


def window_inputs(
    table: NDArray,
    rest_start: bool,
    rest_end: bool,
    start: tuple[float, float, float] | None,
    yaw: float = 0.0,
    turning: float = 0.0,
) -> NDArray:
    """Return (W+1, INPUTS) float32: the inputs of the network for one window, from the features of its nodes.

    `start` is from start_features(); `yaw`, rad, and `turning`, ψ'Δs, are those at the first node.
    """
    out = np.empty((len(table), INPUTS), dtype=np.float32)
    known = start is not None
    fill_inputs(out, table, rest_start, rest_end, known, start or (0.0, 0.0, 0.0), yaw, turning if known else 0.0)
    return out


@njit(error_model="numpy")
def fill_node_features(
    out: NDArray, breaks: NDArray, coefficients: NDArray, first: float, step: float, bound: Bounds
) -> None:
    """See node_features. Nodes beyond the path's end get the features of its end."""
    pieces, powers = coefficients.shape[0], coefficients.shape[1]
    piece = 0
    g = np.empty((5, 3))
    for n in range(len(out)):
        s = min(max(first + n * step, 0.0), breaks[pieces])
        while piece < pieces - 1 and s >= breaks[piece + 1]:
            piece += 1
        x = s - (breaks[pieces] if piece == pieces - 1 else breaks[piece])
        for axis in range(3):
            p = (0.0, 0.0, 0.0, 0.0, 0.0)
            for k in range(powers - 1, -1, -1):
                p = horner_step(x, coefficients[piece, k, axis], p)
            g[0, axis], g[1, axis], g[2, axis] = p[0], p[1] * step, 2.0 * p[2] * step**2
            g[3, axis], g[4, axis] = 6.0 * p[3] * step**3, 24.0 * p[4] * step**4
        row = out[n]
        for order in range(4):
            for axis in range(3):
                row[3 * order + axis] = g[order, axis]
        limits = (bound.speed, bound.acceleration, bound.jerk, bound.snap)
        least = np.inf
        for k in range(4):
            size = math.sqrt(g[k + 1, 0] ** 2 + g[k + 1, 1] ** 2 + g[k + 1, 2] ** 2)
            row[13 + k] = math.log(limits[k] / max(size, TINY)) / (k + 1)
            least = min(least, row[13 + k])
        total = 0.0
        for k in range(4):
            total += math.exp(-SOFTNESS * (row[13 + k] - least))
        row[REFERENCE] = least - math.log(total) / SOFTNESS
        for k in range(4):
            row[13 + k] = min(row[13 + k] - row[REFERENCE], ROOM)


@njit
def fill_inputs(
    out: NDArray, table: NDArray, rest_start: bool, rest_end: bool, known: bool, start: tuple[float, float, float],
    yaw: float, turning: float,
) -> None:  # fmt: skip
    """See window_inputs: the window is moved to the origin, and its first step turned into the x-z plane."""
    x, y = table[1, 0] - table[0, 0], table[1, 1] - table[0, 1]
    size = math.sqrt(x * x + y * y)
    cos, sin = (x / size, y / size) if size > TINY else (1.0, 0.0)
    relative = yaw - math.atan2(sin, cos)
    for n in range(len(table)):
        for order in range(4):
            k = 3 * order
            x, y, z = table[n, k], table[n, k + 1], table[n, k + 2]
            if order == 0:
                x, y, z = x - table[0, 0], y - table[0, 1], z - table[0, 2]
            out[n, k], out[n, k + 1], out[n, k + 2] = cos * x + sin * y, cos * y - sin * x, z
        for k in range(REFERENCE, COLUMNS):
            out[n, k] = table[n, k]
        out[n, COLUMNS] = 1.0 if rest_start else 0.0
        out[n, COLUMNS + 1] = 1.0 if rest_end else 0.0
        out[n, COLUMNS + 2] = 1.0 if known else 0.0
        out[n, COLUMNS + 3] = start[0] - table[0, REFERENCE] if known else 0.0
        out[n, COLUMNS + 4] = start[1]
        out[n, COLUMNS + 5] = start[2]
        out[n, COLUMNS + 6] = math.cos(2.0 * relative)
        out[n, COLUMNS + 7] = math.sin(2.0 * relative)
        out[n, COLUMNS + 8] = turning


@njit
def fill_yaw(yaw: NDArray, first: float, answer: NDArray) -> None:
    """Write yaw at a window's first nodes, (K,) rad, not wrapped: `first`, then turned as the network answers."""
    before = math.atan2(answer[0, 2], answer[0, 1])
    yaw[0] = first
    for n in range(1, len(yaw)):
        here = math.atan2(answer[n, 2], answer[n, 1])
        change = here - before
        yaw[n] = yaw[n - 1] + change - 2.0 * math.pi * np.round(change / (2.0 * math.pi))
        before = here
