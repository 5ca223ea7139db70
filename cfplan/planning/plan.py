"""The one entry to planning: from a path and limits to a certified trajectory, and how it came about."""

import time
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cfplan.errors import InfeasibleError, InputError, NotCertifiedError
from cfplan.geometry.path import Path
from cfplan.geometry.yaw import YawMode
from cfplan.learning.model_files import find_model
from cfplan.planners.baselines.convex import lower_bound
from cfplan.planners.solution import Solution
from cfplan.planners.task import PlanningTask
from cfplan.planning.plan_result import Plan
from cfplan.planning.planners import AUTO, find_planner
from cfplan.planning.repair import Repaired, repair, slow
from cfplan.safety.limits import Limits
from cfplan.safety.space import check_space
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.profile import BoundaryState

NODES_PER_METRE = {"learned": 5}
# the network was taught on wide grids, and refining costs by the node
OTHER_NODES_PER_METRE = 10
FEWEST_NODES, MOST_NODES = 60, 3000
MOST_LEARNED_NODES = 30_000
NODES_PER_PIECE = 4
GOOD_SHARE = 0.97  # a plan that had to be slowed further is worth a second try with twice the nodes
LEAST_SPEED_FACTOR = 0.01
LAST_RESORTS = ("convex", "minsnap")
# which hardly ever fail
EXPERT_GAP = 0.1
# over the proven bound: from there on the expert is asked too
REFINED = ("learned", "expert", "convex")
# whose profiles are refined where they do not pass; the others are what they are, slowed


class _Found(NamedTuple):
    """A planner's profile, repaired."""

    repaired: Repaired
    planner: str
    nodes: int
    joints: tuple[float, ...]

    @property
    def duration(self) -> float:
        return self.repaired.trajectory.duration


@dataclass(frozen=True, slots=True)
class _Question:
    """What every planner is asked."""

    path: Path
    airframe: Airframe
    limits: Limits
    nodes: int | None
    # None where the planner's own number is taken
    yaw: YawMode
    yaw_angle: float
    start: BoundaryState | None
    end: BoundaryState | None

    def nodes_for(self, planner: str) -> int:
        return self.nodes if self.nodes is not None else default_nodes(self.path, planner)

    def task(self, planner: str, nodes: int | None = None) -> PlanningTask:
        """What that planner is asked, over its own number of nodes where none is given."""
        return PlanningTask(
            self.path, self.airframe, self.limits.plan, nodes or self.nodes_for(planner), self.yaw, self.yaw_angle,
            self.start, self.end,
        )  # fmt: skip


def default_nodes(path: Path, planner: str = "expert") -> int:
    """Intervals for a path: some a metre, within bounds, and a few for each of its pieces."""
    a_metre = NODES_PER_METRE.get(planner, OTHER_NODES_PER_METRE)
    most = MOST_LEARNED_NODES if planner == "learned" else MOST_NODES
    by_length = int(np.clip(round(a_metre * path.length), FEWEST_NODES, most))
    return max(by_length, NODES_PER_PIECE * (len(path.breaks) - 1))


def plan(
    path: Path,
    airframe: Airframe,
    limits: Limits,
    *,
    planner: str = AUTO,
    nodes: int | None = None,
    yaw: YawMode = YawMode.FIXED,
    yaw_angle: float = 0.0,
    speed_factor: float = 1.0,
    start: BoundaryState | None = None,
    end: BoundaryState | None = None,
) -> Plan:
    """The fastest certified flight along the path that the planner finds.

    "auto" asks the learned planner, where there is a model for the vehicle and the limits, and the convex one, and
    takes the faster of their flights; where that is far above the proven bound, the expert too.
    `speed_factor` slows the whole result: the same motion at that share of its speed, so that accelerations fall with
    its square. Where a boundary state is given, nothing may be slowed, or it would no longer hold.

    Raises:
        InfeasibleError: the path leaves the space, takes longer than the battery lasts, or no profile is found.
        InputError: unknown planner, no model for it, speed share or nodes out of range.
    """
    begun = time.perf_counter()
    _check_arguments(nodes, speed_factor, bound=start is not None or end is not None)
    check_space(path, limits.space)
    question = _Question(path, airframe, limits, nodes, yaw, yaw_angle, start, end)
    notes: list[str] = []
    bound = None
    if planner == AUTO:
        found, bound = _automatic(question, notes)
    else:
        found = _best(question, planner, notes)
    slowed = found.repaired
    if slowed.speed_factor < 1.0 and (start is not None or end is not None):
        raise InfeasibleError(
            f"the profile passes only at {slowed.speed_factor:.2%} of its speed, which would break the boundary state",
            hint="start slower, or leave the boundary free",
        )
    if changed := slowed.describe():
        notes.append(f"{found.planner}'s profile was {changed}")
    flown = slowed
    if speed_factor < 1.0:
        flown = slow(question.task(found.planner), slowed.trajectory.profile.slowed(speed_factor), limits.space)
    _check_endurance(flown.trajectory.duration, limits)
    return Plan(
        path=path,
        airframe=airframe,
        limits=limits,
        trajectory=flown.trajectory,
        certificate=flown.certificate,
        planner=found.planner,
        nodes=found.nodes,
        repair_speed_factor=slowed.speed_factor,
        speed_factor=speed_factor,
        seconds=time.perf_counter() - begun,
        notes=tuple(notes),
        lower_bound=bound,
        joints=found.joints,
    )


