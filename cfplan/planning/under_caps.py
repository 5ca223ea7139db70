"""Plan again along the same path under speed caps."""

from dataclasses import replace

from cfplan.deadline import NEVER, Deadline
from cfplan.planners.task import PlanningTask
from cfplan.planning.plan_result import LocalSlowing, Plan
from cfplan.planning.repair import repair, slow
from cfplan.safety.speed_caps import SpeedCaps


def under_caps(
    plan: Plan, nearest: Plan, caps: SpeedCaps, reasons: tuple[str, ...], deadline: Deadline = NEVER
) -> Plan:
    """Return the plan under these caps, refined from the nearest one; its speed factor is kept.

    `reasons` are those of LocalSlowing. Raises as repair().
    """
    before = plan.slowing.before if plan.slowing else plan.trajectory.duration
    factor, limits, profile = plan.speed_factor, plan.limits, nearest.profile.slowed(1.0 / plan.speed_factor)
    task = PlanningTask(
        plan.path, plan.airframe, limits.plan, nodes=len(profile.s) - 1, speed_caps=caps.scaled(1.0 / factor),
        deadline=deadline,
    )  # fmt: skip
    repaired = flown = repair(task, profile, limits.space)
    if factor < 1.0:
        as_flown = replace(task, speed_caps=caps)
        flown = slow(as_flown, repaired.trajectory.profile.slowed(factor), limits.space)
    return replace(
        plan,
        trajectory=flown.trajectory,
        certificate=flown.certificate,
        repair_speed_factor=plan.repair_speed_factor * repaired.speed_factor,
        joints=plan.joints if repaired.joints is None else repaired.joints,
        slowing=LocalSlowing(caps, before, reasons),
    )
