"""Speed, acceleration and collective thrust as linear rows in (b, ½b') at each station, from outside or from inside.

With x the direction of flight and y that of the curvature vector, the limits are two discs in that plane:

    (½b')² + (κb)² ≤ a_max²
    (½b' + g e₃·T + d√b)² + (κb + g e₃·N)² + (g e₃·B)² ≤ F²,   F = 4 u_max/m + c√b

with d the drag in the rotor plane over mass and c the difference of drag along the thrust axis, as in flatness.
√b is concave: for b ≤ w² it lies above its chord b/w and below its tangent (b + w²)/(2w). The rows are therefore linear
for drag of either sign, and tight if w, the upper bound `fastest` on speed around a station, is tight.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.planners.baselines.convex_stations import Stations
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.airframe import GRAVITY, Airframe

DIRECTIONS = 64  # of the polygon about a disc: outside by 0.12 % at the corners, inside by as much at the sides


@dataclass(frozen=True, slots=True)
class Rows:
    """first b + second ½b' ≤ most at each of M stations, and b ≤ ceiling there."""

    first: NDArray  # (M, R) 1/m
    second: NDArray  # (M, R) 1
    most: NDArray  # (M, R) m/s²
    ceiling: NDArray  # (M,) m²/s²


def outer_rows(at: Stations, airframe: Airframe, limits: PlanLimits, fastest: NDArray) -> Rows:
    """Return rows that every feasible motion meets, also if ½b' is its mean over either interval beside the station.

    A limit holds for the mean of a motion over an interval as it does at each of its points, because discs are
    convex. The mean of b there is within a_max Δ of b at the station because |½b'| ≤ a_max; curvature and the frame
    are bounded over both intervals, and speed there is at most `fastest`, (M,) m/s.
    """
    spacing = np.diff(at.length)
    swing = limits.acceleration * np.maximum(np.append(spacing, 0.0), np.insert(spacing, 0, 0.0))
    x, y = _directions()
    drag, excess = _drag(airframe)
    force = 4 * limits.motor_thrust_max / airframe.mass

    # κb: at least low·(b - swing) and at most high·(b + swing)
    bend = np.where(y > 0, at.curvature_low[:, None], at.curvature_high[:, None]) * y
    bend_slack = np.abs(bend) * swing[:, None]
    up = y >= -1e-12  # κb is never negative: the disc's lower half forbids nothing
    acceleration = (bend[:, up], np.broadcast_to(x[up], bend[:, up].shape), limits.acceleration + bend_slack[:, up])

    slope = GRAVITY * np.where(x > 0, at.slope_low[:, None], at.slope_high[:, None]) * x
    normal = GRAVITY * np.where(y > 0, at.normal_low[:, None], at.normal_high[:, None]) * y
    radius_square = force**2 - GRAVITY**2 * at.binormal_square_low
    radius = np.sqrt(np.maximum(radius_square, 0.0))[:, None]
    # d√b against flight helps to brake (x < 0), and c√b adds to the force
    w = fastest[:, None]
    chord, tangent, rest = 1 / w, 1 / (2 * w), w / 2
    growth = excess * force / np.maximum(radius, 1e-3)  # √(F² - …) is concave in F: under its tangent
    first = np.where(x > 0, x * drag * chord, x * drag * tangent) - growth * tangent
    constant = np.where(x > 0, 0.0, x * drag * rest) - growth * rest
    slack = bend_slack + np.abs(first) * swing[:, None]
    thrust = (bend + first, np.broadcast_to(x, bend.shape), radius - slope - normal - constant + slack)

    with np.errstate(divide="ignore"):
        turning = np.where(at.curvature > 0, limits.acceleration / at.curvature, np.inf)
    return Rows(
        *_beside(acceleration, thrust),
        np.minimum(limits.speed**2, turning),
    )


def inner_rows(at: Stations, airframe: Airframe, limits: PlanLimits, fastest: NDArray) -> Rows:
    """Return rows that imply the limits at the stations, where speed is at most `fastest`, (M,) m/s."""
    x, y = _directions()
    w = fastest[:, None]
    inside = np.cos(np.pi / DIRECTIONS)
    drag, excess = _drag(airframe)
    force = 4 * limits.motor_thrust_max / airframe.mass
    bend = at.curvature[:, None] * y
    up = y >= -1e-12
    acceleration = (
        bend[:, up], np.broadcast_to(x[up], bend[:, up].shape),
        np.full_like(bend[:, up], limits.acceleration * inside),
    )  # fmt: skip

    shift = GRAVITY * (at.slope[:, None] * x + at.normal[:, None] * y)
    radius_square = force**2 - GRAVITY**2 * at.binormal_square
    radius = np.sqrt(np.maximum(radius_square, 0.0))[:, None] * inside
    weakest = np.maximum(force - excess * fastest, 0.0) ** 2 - GRAVITY**2 * at.binormal_square
    loss = (radius - np.sqrt(np.maximum(weakest, 0.0))[:, None] * inside) / w  # and over its chord
    chord, tangent, rest = 1 / w, 1 / (2 * w), w / 2
    first = np.where(x > 0, x * drag * tangent, x * drag * chord) + loss * tangent
    constant = np.where(x > 0, x * drag * rest, 0.0) + loss * rest
    thrust = (bend + first, np.broadcast_to(x, bend.shape), radius - shift - constant)

    with np.errstate(divide="ignore"):
        turning = np.where(at.curvature > 0, limits.acceleration / at.curvature, np.inf)
    return Rows(
        *_beside(acceleration, thrust),
        np.minimum(limits.speed**2, turning) * inside,
    )


def _beside(one: tuple[NDArray, ...], other: tuple[NDArray, ...]) -> tuple[NDArray, NDArray, NDArray]:
    first, second, most = (np.concatenate(pair, axis=1) for pair in zip(one, other, strict=True))
    return first, second, most


def _directions() -> tuple[NDArray, NDArray]:
    angle = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    return np.cos(angle), np.sin(angle)


def _drag(airframe: Airframe) -> tuple[float, float]:
    """Return drag in the rotor plane over mass, and the difference of drag along the thrust axis from it, 1/s."""
    plane, axial = airframe.drag
    return plane / airframe.mass, abs(axial - plane) / airframe.mass
