"""Features: the inputs of the networks and the meaning of their outputs; the same in training and in flight.

Lengths are measured in v²/g and times in v/g, with v the limit on speed and g gravity. In these units limits and
vehicle are a dozen numbers without dimension, `ScaledLimits`: one network knows all of them, as a dozen of its inputs.

Paths are given per step of the grid, so that only the geometry of the nodes counts: with g⁽ᵏ⁾ = γ⁽ᵏ⁾Δsᵏ, neither the
place nor the heading of a window matters, nor the unit of s; its own mean step is their unit. h is given as the
coefficients of its cubic B-spline on the grid (uᵢ = hᵢ - h″ᵢΔs²/6), as log √u/Δs, intervals a unit of time, less a
cheap reference: what each limit alone would allow at constant h, as a soft minimum (planners/expert/initial_guess.py
has the same bounds). Where the path rests, only its fourth derivative bounds the reference, as it bounds h.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.geometry.path import Path, curve_at
from cfplan.machine_code import njit
from cfplan.safety.feasibility import LEAST_SPARE, spare_thrust, spare_turning
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.profile import BoundaryState
from cfplan.vehicle.profile_spline import node_coefficients
from cfplan.vehicle.yaw_spline import YawSpline

VERSION = 2  # of all features here: a model works only with those that it was trained on
SOFTNESS = 6.0  # power of the soft minimum
ROOM = 4.0  # in log, at which the distance of a limit's bound from the reference is cut off
TINY = 1e-9  # in units of length, least size of a derivative per step
LEAST_SHARE = 0.1  # of h, least coefficient where h bends sharply within a step
SMOOTHING = 0.41  # over the root of the angular acceleration: the time over which answers are smoothed

# The dimensionless numbers by name, as in model cards; they describe limits and vehicle to a network.
NUMBERS = (
    "acceleration",  # over g; a logarithm, as are the following seven
    "angular velocity",  # times v/g
    "angular acceleration",  # times v²/g²; at most twice what motors give
    "thrust upwards",  # largest over weight, less 1
    "thrust downwards",  # 1 less the smallest over weight
    "roll authority",  # angular acceleration that motors give about each axis, times v²/g²
    "pitch authority",
    "yaw authority",
    "specific thrust",  # smallest, over g
    "tilt",  # rad
    "drag across",  # along body x and y, times v over the weight
    "drag along",  # along the thrust
)
LOGARITHMS = 8  # number of them that are logarithms
BOUNDS = 6  # speed, acceleration, jerk, snap, yaw rate, yaw acceleration

# Columns of a node table: g, g', g'', g''', the reference rate, how far above it each limit's own bound is, and yaw's
# two changes a step where it is given.
POSITION, REFERENCE, ROOMS, TURNS, COLUMNS = slice(0, 3), 12, slice(13, 13 + BOUNDS), 19, 21
# After them, the same in every row of a window: rest at start and end, start known, its rate and two differences, its
# yaw from the heading, as cos and sin of twice it because half a turn changes nothing, its change of yaw a step,
# whether yaw is the network's to choose, the window's mean step, and the numbers.
WINDOW_WIDE = 11
INPUTS = COLUMNS + WINDOW_WIDE + len(NUMBERS)
OUTPUTS = 3  # at a node: log rate over the reference, cos and sin of the yaw turned since the start of the window


class ScaledLimits(NamedTuple):
    """Limits and vehicle in units of v²/g and v/g, with v the limit on speed."""

    length: float  # m, the unit of length
    time: float  # s, the unit of time
    bounds: NDArray  # (BOUNDS,) on the path's derivatives, for h' = 0 and a thrust axis near the vertical
    numbers: NDArray  # (NUMBERS,)

    @property
    def smoothing(self) -> float:
        """Return the time over which answers are smoothed, in units of time."""
        return SMOOTHING / math.sqrt(float(self.bounds[3]))


@lru_cache(maxsize=16)
def scaled_limits(airframe: Airframe, limits: PlanLimits) -> ScaledLimits:
    """Return limits under which the vehicle can hover, in their own units."""
    time = limits.speed / GRAVITY
    up, down = (max(spare, LEAST_SPARE) for spare in spare_thrust(airframe, limits))
    spare, weight = 4.0 * min(up, down), airframe.mass * GRAVITY
    levers = (airframe.arm, airframe.arm, airframe.thrust_to_torque)
    authority = [lever * spare / inertia for lever, inertia in zip(levers, airframe.inertia, strict=True)]
    turning = min(limits.angular_acceleration, 2.0 * max(authority))
    snap = min(turning, 0.5 * spare_turning(airframe, limits))
    bends = min(limits.acceleration, GRAVITY * math.tan(min(limits.tilt, 1.0)), 4.0 * up / airframe.mass)
    rates = limits.angular_velocity * time
    bounds = np.array([
        1.0, bends / GRAVITY, rates, snap * time**2, rates, min(turning, 0.5 * authority[2]) * time**2,
    ])  # fmt: skip
    numbers = np.array([
        limits.acceleration / GRAVITY, rates, turning * time**2, 4.0 * up / weight, 4.0 * down / weight,
        *(each * time**2 for each in authority),
        limits.specific_thrust_min / GRAVITY, limits.tilt, *(each * limits.speed / weight for each in airframe.drag),
    ])  # fmt: skip
    numbers[:LOGARITHMS] = np.log(numbers[:LOGARITHMS])
    for array in (bounds, numbers):
        array.setflags(write=False)
    return ScaledLimits(limits.speed * time, time, bounds, numbers)


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


def node_features(path: Path, nodes: int, known: ScaledLimits, track: YawSpline | None) -> NDArray:
    """Return (nodes+1, COLUMNS): the features of a grid of `nodes` intervals; yaw is the track's where it is given."""
    table, step = np.empty((nodes + 1, COLUMNS)), path.end / nodes
    turns = np.zeros((nodes + 1, 2))
    if track is not None:
        turns[:, 0], turns[:-1, 1] = track.dyaw * step, track.ddyaw * step**2
        turns[-1, 1] = turns[-2, 1]
    fill_node_features(table, path.breaks, path.coefficients / known.length, 0.0, step, known.bounds, turns)
    return table


