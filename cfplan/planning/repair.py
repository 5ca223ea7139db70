"""Repair: turn any profile into a certified trajectory, by the least change.

A profile that passes is unchanged. Otherwise it is refined: the expert's problem is solved from there, which lowers the
speed where a limit is exceeded and raises it nearby, with the same yaw and grid. If refining fails, the profile is
lowered where it exceeds a limit, and refined again; if that fails too, it is slowed as a whole, which always passes.
"""

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.deadline import NEVER, Deadline
from cfplan.errors import CfplanError, InfeasibleError, NotCertifiedError
from cfplan.machine_code import njit
from cfplan.numbers import shown
from cfplan.planners.expert.expert import refinements
from cfplan.planners.expert.intersample import violates_at_nodes
from cfplan.planners.task import PlanningTask
from cfplan.planning.lowering import lower_locally
from cfplan.planning.plan_result import LocalSlowing, Plan
from cfplan.safety.certificate import Certificate, certify
from cfplan.safety.slowing import Slowed, slow_until_certified
from cfplan.safety.space import Space
from cfplan.safety.speed_caps import SpeedCaps
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.timing import duration_of
from cfplan.vehicle.trajectory import Trajectory

SLOWING_TOLERANCE = 0.02  # usage above 1, up to which slowing as a whole suffices
NOTICEABLE = 0.01  # relative change of speed, from which it is reported


@dataclass(frozen=True, slots=True)
class Repaired:
    """A certified trajectory, and how repair changed the profile."""

    trajectory: Trajectory
    certificate: Certificate
    speed_factor: float  # of the whole profile; 1: not slowed
    before: float  # s of flight before repair
    slower: float = 0.0  # fraction of the path slowed by more than NOTICEABLE in refining
    most: float = 0.0  # the largest of these changes, relative to the speed
    where: float = 0.0  # s, of that largest change
    failed: str = ""  # why refining failed, if it did
    joints: tuple[float, ...] | None = None  # s, where the windows of refining meet; None: not refined

    def describe(self) -> str:
        """Return one sentence, empty if nothing was changed."""
        duration = self.trajectory.duration
        cost = f"{self.before:.3f} s became {duration:.3f} s ({shown(duration / self.before - 1, '+.2%')})"
        why = f" ({self.failed})" if self.failed else ""
        if self.speed_factor < 1.0:
            return f"slowed to {self.speed_factor:.2%} of its speed to pass{why}; {cost}"
        how = f"lowered{why}" if self.failed else "refined"
        if self.slower:
            most = f"most at s = {self.where:.2f}, by {self.most:.1%}"
            return f"{how}; slower along {self.slower:.0%} of it, {most}; {cost}"
        return f"{how}; {cost}" if duration != self.before else ""


def repair(task: PlanningTask, profile: SpeedProfile, space: Space | None = None) -> Repaired:
    """Return the certified trajectory nearest to the profile. Boundary states are kept, but by slowing as a whole.

    What is not refined by the task's deadline is lowered only, which takes little longer.

    Raises:
        InfeasibleError: hovering, or the path itself, breaks a limit; says which.
        NotCertifiedError: the profile is not finite, not smooth, or h is not positive.
    """
    path, airframe, limits, caps = task.path, task.airframe, task.limits, task.speed_caps
    if not violates_at_nodes(path, profile, airframe, limits, caps):
        trajectory = Trajectory(path, profile, airframe)
        certificate = certify(trajectory, limits, space, caps)
        if certificate.passed:
            return Repaired(trajectory, certificate, 1.0, trajectory.duration)
    return refine(task, profile, space)


def refine(task: PlanningTask, profile: SpeedProfile, space: Space | None = None) -> Repaired:
    """Return the certified trajectory to which refining leads, to the optimum near the profile.

    Raises as repair(), and InfeasibleError where a dispensable task is not refined by its deadline.
    """
    limits, caps, before = task.limits, task.speed_caps, duration_of(profile)
    refined = _refined(task, profile, space)
    if refined.certificate and (refined.certificate.passed or _within_slowing_tolerance(refined.certificate)):
        slowed = slow_until_certified(refined.trajectory, limits, space, refined.certificate, caps, task.deadline)
        return _repaired(slowed, before, profile, refined)
    if task.dispensable and task.deadline.passed:
        raise InfeasibleError(refined.failed or "out of time", hint="give planning more time (--budget)")
    return _lowered(task, profile, space, refined, before)


class _Refined(NamedTuple):
    """What refining led to: the trajectory itself where it failed."""

    trajectory: Trajectory
    certificate: Certificate | None  # None where refining failed
    failed: str = ""  # why, or from where on it was not refined
    joints: tuple[float, ...] | None = None


