"""Uniform slowing: the last resort that always works, because as h → 0 motion tends to hover."""

from collections.abc import Iterable

import numpy as np

from cfplan.errors import NotCertifiedError
from cfplan.geometry.path import Path
from cfplan.safety.certificate import Certificate, certify
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.trajectory import Trajectory

RESOLUTION = 2e-3
# of the share of speed that is sought
LEAST_SHARE = 0.01
PROPORTIONAL = frozenset({"speed", "angular velocity"})
# to speed; every other share grows with its square


def certified_share(path: Path, profile: SpeedProfile, airframe: Airframe, limits: PlanLimits) -> float:
    """The largest share of its speed, at most 1 and within RESOLUTION, at which the whole profile is certified.

    Raises:
        NotCertifiedError: none down to LEAST_SHARE is, or h is not positive everywhere.
    """
    failed, share = np.inf, 1.0
    while (worst := _wanted_share(_certificate(path, profile, airframe, limits, share))) < 1.0:
        failed, share = share, share * min(worst, 0.995)
        if not share >= LEAST_SHARE:
            raise NotCertifiedError(
                f"not certified at {LEAST_SHARE:.0%} of its speed either",
                hint="look for a limit that hovering breaks, or for a cusp in the path",
            )
    while failed - share > RESOLUTION * share and failed <= 1.0:
        middle = 0.5 * (failed + share)
        if _certificate(path, profile, airframe, limits, middle).passed:
            share = middle
        else:
            failed = middle
    return share


def least_slowed(
    path: Path, profiles: Iterable[SpeedProfile], airframe: Airframe, limits: PlanLimits
) -> SpeedProfile | None:
    """Of several profiles the fastest once slowed as far as its certificate asks; None if none can be flown."""
    best, least = None, np.inf
    for profile in profiles:
        try:
            certificate = _certificate(path, profile, airframe, limits, 1.0)
        except NotCertifiedError:  # h falls to zero somewhere
            continue
        share = _wanted_share(certificate)
        if share > 0.0 and certificate.duration / share < least:
            best, least = profile, certificate.duration / share
    return best


def _certificate(
    path: Path, profile: SpeedProfile, airframe: Airframe, limits: PlanLimits, share: float
) -> Certificate:
    return certify(Trajectory(path, profile.slowed(share), airframe), limits)


def _wanted_share(certificate: Certificate) -> float:
    """The share of its speed at which every limit would hold if each grew as a power of speed; 1 where all hold."""
    shares = [
        margin.share if margin.name in PROPORTIONAL else margin.share**0.5
        for margin in certificate.margins
        if not margin.passed
    ]
    if any(np.isnan(share) for share in shares):
        return 0.0
    return 1.0 / max(shares, default=1.0)
