"""Lower a profile where it exceeds a limit, until it exceeds none: quick, reliable and not optimal.

Each round computes the factor by which h must fall in every interval for each limit to hold, assuming that motion
scales with a power of speed, and lowers log h by the largest factor nearby, smoothly in time. A lower speed brings new
slopes, so rounds continue; the slopes become gentler with the speed.
"""

import numpy as np
from numpy.typing import NDArray

from cfplan.planners.expert.intersample import DensePath
from cfplan.planners.task import PlanningTask
from cfplan.safety.feasibility import smoothing_half_width
from cfplan.safety.limits import PlanLimits
from cfplan.safety.quantities import QUANTITIES
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.profile_spline import h_coefficients, spline_profile
from cfplan.vehicle.yaw_spline import YawSpline

ROUNDS, LATE_ROUNDS = 40, 12  # at most, and after the deadline; ten are usual
AIM = 0.99  # usage of limits
MOST = 1.0  # largest fall of log h in a round
STEPS = 6  # time steps over which lowering is smoothed
MOST_STEPS = 200_000  # per flight; longer flights have coarser ones
BESIDE = 2  # neighbouring intervals that an excess also lowers
LEAST_H = 1e-12
UPSIDE_DOWN = 3.0  # usage assumed if a measure is NaN


def lower_locally(task: PlanningTask, profile: SpeedProfile) -> SpeedProfile:
    """Return the profile, lower where it exceeds a limit of the task; its yaw, and h at the boundary state, are kept.

    An excess that remains after the last round is left to slowing as a whole. Time and memory grow linearly with the
    intervals; after the task's deadline there are fewer rounds.
    """
    path, nodes, yaw = task.path, len(profile.s) - 1, YawSpline.of(profile)
    dense = DensePath(path, nodes, np.zeros(nodes), task.speed_caps)
    reach = smoothing_half_width(task.airframe, task.limits)
    logs = np.log(np.maximum(h_coefficients(profile), LEAST_H))
    for done in range(ROUNDS):
        lower = -_allowed(dense, profile, task.airframe, task.limits)
        if lower.max() <= 0.0 or (done >= LATE_ROUNDS and task.deadline.passed):
            break
        durations = path.end / nodes / np.exp((logs[1:-2] + logs[2:-1]) / 4.0)
        lower = _about_in_time(np.clip(lower, 0.0, MOST), durations, reach)
        by = np.maximum(np.append(lower, lower[-1]), np.append(lower[0], lower))  # at the nodes
        by = np.concatenate([by[:1], by, by[-1:]])
        if task.start:
            by[3:] *= np.append(np.minimum(np.cumsum(durations) / reach, 1.0)[1:], 1.0)
            by[:3] = 0.0
        logs -= by
        profile = spline_profile(np.exp(logs), path.end, yaw)
    return profile


def _allowed(dense: DensePath, profile: SpeedProfile, airframe: Airframe, limits: PlanLimits) -> NDArray:
    """Return (N,): by how much log h may rise in each interval until a limit is reached; negative where it must fall.

    Usage is assumed to scale with the limit's power of speed.
    """
    measured = dense.measures(profile, airframe, limits)
    least = np.full(measured.shape[1], np.inf)
    for quantity in QUANTITIES:
        limit, unused = quantity.allowed(limits), quantity.unused(airframe)
        share = (quantity.worst(measured) - unused) / (limit - unused)
        share = np.where(np.isnan(share), UPSIDE_DOWN, np.maximum(share, LEAST_H))
        least = np.minimum(least, -2.0 / quantity.power * np.log(share / AIM))
    return dense.least_of_intervals(least)


def _about_in_time(lower: NDArray, durations: NDArray, reach: float) -> NDArray:
    """Return (N,): at least `lower` of each interval also `reach`, s, before and after it, and smooth.

    Intervals take `durations`, (N,) s.
    """
    from scipy.ndimage import gaussian_filter1d, maximum_filter1d  # slow to import

    beside = gaussian_filter1d(maximum_filter1d(lower, 2 * BESIDE + 1, mode="nearest"), BESIDE / 2, mode="nearest")
    ends = np.cumsum(durations)
    middles = ends - durations / 2
    count = int(np.clip(STEPS * ends[-1] / reach, 2, MOST_STEPS))
    times = np.linspace(0.0, ends[-1], count)
    highest = np.interp(times, middles, lower)
    nearest = np.minimum(np.rint(middles / ends[-1] * (count - 1)).astype(int), count - 1)
    np.maximum.at(highest, nearest, lower)
    steps = reach / (times[1] - times[0])
    highest = maximum_filter1d(highest, 2 * int(steps) + 1, mode="nearest")
    return np.maximum(beside, np.interp(middles, times, gaussian_filter1d(highest, steps / 2, mode="nearest")))