def _refined(task: PlanningTask, profile: SpeedProfile, space: Space | None) -> _Refined:
    """Refine the profile until its certificate passes, or refining ends."""
    for solution in refinements(task, profile):
        if solution.profile is None:
            return _Refined(Trajectory(task.path, profile, task.airframe), None, solution.reason)
        trajectory = Trajectory(task.path, solution.profile, task.airframe)
        certificate = certify(trajectory, task.limits, space, task.speed_caps)
        if certificate.passed:
            break
    return _Refined(trajectory, certificate, solution.reason, solution.joints)


def _within_slowing_tolerance(certificate: Certificate) -> bool:
    """Return whether slowing as a whole costs so little that nothing else need be tried."""
    return certificate.worst.share < 1.0 + SLOWING_TOLERANCE


def _lowered(
    task: PlanningTask, profile: SpeedProfile, space: Space | None, refined: _Refined, before: float
) -> Repaired:
    """Return the fastest of what was refined, as far as it went, the same lowered, and that refined again."""
    ways = [refined]
    with suppress(NotCertifiedError):  # what passes nowhere near the profile need not be tried
        low = lower_locally(task, refined.trajectory.profile)
        ways.append(_Refined(Trajectory(task.path, low, task.airframe), None, refined.failed))
        if not task.deadline.passed:
            ways.insert(0, _refined(task, low, space))
    best: Repaired | None = None
    error: CfplanError | None = None
    for way in ways:
        try:
            slowed = slow_until_certified(
                way.trajectory, task.limits, space, way.certificate, task.speed_caps, task.deadline
            )
        except (InfeasibleError, NotCertifiedError) as failure:
            error = error or failure
            continue
        if best is None or slowed.trajectory.duration < best.trajectory.duration:
            best = _repaired(slowed, before, profile, way)
        if way.certificate and way.certificate.passed and not way.failed:
            break  # near the optimum
    if best is None:
        assert error
        raise error
    return best


def _repaired(slowed: Slowed, before: float, profile: SpeedProfile, way: _Refined) -> Repaired:
    return Repaired(
        slowed.trajectory, slowed.certificate, slowed.speed_factor, before,
        *_where_slower(profile, way.trajectory.profile), failed=way.failed, joints=way.joints,
    )  # fmt: skip


def slow(task: PlanningTask, profile: SpeedProfile, space: Space | None = None, *, failed: str = "") -> Repaired:
    """Slow the profile as a whole until it passes; one that does stays as it is. Raises as repair()."""
    trajectory = Trajectory(task.path, profile, task.airframe)
    slowed = slow_until_certified(trajectory, task.limits, space, caps=task.speed_caps, deadline=task.deadline)
    return Repaired(slowed.trajectory, slowed.certificate, slowed.speed_factor, trajectory.duration, failed=failed)


def repair_plan(plan: Plan, profile: SpeedProfile, caps: SpeedCaps | None = None, deadline: Deadline = NEVER) -> Plan:
    """Return the plan along its path under its limits and these caps, by the profile nearest to `profile` that passes.

    Its speed factor is kept. Raises as repair().
    """
    factor, limits = plan.speed_factor, plan.limits
    task = PlanningTask(
        plan.path, plan.airframe, limits.plan, nodes=len(profile.s) - 1,
        speed_caps=caps if caps is None else caps.scaled(1.0 / factor), deadline=deadline,
    )  # fmt: skip
    repaired = flown = repair(task, profile.slowed(1.0 / factor), limits.space)
    if factor < 1.0:
        flown = slow(replace(task, speed_caps=caps), repaired.trajectory.profile.slowed(factor), limits.space)
    return replace(
        plan,
        trajectory=flown.trajectory,
        certificate=flown.certificate,
        repair_speed_factor=plan.repair_speed_factor * repaired.speed_factor,
        joints=plan.joints if repaired.joints is None else repaired.joints,
    )


def under_caps(
    plan: Plan, nearest: Plan, caps: SpeedCaps, reasons: tuple[str, ...], deadline: Deadline = NEVER
) -> Plan:
    """Return the plan under these caps, refined from the nearest one. `reasons` are those of LocalSlowing.

    Raises as repair().
    """
    before = plan.slowing.before if plan.slowing else plan.trajectory.duration
    repaired = repair_plan(plan, nearest.profile, caps, deadline)
    return replace(repaired, slowing=LocalSlowing(caps, before, reasons))


def _where_slower(before: SpeedProfile, after: SpeedProfile) -> tuple[float, float, float]:
    share, most, where = _changed(before.h, after.h)
    return (share, most, float(before.s[where])) if most > NOTICEABLE else (0.0, 0.0, 0.0)


@njit
def _changed(before: NDArray, after: NDArray) -> tuple[float, float, int]:
    """Return the share of places at which speed falls by more than NOTICEABLE, by how much at most, and where that."""
    many, most, where = 0, -np.inf, 0
    for n in range(len(before)):
        change = 1.0 - np.sqrt(after[n] / before[n])
        many += change > NOTICEABLE
        if change > most:
            most, where = change, n
    return many / len(before), most, where
