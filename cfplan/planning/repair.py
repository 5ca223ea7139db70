"""Repair: turn any profile into a certified trajectory, by the least change.

A profile that passes stays as it is. One that does not is refined: the expert's problem, searched from there, which
lowers the speed where a limit is exceeded and raises it beside, with yaw and grid left alone. What cannot be refined
is slowed as a whole, which always ends certified.
"""

from dataclasses import dataclass

import numpy as np

from cfplan.planners.expert.intersample import violates_at_nodes
from cfplan.planners.expert.refine import refinements
from cfplan.planners.task import PlanningTask
from cfplan.safety.certificate import Certificate, certify
from cfplan.safety.slowing import slow_until_certified
from cfplan.safety.space import Space
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.timing import duration_of
from cfplan.vehicle.trajectory import Trajectory

NOTICEABLE = 0.01  # relative change of speed at a place, from which it is reported


@dataclass(frozen=True, slots=True)
class Repaired:
    """A certified trajectory, and how repair changed the profile."""

    trajectory: Trajectory
    certificate: Certificate
    speed_factor: float  # on the whole; 1: not slowed
    before: float  # s of flight before repair
    slower: float = 0.0  # share of the path along which refining slowed it by more than NOTICEABLE
    most: float = 0.0  # the largest of these changes, relative to the speed
    where: float = 0.0  # s, of that largest change
    failed: str = ""  # why refining failed, if it did
    joints: tuple[float, ...] | None = None  # s, where the windows of refining meet; None: not refined

    def describe(self) -> str:
        """Return one sentence, empty if nothing was changed."""
        duration = self.trajectory.duration
        cost = f"{self.before:.3f} s became {duration:.3f} s ({duration / self.before - 1:+.2%})"
        if self.speed_factor < 1.0:
            why = f" ({self.failed})" if self.failed else ""
            return f"slowed to {self.speed_factor:.2%} of its speed to pass{why}; {cost}"
        if self.slower:
            most = f"most at s = {self.where:.2f}, by {self.most:.1%}"
            return f"refined; slower along {self.slower:.0%} of it, {most}; {cost}"
        return f"refined; {cost}" if duration != self.before else ""


def repair(task: PlanningTask, profile: SpeedProfile, space: Space | None = None) -> Repaired:
    """Return the certified trajectory nearest to the profile. Boundary states are kept by refining, not by slowing.

    Raises:
        InfeasibleError: hovering, or the path itself, breaks a limit; says which.
        NotCertifiedError: the profile is not finite, not smooth, or h is not positive.
    """
    path, airframe, limits, caps = task.path, task.airframe, task.limits, task.speed_caps
    before = duration_of(profile)
    if not violates_at_nodes(path, profile, airframe, limits, caps):
        trajectory = Trajectory(path, profile, airframe)
        certificate = certify(trajectory, limits, space, caps)
        if certificate.passed:
            return Repaired(trajectory, certificate, 1.0, trajectory.duration)
    for solution in refinements(task, profile):
        if solution.profile is None:
            return slow(task, profile, space, failed=solution.reason)
        refined, joints = solution.profile, solution.joints
        trajectory = Trajectory(path, refined, airframe)
        certificate = certify(trajectory, limits, space, caps)
        if certificate.passed:
            break
    slowed = slow_until_certified(trajectory, limits, space, certificate, caps)
    return Repaired(
        slowed.trajectory, slowed.certificate, slowed.speed_factor, before, *_where_slower(profile, refined),
        joints=joints,
    )  # fmt: skip


def slow(task: PlanningTask, profile: SpeedProfile, space: Space | None = None, *, failed: str = "") -> Repaired:
    """Slow the profile as a whole until it passes; one that does stays as it is. Raises as repair()."""
    trajectory = Trajectory(task.path, profile, task.airframe)
    slowed = slow_until_certified(trajectory, task.limits, space, caps=task.speed_caps)
    return Repaired(slowed.trajectory, slowed.certificate, slowed.speed_factor, trajectory.duration, failed=failed)


def _where_slower(before: SpeedProfile, after: SpeedProfile) -> tuple[float, float, float]:
    change = 1.0 - np.sqrt(after.h / before.h)
    worst = int(np.argmax(change))
    if change[worst] <= NOTICEABLE:
        return 0.0, 0.0, 0.0
    return np.count_nonzero(change > NOTICEABLE) / len(change), float(change[worst]), float(before.s[worst])
