"""Plan: the result of planning, importable without any planner."""

from dataclasses import dataclass

from cfplan.geometry.path import Path
from cfplan.safety.certificate import Certificate
from cfplan.safety.limits import Limits
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.trajectory import Trajectory


@dataclass(frozen=True, slots=True)
class Plan:
    """A certified trajectory and how it came about."""

    path: Path
    airframe: Airframe
    limits: Limits
    trajectory: Trajectory
    certificate: Certificate
    planner: str  # whose profile it is
    nodes: int  # intervals of the profile
    repair_speed_factor: float  # on the planner's speed, at which the plan passes; 1: not slowed
    speed_factor: float  # on that speed, as asked for; 1: not slowed
    seconds: float  # s that planning took, all tries and certificates included
    notes: tuple[str, ...]  # what a reader should know, one sentence each
    lower_bound: float | None = None
    """s, below which no flight keeps the limits of speed, acceleration and collective thrust; None: not computed"""
    joints: tuple[float, ...] = ()  # s, where the windows of a long profile meet

    @property
    def profile(self) -> SpeedProfile:
        """Return the profile as flown, slowing included."""
        return self.trajectory.profile
