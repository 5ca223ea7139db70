"""From limits kept at points to limits kept between them too: lower them where they are exceeded, and search again."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.geometry.path import Path
from cfplan.planners.expert.intersample import ALLOWANCE, DensePath
from cfplan.planners.expert.kernel import Backend
from cfplan.planners.expert.problem import Ends, Problem, held_by, profile_of, tightened
from cfplan.planners.expert.program import Layout
from cfplan.planners.expert.solvers import AGAIN, Attempt, again
from cfplan.planners.solver.interior_point import Search
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.yaw_spline import YawSpline

ROUNDS = 5
# of tightening, at most
ENOUGH = ALLOWANCE / 3
# excess into the allowance that ends them


@dataclass(frozen=True, slots=True)
class Task:
    """What is to be planned, and with what."""

    path: Path
    airframe: Airframe
    limits: PlanLimits
    ends: Ends
    track: YawSpline
    layout: Layout
    backend: Backend | None = None


class Kept(NamedTuple):
    """A solution that keeps its limits between the points, as far as it could be brought to."""

    table: NDArray
    # (N+3, 1 or 2) spline coefficients
    rounds: int
    iterations: int
    # of the attempt and of all rounds


def kept_between(attempt: Attempt, problem: Problem, task: Task, searches: Sequence[Search] = AGAIN) -> Kept:
    """Round by round until nothing is exceeded; a round that fails leaves what there was: slowing will do the rest."""
    nodes = task.layout.shape.nodes
    dense = DensePath(task.path, nodes, held_by(task.ends, nodes))
    iterations = attempt.iterations
    for done in range(ROUNDS):
        profile = profile_of(attempt.table, problem.unit, task.track, task.path.end)
        excess = dense.excess(profile, task.airframe, task.limits)
        if excess.worst <= ENOUGH:
            return Kept(attempt.table, done, iterations)
        problem = tightened(problem, excess, attempt.at_points)
        next_one = again(attempt, problem, task.backend, searches)
        iterations += next_one.iterations
        if flaw(next_one, problem, task):
            return Kept(attempt.table, done, iterations)
        attempt = next_one
    return Kept(attempt.table, ROUNDS, iterations)


def flaw(attempt: Attempt, problem: Problem, task: Task) -> str:
    """What is wrong with an answer, also with one that the solver calls solved; empty where nothing is."""
    if not attempt.solved:
        return attempt.words
    if not np.isfinite(attempt.table).all():
        return "the solution is not finite"
    if (attempt.table[:, 0] > 0).all():  # then so is h, which lies between its coefficients
        return ""
    profile = profile_of(attempt.table, problem.unit, task.track, task.path.end)
    places = np.linspace(0.0, 1.0, 9)
    nodes = np.arange(task.layout.shape.nodes)
    s = profile.s[:-1, None] + np.diff(profile.s)[:, None] * places
    if (profile.at(s, np.repeat(nodes[:, None], len(places), axis=1)).h <= 0).any():
        return "h falls to zero between nodes"
    return ""
