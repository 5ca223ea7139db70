"""Planning policies as a table: which planners are called, when, in which order and on which grids."""

from collections.abc import Callable, Sequence
from dataclasses import astuple, replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from cfplan.errors import InfeasibleError, InputError, NotCertifiedError
from cfplan.learning.model_files import find_model
from cfplan.planners.solution import Solution
from cfplan.planners.task import NODES_PER_PIECE, PlanningTask
from cfplan.planning.planners import AUTO, PLANNERS, Finish, default_nodes, find_planner
from cfplan.planning.repair import Repaired, refine, repair, slow
from cfplan.safety.space import Space

GOOD_SPEED_FACTOR = 0.97  # a profile that repair slows below this is tried on the next grid
SAME_STATE = 1e-6  # tolerance on h, yaw and their derivatives of a boundary state

FINISH = MappingProxyType({Finish.REFINED: refine, Finish.REPAIRED: repair, Finish.SLOWED: slow})


class Found(NamedTuple):
    """A planner's profile, repaired."""

    repaired: Repaired
    planner: str
    nodes: int  # intervals of the profile
    joints: tuple[float, ...]  # s, where the windows of the profile meet
    grid: float = 1.0  # factor on the planner's own number of nodes

    @property
    def duration(self) -> float:
        """Return the flight's duration, s."""
        return self.repaired.trajectory.duration


class Choice(NamedTuple):
    """The fastest flight that a policy found."""

    best: Found
    notes: tuple[str, ...]  # remarks, one sentence each
    left_out: str = ""  # what there was no time for; empty if the deadline did not pass


class Due(NamedTuple):
    """Whether a step is taken, with a remark about it."""

    due: bool
    notes: tuple[str, ...] = ()


def always(_task: PlanningTask, _found: Sequence[Found]) -> Due:
    """Take the step."""
    return Due(True)


def a_model_knows(task: PlanningTask, _found: Sequence[Found]) -> Due:
    """Take the step if there is a model that has learned from vehicles and limits like these."""
    if task.refusal:
        return Due(False)
    try:
        model = find_model(task.airframe, task.limits, task.models)
    except InputError as error:
        return Due(False, (f"no learned plan: {error}",))
    if model is None:
        return Due(False, ("no model was found: `cfplan train` makes one",))
    outside = model.outside(task.airframe, task.limits)
    return Due(not outside, outside)


def nothing_finished(_task: PlanningTask, found: Sequence[Found]) -> Due:
    """Take the step unless a flight was found that was refined to its end, on a whole grid, and needed no slowing."""
    refined = (one for one in found if PLANNERS[one.planner].finished is not Finish.SLOWED)
    return Due(not any(_finished(one.repaired) and one.grid >= 1.0 for one in refined))


def _finished(repaired: Repaired) -> bool:
    return repaired.speed_factor == 1.0 and not repaired.failed


class Step(NamedTuple):
    """One line of a policy."""

    planners: tuple[str, ...]  # tried in order until one finds a profile
    when: Callable[[PlanningTask, Sequence[Found]], Due] = always
    grids: tuple[float, ...] = (1,)  # factors on the first planner's nodes, in turn until its profile is hardly slowed
    finishes: bool = False  # whether grids are tried until a profile needs no slowing at all


# Convex and min-snap rarely fail, so every policy ends with one of them. The fastest result is used.
# PLANNERS defines whether a planner's profile is refined or only slowed if it does not pass.
POLICIES = MappingProxyType(
    {
        AUTO: (
            Step(("learned",), when=a_model_knows, grids=(1, 0.5), finishes=True),
            Step(("expert", "minsnap"), when=nothing_finished, grids=(1, 2)),
            Step(("convex",), when=nothing_finished),
        ),
        "learned": (Step(("learned", "expert", "convex", "minsnap")),),
        "expert": (Step(("expert", "convex", "minsnap"), grids=(1, 2)),),
        "toppquad": (Step(("toppquad", "convex", "minsnap"), grids=(1, 2)),),
        "convex": (Step(("convex", "minsnap"), grids=(1, 2)),),
        "minsnap": (Step(("minsnap", "convex"), grids=(1, 2)),),
    }
)


