"""From any profile to a certified trajectory."""

from cfplan.geometry.path import Path
from cfplan.safety.limits import PlanLimits
from cfplan.safety.slowing import Slowed, slow_until_certified
from cfplan.safety.space import Space
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.trajectory import Trajectory


def repair(
    path: Path, profile: SpeedProfile, airframe: Airframe, limits: PlanLimits, space: Space | None = None
) -> Slowed:
    """The certified trajectory that is nearest to the profile: itself where it passes, else slowed as a whole.

    Raises:
        InfeasibleError: hovering, or the path itself, breaks a limit; says which.
        NotCertifiedError: the profile is not finite, not smooth, or h is not positive.
    """
    return slow_until_certified(Trajectory(path, profile, airframe), limits, space)
