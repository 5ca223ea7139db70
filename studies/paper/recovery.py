"""Trajectory recovery: from h and cos ψ at the nodes to a speed profile, as in the paper's appendix.

The sign of ψ, which the cosine loses, is chosen so that yaw continues its turn. The paper differentiates h by finite
differences; here both become the splines of a speed profile, so that flatness gives attitude, rates and thrusts.
"""

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import NotCertifiedError
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.profile_spline import profile_through
from cfplan.vehicle.timing import duration_of

LEAST_H = 1e-2  # lower bound of answers: less is no motion
H_STIFFNESSES = (1e-2, 1e-1, 1.0, 10.0, 100.0)  # tried in order until the spline stays positive
YAW_STIFFNESS = 1.0


def recover_profile(answers: NDArray, end: float) -> SpeedProfile:
    """Return the speed profile through h and cos ψ, (N, 2), at nodes from 0 to `end`.

    Raises NotCertifiedError if an answer is not finite, or no spline through h stays positive.
    """
    if not np.isfinite(answers).all():
        raise NotCertifiedError("not a number", where="the network's answer", hint="train it anew")
    h, yaw = np.maximum(answers[:, 0].astype(float), LEAST_H), yaw_of_cosines(answers[:, 1])
    grid = np.linspace(0.0, end, len(h))
    for stiffness in H_STIFFNESSES:
        profile = profile_through(grid, grid, h, yaw, h_stiffness=stiffness, yaw_stiffness=YAW_STIFFNESS)
        try:
            duration_of(profile)
        except NotCertifiedError:
            continue
        return profile
    raise NotCertifiedError("h falls to zero between nodes", where="the network's answer", hint="plan by the expert")


def yaw_of_cosines(cosines: NDArray) -> NDArray:
    """Return yaw, (N,) rad, from cos ψ: first in [0, π], then the solution nearest to the linear extrapolation."""
    sizes = np.arccos(np.clip(cosines.astype(float), -1.0, 1.0))
    yaw = sizes.copy()
    for n in range(1, len(yaw)):
        ahead = 2.0 * yaw[n - 1] - yaw[n - 2] if n > 1 else yaw[0]
        ways = np.array([sizes[n], -sizes[n]])
        ways += 2.0 * np.pi * np.round((ahead - ways) / (2.0 * np.pi))
        yaw[n] = ways[np.argmin(np.abs(ways - ahead))]
    return yaw


def nodal_time(answers: NDArray, end: NDArray) -> NDArray:
    """Return the travel time of answers, (R, N, 2), as the paper sums it: Σ 2Δs/(√hᵢ + √hᵢ₊₁), (R,) s."""
    rates = np.sqrt(np.maximum(answers[..., 0], LEAST_H))
    steps = np.asarray(end) / (answers.shape[-2] - 1)
    return np.asarray(2.0 * steps * np.sum(1.0 / (rates[..., :-1] + rates[..., 1:]), axis=-1))
