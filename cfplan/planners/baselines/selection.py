"""Select the profile that is fastest after it is slowed to meet the certificate."""

from collections.abc import Iterable

import numpy as np

from cfplan.errors import NotCertifiedError
from cfplan.planners.task import PlanningTask
from cfplan.safety.certificate import CAPPED_SPEED, Certificate, certify
from cfplan.safety.quantities import QUANTITIES
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.trajectory import Trajectory


def select_fastest(task: PlanningTask, profiles: Iterable[SpeedProfile]) -> SpeedProfile | None:
    """Return the profile that is fastest after slowing until it is certified; None if none can be flown."""
    best, least = None, np.inf
    for profile in profiles:
        try:
            certificate = certify(Trajectory(task.path, profile, task.airframe), task.limits, caps=task.speed_caps)
        except NotCertifiedError:  # h falls to zero somewhere
            continue
        factor = _speed_factor(certificate)
        if factor > 0.0 and certificate.duration / factor < least:
            best, least = profile, certificate.duration / factor
    return best


def _speed_factor(certificate: Certificate) -> float:
    """Return the factor on speed at which every limit would hold if each usage grew as a power of speed."""
    powers = {quantity.name: quantity.power for quantity in QUANTITIES} | {CAPPED_SPEED: 1}
    usages = [margin.share ** (1 / powers[margin.name]) for margin in certificate.margins if not margin.passed]
    if any(np.isnan(usage) for usage in usages):
        return 0.0
    return 1.0 / max(usages, default=1.0)
