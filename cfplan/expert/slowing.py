"""Uniform slowing: the last resort that always works, because as h → 0 motion tends to hover."""

import numpy as np

from cfplan.errors import NotCertifiedError
from cfplan.geometry.path import Path
from cfplan.safety.certificate import certify
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.trajectory import Trajectory

RESOLUTION = 2e-3
# of the share of speed that is sought
LEAST_SHARE = 0.02


def certified_share(path: Path, profile: SpeedProfile, airframe: Airframe, limits: PlanLimits) -> float:
    """The largest share of its speed, at most 1 and within RESOLUTION, at which the whole profile is certified.

    Raises:
        NotCertifiedError: none down to LEAST_SHARE is.
    """
    failed, share = np.inf, 1.0
    while not _passes(path, profile, airframe, limits, share):
        failed, share = share, share * 0.85
        if share < LEAST_SHARE:
            raise NotCertifiedError(
                f"not certified at {LEAST_SHARE:.0%} of its speed either",
                hint="look for a limit that hovering breaks, or for a cusp in the path",
            )
    while failed - share > RESOLUTION * share and failed <= 1.0:
        middle = 0.5 * (failed + share)
        if _passes(path, profile, airframe, limits, middle):
            share = middle
        else:
            failed = middle
    return share


def _passes(path: Path, profile: SpeedProfile, airframe: Airframe, limits: PlanLimits, share: float) -> bool:
    try:
        return certify(Trajectory(path, profile.slowed(share), airframe), limits).passed
    except NotCertifiedError:  # h is not positive or not finite somewhere; no share of it is
        return False
