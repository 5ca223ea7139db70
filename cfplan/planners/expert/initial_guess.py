"""Initial guesses of speed profiles: slow enough everywhere, smooth, and blended into a boundary state."""

import numpy as np
from numpy.typing import NDArray

from cfplan.geometry.path import Path
from cfplan.machine_code import njit
from cfplan.planners.expert.tuning import TUNING
from cfplan.safety.feasibility import spare_thrust, spare_turning
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.profile import BoundaryState
from cfplan.vehicle.profile_spline import node_coefficients
from cfplan.vehicle.yaw_spline import end_coefficients

_G = TUNING.guess
_REACH = int(4.0 * _G.smoothing + 0.5)  # intervals
_GAUSSIAN = np.exp(-0.5 / _G.smoothing**2 * np.arange(-_REACH, _REACH + 1) ** 2)
_WEIGHTS = _GAUSSIAN / _GAUSSIAN.sum()


def guess(
    path: Path,
    airframe: Airframe,
    limits: PlanLimits,
    nodes: int,
    *,
    unit: float,
    start: BoundaryState | None,
    yaw: float | None,
) -> NDArray:
    """Return (N+3, 1 or 2) spline coefficients: of h over its `unit`, and of yaw.

    `yaw` is the initial yaw if the start does not give it; None: no yaw is guessed.
    """
    step = path.end / nodes
    cubic = led_into(guess_spline(path, airframe, limits, nodes) / unit, unit, step, start)
    if yaw is None:
        return cubic[:, None]
    return np.stack([cubic, np.append(_yaw(start, yaw, nodes, step), 0.0)], axis=1)


def led_into(coefficients: NDArray, unit: float, step: float, start: BoundaryState | None) -> NDArray:
    """Change (N+3,) coefficients of h over its `unit` so that they begin in the boundary state and leave it smoothly.

    The given coefficients must be positive; `step` is the length of an interval in s.
    """
    led = coefficients.copy()
    if start:
        first = node_coefficients(start.h / unit, start.dh * step / unit, start.ddh * step**2 / unit)
        if min(first) > 0:
            led[1:] *= np.exp(_leave(np.log(first[1:]) - np.log(led[1:3]), len(led) - 1))
        led[:3] = first
    return led


def _leave(offsets: NDArray, count: int) -> NDArray:
    """Return (count,): from two offsets smoothly to zero."""
    x = np.arange(count) - 1.0
    last, slope = offsets[1], offsets[1] - offsets[0]
    left = np.clip(1.0 - x / (count - 2), 0.0, 1.0)
    return (last + x * (slope + last / _G.h_blend)) * np.exp(-x / _G.h_blend) * left**2 * (3.0 - 2.0 * left)


def _yaw(start: BoundaryState | None, yaw: float, nodes: int, step: float) -> NDArray:
    """Return (N+2,) coefficients of yaw: a turn that decays after the start."""
    if not start:
        return np.full(nodes + 2, yaw)
    faded = _G.yaw_blend * (1.0 - np.exp(-(np.arange(nodes + 2) - 0.5) / _G.yaw_blend))
    spline = start.yaw + start.dyaw * step * faded
    spline[:2] = end_coefficients(start.yaw, start.dyaw * step)
    return np.asarray(spline)


def lowered(coefficients: NDArray, fraction: float, held: bool, rate: float) -> NDArray:
    """Return the coefficients with h lowered by this fraction, less so next to a start `held` by a boundary state.

    `rate` is the number of intervals passed per second where x is 1.
    """
    result, less = coefficients.copy(), np.full(len(coefficients), float(fraction))
    if held:
        to = max(_G.lowered_to, int(_G.lowered_time * rate * np.sqrt(max(coefficients[1, 0], 0.0))))
        count = min(len(less), to)
        less[:count] *= np.clip((np.arange(count) - _G.lowered_from + 1) / (to - _G.lowered_from + 1), 0.0, 1.0)
    result[:, 0] *= 1.0 - less
    return result


def guess_spline(path: Path, airframe: Airframe, limits: PlanLimits, nodes: int) -> NDArray:
    """Return (N+3,) coefficients of a cubic B-spline on the grid: h under the assumption that it changes slowly.

    With h' = 0 each limit alone gives a bound on h: |v|² = h|γ'|², |a| = h|γ''|, and with the thrust axis about
    vertical |ω| = h^1.5 |γ'''|/g and |α| = h²|γ''''|/g.
    """
    s = np.clip(np.arange(-1, nodes + 2) * (path.end / nodes), 0.0, path.end)
    first, second, third, fourth = np.maximum(np.linalg.norm(path.derivatives(s)[1:], axis=1), 1e-9)
    up, _ = spare_thrust(airframe, limits)
    acceleration = min(limits.acceleration, GRAVITY * np.tan(min(limits.tilt, 1.0)), 4 * up / airframe.mass)
    turning = 0.5 * spare_turning(airframe, limits)
    h = np.minimum.reduce([
        np.full(len(s), _G.highest * limits.speed**2),
        _G.usage * limits.speed**2 / first**2,
        _G.usage * acceleration / second,
        (0.7 * _G.usage * limits.angular_velocity * GRAVITY / third) ** (2 / 3),
        (0.7 * _G.usage * turning * GRAVITY / fourth) ** 0.5,
    ])  # fmt: skip
    return np.exp(_smoothed_below(np.log(h), _WEIGHTS))


@njit
def _smoothed_below(values: NDArray, weights: NDArray) -> NDArray:
    """Return the weighted mean of the minimum over neighbours; beyond the ends, the first and last value continue.

    Equal to scipy.ndimage's result to the last bit; that is slow to import.
    """
    last, near, reach = len(values) - 1, int(_G.smoothing), len(weights) // 2
    least = np.empty(len(values))
    for n in range(len(values)):
        least[n] = values[max(n - near, 0)]
        for k in range(n - near + 1, n + near + 1):
            least[n] = min(least[n], values[min(max(k, 0), last)])
    smooth = np.empty(len(values))
    for n in range(len(values)):
        total = least[n] * weights[reach]
        for k in range(reach, 0, -1):
            total += (least[max(n - k, 0)] + least[min(n + k, last)]) * weights[reach - k]
        smooth[n] = total
    return smooth