@njit(error_model="numpy")
def fill_node_features(
    out: NDArray, breaks: NDArray, coefficients: NDArray, first: float, step: float, bound: NDArray, turns: NDArray
) -> None:
    """Fill in a node table, (count, COLUMNS), of the nodes first, first + step, …

    Coefficients are in units of length, and `turns`, (count, 2), are ψ'Δs and ψ''Δs², zero where yaw is to be chosen.
    Nodes beyond the path's end get the features of its end.
    """
    curve = curve_at(breaks, coefficients, first + step * np.arange(len(out)))
    g = np.empty((5, 3))
    for n in range(len(out)):
        for order in range(5):
            for axis in range(3):
                g[order, axis] = curve[order, axis, n] * step**order
        row = out[n]
        for order in range(4):
            for axis in range(3):
                row[3 * order + axis] = g[order, axis]
        least = np.inf
        for k in range(BOUNDS):
            if k < 4:
                size, power = math.sqrt(g[k + 1, 0] ** 2 + g[k + 1, 1] ** 2 + g[k + 1, 2] ** 2), k + 1
            else:
                size, power = abs(turns[n, k - 4]), k - 3
            row[13 + k] = math.log(bound[k] / max(size, TINY)) / power
            least = min(least, row[13 + k])
        total = 0.0
        for k in range(BOUNDS):
            total += math.exp(-SOFTNESS * (row[13 + k] - least))
        row[REFERENCE] = least - math.log(total) / SOFTNESS
        for k in range(BOUNDS):
            row[13 + k] = min(row[13 + k] - row[REFERENCE], ROOM)
        row[TURNS], row[TURNS + 1] = turns[n, 0], turns[n, 1]


@njit(error_model="numpy")
def fill_inputs(
    out: NDArray, table: NDArray, rest_start: bool, rest_end: bool, known: bool, start: tuple[float, float, float],
    yaw: float, turning: float, chooses: bool, numbers: NDArray,
) -> None:  # fmt: skip
    """Fill in the inputs of a window, (W+1, INPUTS) float32, from the features of its nodes.

    The window is moved to the origin, and its first step turned into the x-z plane. `start` is from start_features();
    `yaw`, rad, and `turning`, ψ'Δs, are those at the first node; `chooses` says whether yaw is the network's to choose.
    """
    count, step = len(table), 0.0
    for n in range(count):
        step += math.sqrt(table[n, 3] ** 2 + table[n, 4] ** 2 + table[n, 5] ** 2)
    step = max(step / count, TINY)
    x, y = table[1, 0] - table[0, 0], table[1, 1] - table[0, 1]
    size = math.sqrt(x * x + y * y)
    cos, sin = (x / size, y / size) if size > TINY else (1.0, 0.0)
    relative = yaw - math.atan2(sin, cos)
    oriented = 1.0 if known or rest_start or not chooses else 0.0  # else yaw depends on what lies before the window
    for n in range(count):
        for order in range(4):
            k = 3 * order
            x, y, z = table[n, k], table[n, k + 1], table[n, k + 2]
            if order == 0:
                x, y, z = x - table[0, 0], y - table[0, 1], z - table[0, 2]
            out[n, k], out[n, k + 1], out[n, k + 2] = (
                (cos * x + sin * y) / step, (cos * y - sin * x) / step, z / step,
            )  # fmt: skip
        out[n, REFERENCE] = table[n, REFERENCE] + math.log(step)
        for k in range(REFERENCE + 1, COLUMNS):
            out[n, k] = table[n, k]
        out[n, COLUMNS] = 1.0 if rest_start else 0.0
        out[n, COLUMNS + 1] = 1.0 if rest_end else 0.0
        out[n, COLUMNS + 2] = 1.0 if known else 0.0
        out[n, COLUMNS + 3] = start[0] - table[0, REFERENCE] if known else 0.0
        out[n, COLUMNS + 4] = start[1] if known else 0.0
        out[n, COLUMNS + 5] = start[2] if known else 0.0
        out[n, COLUMNS + 6] = oriented * math.cos(2.0 * relative)
        out[n, COLUMNS + 7] = oriented * math.sin(2.0 * relative)
        out[n, COLUMNS + 8] = turning if known else 0.0
        out[n, COLUMNS + 9] = 1.0 if chooses else 0.0
        out[n, COLUMNS + 10] = math.log(step)
        for k in range(len(numbers)):
            out[n, COLUMNS + WINDOW_WIDE + k] = numbers[k]
