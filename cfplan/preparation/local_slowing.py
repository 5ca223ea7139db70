"""Local slowing: lower the speed along a path around setpoints that fail an assessment, until none does.

An assessment judges every setpoint (link loss, a gap in the setpoints). Around a setpoint at fault the speed is capped
at a fraction that depends on its excess, and the profile is refined under these caps from its previous state, so the
rest of the flight stays as fast as it can be.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.deadline import NEVER, Deadline
from cfplan.errors import InfeasibleError
from cfplan.numbers import coordinates
from cfplan.planning.plan_result import Plan
from cfplan.planning.repair import under_caps
from cfplan.safety.space import inside
from cfplan.safety.speed_caps import SpeedCaps, allowed_speed
from cfplan.simulation.link_loss import LinkLossMoments
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.trajectory import Trajectory

ROUNDS = 12  # at most, of lowering caps
TRIALS, CHEAP = 4, 0.005  # attempts to regain time, if a plan loses more than this fraction of it
PLACES = 4  # of caps per interval
LEAST_SHARE, MOST_SHARE = 0.5, 0.98  # fractions of its speed to which a place is slowed in one round
POWER = 1.5  # of speed, with which the remaining distance grows: part of it is v t, part v² / a
ABOUT = (0.1, 0.1)  # s of flight before and after a setpoint at fault, slowed in the first round; later ones slow more
LEAST_SPEED = 0.05  # m/s, of caps
LEADING_UP = 0.4  # s around a setpoint that affect its end: if all caps there are at the minimum, nothing helps


@dataclass(frozen=True, slots=True)
class SimulatedLinkLoss:
    """Link loss at every setpoint of a flight, to be reused for the same bytes."""

    payloads: NDArray  # (N, 29) uint8, at RATE
    moments: LinkLossMoments


@dataclass(frozen=True, slots=True)
class Assessment:
    """How a flight ends at each setpoint, if that is the last one or followed by a gap."""

    what: str  # its name, "link loss"
    time: NDArray  # (N,) s of the trajectory at each setpoint
    excess: NDArray  # (N,) how far it ends beyond the allowed bound; at most 0 if it passes
    reach: NDArray  # (N,) in the same unit, positive: the part that shrinks with speed
    describe: Callable[[int], str]  # of a setpoint at fault: "ends 0.12 m beyond the wall x = 2.25 m"
    near: Callable[[int], str]  # of a setpoint at fault: "the wall x = 2.25 m"
    hint: str  # remedy if slowing does not help
    simulated: SimulatedLinkLoss | None = None  # the simulation behind an assessment of link loss
    about: tuple[float, float] = ABOUT  # s of flight before and after a setpoint at fault, whose speed matters to it

    @property
    def worst(self) -> int:
        """Return the number of the worst setpoint; NaN is worst."""
        return int(np.argmax(np.where(np.isnan(self.excess), np.inf, self.excess)))

    @property
    def at_fault(self) -> NDArray:
        """Return (N,) whether each setpoint ends beyond the allowed bound."""
        return ~np.asarray(inside(self.excess))

    @property
    def passed(self) -> bool:
        """Return whether every setpoint ends well."""
        return not self.at_fault.any()


Assess = Callable[[Trajectory], Sequence[Assessment]]


def slow_locally(plan: Plan, assess: Assess, deadline: Deadline = NEVER) -> tuple[Plan, Sequence[Assessment]]:
    """Return the plan if all its setpoints pass, else one that is slower where they do not; and its assessments.

    After the deadline plans are lowered to the caps without refining, and no time is regained.

    Raises:
        InfeasibleError: a setpoint fails at any speed; the message has place, excess and remedy.
    """
    assessed = assess(plan.trajectory)
    if _passed(assessed):
        return plan, assessed
    slowed, reasons = plan, dict.fromkeys(plan.slowing.reasons if plan.slowing else ())
    places = _places(plan.profile)
    slower = plan.slowing.caps if plan.slowing else None
    caps = SpeedCaps.of(places, np.broadcast_to(allowed_speed(plan.limits.plan.speed, slower, places), places.shape))
    for done in range(ROUNDS):
        for each in assessed:
            reasons |= {f"{each.what} near {each.near(at)}": None for at in _worst_of_arcs(each)}
        lower = [one for each in assessed if (one := _lowered(slowed.trajectory, each, caps, done)) is not None]
        if len(lower) < len(assessed):
            break
        lowest = np.min([each.speed for each in lower], axis=0)
        caps = SpeedCaps.of(places, lowest)
        slowed = under_caps(plan, slowed, caps, tuple(reasons), deadline)
        assessed = assess(slowed.trajectory)
        if _passed(assessed):
            return _faster(plan, assess, (slowed, assessed), caps, deadline)
    worst = max((each for each in assessed if not each.passed), key=lambda each: each.excess[each.worst])
    at = worst.worst
    raise InfeasibleError(
        f"{worst.what} at {worst.time[at]:.2f} s {worst.describe(at)}, however slowly the vehicle flies there",
        where=f"{coordinates(slowed.trajectory.at(worst.time[at]).position, '.2f')} m",
        hint=worst.hint,
    )


def _faster(
    plan: Plan, assess: Assess, passed: tuple[Plan, Sequence[Assessment]], caps: SpeedCaps, deadline: Deadline
) -> tuple[Plan, Sequence[Assessment]]:
    """Return a faster plan that passes too.

    At every place the cap is sought by halving, between one that passes and one that is too high near a setpoint that
    fails.
    """
    places = np.array(caps.s)
    highest = np.maximum(np.minimum(_speed_at(plan.trajectory, places), plan.limits.plan.speed), caps.speed)
    for _ in range(TRIALS):
        slowed = passed[0]
        if slowed.slowing is None or slowed.time_lost <= CHEAP or (highest <= caps.speed).all() or deadline.passed:
            break
        between = np.sqrt(np.array(caps.speed) * highest)
        trial = SpeedCaps.of(places, between)
        # Refining from the slow plan would gain nothing.
        faster = under_caps(plan, plan, trial, slowed.slowing.reasons, deadline)
        assessed = assess(faster.trajectory)
        if not _passed(assessed):
            for each in assessed:
                ahead, after = (max(LEADING_UP, about) for about in each.about)
                for first, last in zip(*_about(faster.trajectory, each, places, (ahead, after)), strict=True):
                    highest[first : last + 1] = between[first : last + 1]
        elif faster.trajectory.duration < slowed.trajectory.duration:
            passed, caps = (faster, assessed), trial
        else:
            break
    return passed


def _passed(assessed: Sequence[Assessment]) -> bool:
    return all(each.passed for each in assessed)


def _worst_of_arcs(assessment: Assessment) -> list[int]:
    """Return the worst setpoint of each run of setpoints at fault, the worst run first."""
    at_fault = np.flatnonzero(assessment.at_fault)
    runs = np.split(at_fault, np.flatnonzero(np.diff(at_fault) > 1) + 1)
    worst = [int(run[np.argmax(assessment.excess[run])]) for run in runs if len(run)]
    return sorted(worst, key=lambda at: -assessment.excess[at])


def _lowered(trajectory: Trajectory, assessment: Assessment, caps: SpeedCaps, done: int) -> SpeedCaps | None:
    """Return lower caps after `done` rounds that did not suffice; None if they are at the minimum already."""
    s = np.array(caps.s)
    speed, before = _speed_at(trajectory, s), np.array(caps.speed)
    at_fault = np.flatnonzero(assessment.at_fault)
    excess, reach = np.nan_to_num(assessment.excess[at_fault], nan=np.inf), assessment.reach[at_fault]
    share = np.minimum(np.maximum(1.0 - excess / reach, 0.0) ** (1.0 / POWER), MOST_SHARE) ** (1 + 0.5 * done)
    ahead, after = assessment.about
    first, last = _about(trajectory, assessment, s, ((1 + 0.5 * done) * ahead, (1 + 0.5 * done) * after))
    factor = np.ones(len(s))
    for begin, end, one in zip(first, last, np.maximum(share, LEAST_SHARE), strict=True):
        factor[begin : end + 1] = np.minimum(factor[begin : end + 1], one)
    lower = np.where(factor < 1.0, np.maximum(factor * speed, LEAST_SPEED), np.inf)
    leading_up = _about(trajectory, assessment, s, (LEADING_UP, LEADING_UP))
    if any((before[begin : end + 1] <= LEAST_SPEED).all() for begin, end in zip(*leading_up, strict=True)):
        return None
    return SpeedCaps.of(s, np.minimum(before, lower))


def _about(
    trajectory: Trajectory, assessment: Assessment, s: NDArray, about: tuple[float, float]
) -> tuple[NDArray, NDArray]:
    """Return the first and last of the places s, (K,), within `about`, s, before and after each setpoint at fault."""
    time = assessment.time[assessment.at_fault]
    first = np.searchsorted(s, trajectory.s_at(time - about[0]), side="right") - 1
    return first, np.minimum(np.searchsorted(s, trajectory.s_at(time + about[1])), len(s) - 1)


def _places(profile: SpeedProfile) -> NDArray:
    """Return (K,) s, PLACES in each interval of the profile, and its end."""
    between = np.arange(PLACES) / PLACES
    return np.append((profile.s[:-1, None] + np.diff(profile.s)[:, None] * between).reshape(-1), profile.s[-1])


def _speed_at(trajectory: Trajectory, s: NDArray) -> NDArray:
    """Return (K,) m/s."""
    return np.asarray(np.sqrt(trajectory.profile.at(s).h) * np.linalg.norm(trajectory.path(s, 1), axis=1))
