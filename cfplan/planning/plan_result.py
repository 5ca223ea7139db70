"""Plan: the result of planning, importable without any planner."""

import math
from dataclasses import dataclass

from cfplan.errors import InputError
from cfplan.geometry.path import Path
from cfplan.numbers import shown
from cfplan.safety.certificate import Certificate
from cfplan.safety.limits import Limits
from cfplan.safety.speed_caps import SpeedCaps
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.trajectory import Trajectory


@dataclass(frozen=True, slots=True)
class LocalSlowing:
    """Where a plan is slower than its limits allow, and why.

    Raises InputError if the time without caps is invalid or there is no reason.
    """

    caps: SpeedCaps
    before: float  # s of flight without slowing
    reasons: tuple[str, ...]  # "link loss near the wall x = 2.25 m", the first the worst

    def __post_init__(self) -> None:
        if not (math.isfinite(self.before) and self.before > 0.0 and self.reasons):
            raise InputError(
                f"local slowing of {self.before} s of flight for {len(self.reasons)} reasons",
                where="local slowing",
                hint="give the flight's time before, above 0, and at least one reason",
            )


@dataclass(frozen=True, slots=True)
class Plan:
    """A certified trajectory, and how it was found."""

    path: Path
    airframe: Airframe
    limits: Limits
    trajectory: Trajectory
    certificate: Certificate
    planner: str  # that found the profile
    nodes: int  # intervals of the profile
    repair_speed_factor: float  # on the planner's speed, at which the plan passes; 1: not slowed
    speed_factor: float  # requested factor on that speed; 1: not slowed
    seconds: float  # s, planning time, with all attempts and certificates
    notes: tuple[str, ...]  # remarks, one sentence each
    joints: tuple[float, ...] = ()  # s, where the windows of a long profile meet
    slowing: LocalSlowing | None = None  # None: nowhere slower than the limits allow
    left_out: str = ""  # what planning had no time for; empty if the budget sufficed

    @property
    def profile(self) -> SpeedProfile:
        """Return the profile as flown, slowing included."""
        return self.trajectory.profile

    @property
    def time_lost(self) -> float:
        """Return the fraction of time that local slowing costs; 0 if there is none."""
        return self.trajectory.duration / self.slowing.before - 1.0 if self.slowing else 0.0

    def describe_slowing(self) -> str:
        """Return one line, "0.3 % slower for link loss near the wall x = 2.25 m"; empty if there is no slowing."""
        if not self.slowing:
            return ""
        first, *others = self.slowing.reasons
        more = f" and {len(others)} places more" if len(others) > 1 else f" and {others[0]}" if others else ""
        return f"{shown(100 * self.time_lost, '.1f')} % slower for {first}{more}"
