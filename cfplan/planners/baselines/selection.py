"""Which of several profiles a certificate would cost least."""

from collections.abc import Iterable

import numpy as np

from cfplan.errors import NotCertifiedError
from cfplan.planners.task import PlanningTask
from cfplan.safety.certificate import Certificate, certify
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.trajectory import Trajectory

PROPORTIONAL = frozenset({"speed", "angular velocity"})
# to speed; every other share grows with its square


def select_fastest(task: PlanningTask, profiles: Iterable[SpeedProfile]) -> SpeedProfile | None:
    """Return the profile that is fastest once slowed as far as its certificate asks; None if none can be flown."""
    best, least = None, np.inf
    for profile in profiles:
        try:
            certificate = certify(Trajectory(task.path, profile, task.airframe), task.limits)
        except NotCertifiedError:  # h falls to zero somewhere
            continue
        share = _speed_share(certificate)
        if share > 0.0 and certificate.duration / share < least:
            best, least = profile, certificate.duration / share
    return best


def _speed_share(certificate: Certificate) -> float:
    """The share of its speed at which every limit would hold if each grew as a power of speed; 1 where all hold."""
    shares = [
        margin.share if margin.name in PROPORTIONAL else margin.share**0.5
        for margin in certificate.margins
        if not margin.passed
    ]
    if any(np.isnan(share) for share in shares):
        return 0.0
    return 1.0 / max(shares, default=1.0)