def _automatic(question: _Question, notes: list[str]) -> tuple[_Found, float]:
    """The fastest of what takes milliseconds, or of the expert; and the proven bound, s."""
    airframe, limits = question.airframe, question.limits.plan
    names = ["convex"]
    try:
        if model := find_model(airframe, limits):
            names.insert(0, "learned")
            notes.extend(model.differences(limits))
        else:
            notes.append("no model is for this vehicle and these limits: `cfplan train` makes one")
    except InputError as error:
        notes.append(f"no learned plan: {error}")
    found = [one for name in names if (one := _ask(question, name, question.nodes_for(name), notes))]
    bound = lower_bound(question.task("convex"))
    best = min(found, key=lambda one: one.duration, default=None)
    if best is None or best.repaired.speed_factor < 1.0 or best.duration > (1.0 + EXPERT_GAP) * bound:
        try:
            expert = _best(question, "expert", notes)
        except InfeasibleError:
            if best is None:
                raise
        else:
            found.append(expert)
            why = f"{best.duration / bound - 1:.1%} above the bound" if best else "nothing else came of it"
            notes.append(f"the expert was asked too: {why}")
            best = min(found, key=lambda one: one.duration)
    times = ", ".join(f"{one.planner} {one.duration:.3f} s" for one in found)
    notes.append(f"{times}; the proven bound is {bound:.3f} s, the plan {best.duration / bound - 1:.1%} above it")
    return best, bound


def _check_arguments(nodes: int | None, speed_factor: float, bound: bool) -> None:
    if nodes is not None and not 2 <= nodes <= 10 * MOST_NODES:
        raise InputError(
            f"{nodes} nodes; 2 to {10 * MOST_NODES} make sense",
            where="nodes",
            hint="leave nodes out to have them chosen",
        )
    if not LEAST_SPEED_FACTOR <= speed_factor <= 1.0:
        raise InputError(
            f"the speed factor must be from {LEAST_SPEED_FACTOR} to 1, not {speed_factor:g}",
            where="speed_factor",
            hint="0.5 flies at half the speed",
        )
    if bound and speed_factor < 1.0:
        raise InputError(
            "a speed factor would break the boundary state that is given",
            where="speed_factor",
            hint="leave the speed factor or the boundary state out",
        )


def _best(question: _Question, planner: str, notes: list[str]) -> _Found:
    """The fastest of the planner's tries, else what the first of the others finds; stops at the first good one."""
    nodes = question.nodes_for(planner)
    best: _Found | None = None
    for count in (nodes,) if question.nodes is not None or planner == "learned" else (nodes, 2 * nodes):
        found = _ask(question, planner, count, notes)
        if found and (best is None or found.duration < best.duration):
            best = found
        if best and best.repaired.speed_factor >= GOOD_SHARE:
            return best
    others = (*(("expert",) if planner == "learned" else ()), *LAST_RESORTS)
    for name in others:
        if best is None and name != planner:
            best = _ask(question, name, question.nodes_for(name), notes)
    if best is None:
        raise InfeasibleError(
            f"no plan. {'; '.join(notes)}", hint="loosen the plan's limits, or make the path gentler or longer"
        )
    return best


def _ask(question: _Question, name: str, nodes: int, notes: list[str]) -> _Found | None:
    """A planner's profile, repaired; None, and a note why, where nothing came of it."""
    task = question.task(name, nodes)
    solution = find_planner(name)(task)
    if solution.profile is None:
        notes.append(_failure(name, nodes, solution))
        return None
    nodes = len(solution.profile.s) - 1
    try:
        if name in REFINED:
            repaired = repair(task, solution.profile, question.limits.space)
        else:
            repaired = slow(task, solution.profile, question.limits.space)
    except (InfeasibleError, NotCertifiedError) as error:
        notes.append(f"{name} with {nodes} nodes: {error}")
        return None
    joints = solution.joints if repaired.joints is None else repaired.joints
    return _Found(repaired, name, nodes, joints)


def _failure(name: str, nodes: int, solution: Solution) -> str:
    own_words = f" ({' '.join(solution.reason.split())})" if solution.reason else ""
    return f"{name} with {nodes} nodes: {solution.status}{own_words}"


def _check_endurance(duration: float, limits: Limits) -> None:
    ground = limits.ground
    height = limits.space.high[2] - limits.space.low[2]
    around = height / ground.take_off_speed + height / ground.land_speed
    if duration + around > limits.battery.endurance:
        raise InfeasibleError(
            f"the path takes {duration:.1f} s, with take-off and landing up to {duration + around:.1f} s; the battery "
            f"is trusted for {limits.battery.endurance:g} s",
            where="battery.endurance",
            hint="fly fewer laps, a shorter path, or a larger share of the speed",
        )
