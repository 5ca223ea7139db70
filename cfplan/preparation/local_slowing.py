"""Local slowing: the speed is lowered along a path where a setpoint would end badly, until no setpoint does.

What ends badly is for an assessment of every setpoint to say (link loss, a gap in the setpoints). Where one is at
fault, the speed about it is capped at a share of what it was, as far as its excess asks, and the profile is refined
under these caps from where it was; so the rest of the flight stays as fast as it can be.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InfeasibleError
from cfplan.planners.task import PlanningTask
from cfplan.planning.plan_result import LocalSlowing, Plan
from cfplan.planning.repair import repair, slow
from cfplan.safety.speed_caps import SpeedCaps
from cfplan.vehicle.trajectory import Trajectory

ROUNDS = 10  # of lowering caps, at most
HALVINGS, CHEAP = 2, 0.005  # tries to win time back, where a plan loses more than this share of it
LEAST_SHARE = 0.5  # of its speed, to which a place is slowed in one round
POWER = 1.5  # of speed, with which the way that is left grows: some of it is v t, some v² / a
BEFORE, AFTER = 0.02, 0.08  # s of flight about a setpoint, along which the speed decides how it ends
LEAST_SPEED = 0.05  # m/s; where all about a setpoint is slower than this, slowness does not help


@dataclass(frozen=True, slots=True)
class Assessment:
    """How each setpoint of a flight ends, were it the last one or followed by a gap."""

    what: str  # as it is called, "link loss"
    time: NDArray  # (N,) s of the trajectory at each setpoint
    excess: NDArray  # (N,) by how much it ends beyond what is allowed; at most 0 where all is well
    reach: NDArray  # (N,) in the same unit, positive: what falls with speed, and of which the excess is too much
    describe: Callable[[int], str]  # of a setpoint at fault: "ends 0.12 m beyond the wall x = 2.25 m"
    near: Callable[[int], str]  # of a setpoint at fault: "the wall x = 2.25 m"
    hint: str  # what to do where slowing does not help

    @property
    def worst(self) -> int:
        """Return the number of the setpoint that ends worst; what is not a number is worst of all."""
        return int(np.argmax(np.where(np.isnan(self.excess), np.inf, self.excess)))

    @property
    def passed(self) -> bool:
        """Return whether every setpoint ends well."""
        return bool(np.all(self.excess <= 0.0))


Assess = Callable[[Trajectory], Sequence[Assessment]]


def slow_locally(plan: Plan, assess: Assess) -> tuple[Plan, Sequence[Assessment]]:
    """Return the plan itself if all its setpoints end well, else one that is slower where they do not; and how it ends.

    Raises:
        InfeasibleError: a setpoint ends badly however slow the flight is there; says where, by how much, what helps.
    """
    assessed = assess(plan.trajectory)
    if _passed(assessed):
        return plan, assessed
    slowed, reasons = plan, dict[str, None]()
    caps = np.full(len(plan.profile.s), plan.limits.plan.speed)  # m/s, at the nodes
    for _ in range(ROUNDS):
        for each in assessed:
            reasons |= {f"{each.what} near {each.near(at)}": None for at in _worst_of_arcs(each)}
        lower = [one for each in assessed if (one := _lowered(slowed.trajectory, each, caps)) is not None]
        if len(lower) < len(assessed):
            break
        lowest = np.min(lower, axis=0)
        failed = np.where(lowest < caps, np.minimum(caps, _speed_at_nodes(slowed.trajectory)), caps)
        caps = lowest
        slowed = _replanned(plan, slowed, caps, tuple(reasons))
        assessed = assess(slowed.trajectory)
        if _passed(assessed):
            return _faster(plan, assess, (slowed, assessed), caps, failed)
    worst = max((each for each in assessed if not each.passed), key=lambda each: each.excess[each.worst])
    at = worst.worst
    x, y, z = slowed.trajectory.at(worst.time[at]).position
    raise InfeasibleError(
        f"{worst.what} at {worst.time[at]:.2f} s {worst.describe(at)}, however slowly the vehicle flies there",
        where=f"({x:.2f}, {y:.2f}, {z:.2f}) m",
        hint=worst.hint,
    )


def _faster(
    plan: Plan, assess: Assess, passed: tuple[Plan, Sequence[Assessment]], caps: NDArray, failed: NDArray
) -> tuple[Plan, Sequence[Assessment]]:
    """Return a plan between the one that passed under these caps and the speeds that failed, where that passes too."""
    for _ in range(HALVINGS):
        slowed = passed[0]
        if slowed.slowing is None or slowed.time_lost <= CHEAP:
            break
        between = np.sqrt(caps * np.maximum(failed, caps))
        trial = _replanned(plan, slowed, between, slowed.slowing.reasons)
        assessed = assess(trial.trajectory)
        if _passed(assessed):
            passed, caps = (trial, assessed), between
        else:
            failed = between
    return passed


def _passed(assessed: Sequence[Assessment]) -> bool:
    return all(each.passed for each in assessed)


def _worst_of_arcs(assessment: Assessment) -> list[int]:
    """Return the worst setpoint of each run of setpoints at fault, the worst run first."""
    at_fault = np.flatnonzero(~(assessment.excess <= 0.0))
    runs = np.split(at_fault, np.flatnonzero(np.diff(at_fault) > 1) + 1)
    worst = [int(run[np.argmax(assessment.excess[run])]) for run in runs if len(run)]
    return sorted(worst, key=lambda at: -assessment.excess[at])


def _lowered(trajectory: Trajectory, assessment: Assessment, caps: NDArray) -> NDArray | None:
    """Return lower caps at the profile's nodes, (N+1,) m/s, that should do; None where they are the least already."""
    profile, speed = trajectory.profile, _speed_at_nodes(trajectory)
    at_fault = np.flatnonzero(~(assessment.excess <= 0.0))
    excess, reach = np.nan_to_num(assessment.excess[at_fault], nan=np.inf), assessment.reach[at_fault]
    share = np.maximum(np.maximum(1.0 - excess / reach, 0.0) ** (1.0 / POWER), LEAST_SHARE)
    time = assessment.time[at_fault]
    first = profile.interval(trajectory.s_at(time - BEFORE))
    last = profile.interval(trajectory.s_at(time + AFTER)) + 1
    lowered = caps.copy()
    for begin, end, factor in zip(first, last, share, strict=True):
        about = slice(begin, end + 1)
        if (caps[about] <= LEAST_SPEED).all():
            return None
        lowered[about] = np.minimum(lowered[about], np.maximum(factor * speed[about], LEAST_SPEED))
    return lowered


def _speed_at_nodes(trajectory: Trajectory) -> NDArray:
    """Return (N+1,) m/s."""
    profile = trajectory.profile
    return np.asarray(np.sqrt(profile.h) * np.linalg.norm(trajectory.path(profile.s, 1), axis=1))


def _replanned(plan: Plan, nearest: Plan, caps_at_nodes: NDArray, reasons: tuple[str, ...]) -> Plan:
    """Return the plan under caps at its nodes, (N+1,) m/s, refined from the nearest one; its speed factor is kept."""
    factor, limits, profile = plan.speed_factor, plan.limits, nearest.profile.slowed(1.0 / plan.speed_factor)
    caps = SpeedCaps.of(profile.s, caps_at_nodes)
    task = PlanningTask(
        plan.path, plan.airframe, limits.plan, nodes=len(profile.s) - 1, speed_caps=caps.scaled(1.0 / factor)
    )
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
        slowing=LocalSlowing(caps, plan.trajectory.duration, reasons),
    )