def choose(policy: str, task: PlanningTask, nodes: int | None, space: Space) -> Choice:
    """Return the fastest flight that the policy's steps find.

    `nodes` is the number of intervals; by default each planner's own. After the task's deadline further steps are taken
    only while nothing is found; no search begins then, so they are short.

    Raises:
        InfeasibleError: no planner finds a flight; gives the reason of each.
        InputError: the learned planner is requested and there is no model, or there are too few nodes.
    """
    found: list[Found] = []
    notes: list[str] = []
    skipped: list[str] = []
    for step in POLICIES[policy]:
        if found and task.deadline.passed:
            skipped.append(f"{step.planners[0]} not asked")
            continue
        due = step.when(task, found)
        notes += due.notes
        if due.due:
            one, failures = _take(step, replace(task, dispensable=bool(found)), nodes, space)
            if found and one is None and task.deadline.passed:
                skipped.append(f"{step.planners[0]} not finished")
            found += [one] if one else []
            notes += failures
    if not found:
        hint = "loosen the plan's limits, or make the path gentler or longer"
        if task.deadline.passed:
            hint = "give planning more time (--budget), or the path fewer waypoints"
        raise InfeasibleError(f"no plan. {'; '.join(_by_reason(notes))}", hint=hint)
    best = min(found, key=lambda one: one.duration)
    return Choice(best, tuple(notes), _left_out(best, skipped) if task.deadline.passed else "")


def _left_out(best: Found, skipped: Sequence[str]) -> str:
    """Return what there was no time for."""
    unrefined = [f"{best.planner}'s profile not refined ({best.repaired.failed})"] if best.repaired.failed else []
    return ", ".join([*unrefined, *skipped])


def _take(step: Step, task: PlanningTask, nodes: int | None, space: Space) -> tuple[Found | None, list[str]]:
    """Return the fastest profile of the first of the step's planners that finds one, and why the others found none."""
    notes: list[str] = []
    for place, planner in enumerate(step.planners):
        own_nodes = default_nodes(task.path, planner) if nodes is None else nodes
        found: list[Found] = []
        for factor in step.grids if place == 0 and nodes is None else (1,):
            enough = min(own_nodes, NODES_PER_PIECE * (len(task.path.breaks) - 1))
            answer = ask(planner, replace(task, nodes=max(round(factor * own_nodes), enough)), space)
            if isinstance(answer, str):
                notes.append(answer)
                continue
            found.append(answer._replace(grid=factor))
            hardly = answer.repaired.speed_factor >= GOOD_SPEED_FACTOR
            if (_finished(answer.repaired) if step.finishes else hardly) or task.deadline.passed:
                break
        if found:
            return min(found, key=lambda one: one.duration), notes
    return None, notes


def _by_reason(notes: Sequence[str]) -> list[str]:
    """Merge notes of the form "planner: reason": each reason occurs once, after all planners that it stopped."""
    stopped: dict[str, list[str]] = {}
    for note in notes:
        who, _, why = note.partition(": ")
        stopped.setdefault(why or note, []).append(who)
    return [", ".join(who) + ("" if [why] == who else f": {why}") for why, who in stopped.items()]


def ask(planner: str, task: PlanningTask, space: Space) -> Found | str:
    """Return a planner's profile, repaired; or why there is none."""
    solution = find_planner(planner)(task)
    if solution.profile is None:
        return _failure(planner, task.nodes, solution)
    nodes = len(solution.profile.s) - 1
    try:
        repaired = FINISH[PLANNERS[planner].finished](task, solution.profile, space)
    except (InfeasibleError, NotCertifiedError) as error:
        return f"{planner} with {nodes} nodes: {error}"
    if missed := _missed_boundary(task, repaired):
        return f"{planner} with {nodes} nodes: {missed}"
    return Found(repaired, planner, nodes, solution.joints if repaired.joints is None else repaired.joints)


def _missed_boundary(task: PlanningTask, repaired: Repaired) -> str:
    """Return why a repaired profile does not begin in the task's boundary state; empty if it does."""
    if task.start is None:
        return ""
    reached = astuple(repaired.trajectory.profile.boundary(0))
    if np.allclose(reached, astuple(task.start), rtol=SAME_STATE, atol=SAME_STATE):
        return ""
    if repaired.speed_factor < 1.0:
        return f"passes only at {repaired.speed_factor:.2%} of its speed, which would break the boundary state"
    return "the start is not in the boundary state"


def _failure(planner: str, nodes: int, solution: Solution) -> str:
    message = f" ({' '.join(solution.reason.split())})" if solution.reason else ""
    return f"{planner} with {nodes} nodes: {solution.status}{message}"
