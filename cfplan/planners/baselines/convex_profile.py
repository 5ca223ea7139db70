"""Smooth the convex problem's bang-bang speed into a profile that a vehicle can follow.

The time law of the distance flown, l(t), is averaged over a triangular window in time. That keeps the speed limit,
bounds jerk and snap where acceleration jumps, and makes l grow as t⁴ from rest, as it does with a finite h at a rest
end of a path, where l grows as s⁴.
"""

import numpy as np
from numpy.typing import NDArray

from cfplan.geometry.path import Path
from cfplan.planners.baselines.convex_stations import Stations
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.profile_spline import speed_through
from cfplan.vehicle.yaw_spline import YawSpline

SAMPLES_PER_INTERVAL = 8
TIME_STEPS_PER_WINDOW = 200
H_STIFFNESS = 1e-4
# Half the window's width over the duration of the flight: narrower takes gigabytes, wider leaves no speed
WINDOW_RANGE = (1e-4, 50.0)


def smooth_profile(
    path: Path, at: Stations, b: NDArray, half_width: float, nodes: int, yaw: YawSpline
) -> SpeedProfile | None:
    """Return the profile over `nodes` intervals of the speeds √b at the stations, averaged over ± half_width s.

    None where that leaves no speed at a sample.
    """
    length, speed = _averaged(at.length, b, half_width)
    grid = np.linspace(0.0, path.end, nodes + 1)
    samples = grid[-1] * (np.arange(SAMPLES_PER_INTERVAL * nodes) + 0.5) / (SAMPLES_PER_INTERVAL * nodes)
    total = at.length[-1]
    here = np.interp(samples, at.s, _graded(at.length, total))
    rate = np.interp(here, _graded(length, total), np.cbrt(speed)) ** 3
    h = np.square(rate / np.linalg.norm(path(samples, 1), axis=1))
    if not np.all((h > 0.0) & np.isfinite(h)):
        return None
    return speed_through(grid, samples, h, yaw, stiffness=H_STIFFNESS)


def _averaged(length: NDArray, b: NDArray, half_width: float) -> tuple[NDArray, NDArray]:
    """Return distance, m, and speed, m/s, at close times after averaging speed over the triangular window."""
    speed = np.sqrt(np.maximum(b, 0.0))
    duration = np.concatenate([[0.0], np.cumsum(2 * np.diff(length) / (speed[1:] + speed[:-1]))])
    half_width = float(np.clip(half_width, *(fraction * duration[-1] for fraction in WINDOW_RANGE)))
    step = half_width / TIME_STEPS_PER_WINDOW
    time = np.arange(-TIME_STEPS_PER_WINDOW, int(np.ceil(duration[-1] / step)) + TIME_STEPS_PER_WINDOW + 1) * step
    law = np.interp(time, duration, speed)  # acceleration is constant between stations: speed is linear in time
    smooth = np.pad(law, TIME_STEPS_PER_WINDOW - 1, mode="edge")
    for _ in range(2):  # a box averaged by a box is a triangle
        total = np.concatenate([[0.0], np.cumsum(smooth)])
        smooth = (total[TIME_STEPS_PER_WINDOW:] - total[:-TIME_STEPS_PER_WINDOW]) / TIME_STEPS_PER_WINDOW
    gone = np.concatenate([[0.0], np.cumsum(0.5 * (smooth[1:] + smooth[:-1])) * step])
    gone -= half_width * speed[0]  # a flight that starts in motion was already under way
    return gone * (length[-1] + half_width * speed[-1]) / gone[-1], smooth


def _graded(distance: NDArray, total: float) -> NDArray:
    """Return distance stretched so that a rest end, where it grows as s⁴ and as t⁴, looks linear in s and in t."""
    half, inside = total / 2, np.clip(distance, 0.0, total)
    return np.where(inside < half, inside**0.25, 2 * half**0.25 - (total - inside) ** 0.25)
