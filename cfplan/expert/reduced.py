"""The expert: the fastest profile that keeps every limit, by the reduced formulation.

State (h, h', h'', ψ, ψ') and control (h''', ψ''), constant in each interval, so the dynamics are linear and exact
and everything physical follows point by point through the flatness map (DESIGN section 4). Minimised is the time of
flight, by Gauss quadrature, with small penalties on angular acceleration, yaw rate and roughness. Limits hold at both
ends of every interval, where the controls jump, and at points inside.

Between those points a limit can still be exceeded by a percent or so. The solution is looked at densely; where it
exceeds a limit, that limit is lowered by as much in that interval alone, and the problem solved again from there,
which takes a few iterations and costs about a hundredth of a percent in time.

Where the path rests (γ' = γ'' = γ''' = 0) h has no bearing on motion and hardly any on its first derivatives: left
alone, an optimiser lets it run away or stop short. There h stays constant over the first, or last, interval.
"""

import math
import time
from dataclasses import astuple, dataclass

import numpy as np

from cfplan.expert.between import ALLOWANCE, DensePath
from cfplan.expert.compiled import Backend
from cfplan.expert.kernel import backend as backend_in_use
from cfplan.expert.preconditions import broken_by, check_arguments, unsolvable
from cfplan.expert.problem import Ends, Problem, held_by, pose, profile_of, tightened
from cfplan.expert.program import Shape, layout_of
from cfplan.expert.solution import Solution, Status
from cfplan.expert.solvers import Attempt, interior_point, ipopt
from cfplan.expert.stage import Penalties
from cfplan.expert.yaw_track import YawTrack, fixed_yaw, tangent_yaw
from cfplan.geometry.path import Path
from cfplan.geometry.yaw import YawMode
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.profile import BoundaryState, SpeedProfile

ROUNDS = 5
# of tightening, at most
ENOUGH = ALLOWANCE / 3
# excess into the allowance that ends them


@dataclass(frozen=True, slots=True)
class _Task:
    """What is to be planned, and with what."""

    path: Path
    airframe: Airframe
    limits: PlanLimits
    ends: Ends
    track: YawTrack
    shape: Shape
    backend: Backend | None


def plan_reduced(
    path: Path,
    airframe: Airframe,
    limits: PlanLimits,
    *,
    nodes: int = 100,
    yaw: YawMode = YawMode.FIXED,
    yaw_angle: float = 0.0,
    start: BoundaryState | None = None,
    end: BoundaryState | None = None,
    penalties: Penalties | None = None,
    backend: Backend | None = None,
) -> Solution:
    """Plan over `nodes` intervals uniform in s; see Planner.

    Yaw is that of the Hopf fibration. FIXED holds `yaw_angle`, TANGENT follows the horizontal direction of flight;
    both are laid out before the speed (see yaw_track), which then respects what turning takes. FREE leaves yaw to the
    optimiser, from a first yaw between `yaw_angle` and a quarter turn more, as the paper has it. A start or end state
    brings its own yaw in every mode. `backend` is for tests: left out, compiled code where there is a compiler.

    Raises:
        InputError: arguments that are not numbers, or fewer nodes than the path needs.
    """
    check_arguments(path, nodes, yaw_angle, start, end)
    began = time.perf_counter()
    if reason := unsolvable(airframe, limits):
        return Solution(Status.INFEASIBLE, None, reason)
    for name, boundary, s in (("start", start, 0.0), ("end", end, path.end)):
        if boundary and (reason := broken_by(boundary, path, s, airframe, limits)):
            return Solution(Status.BAD_BOUNDARY, None, f"{name}: {reason}")

    track = (tangent_yaw if yaw is YawMode.TANGENT else fixed_yaw)(path, nodes, yaw_angle, start, end)
    shape = Shape(nodes, yaw is YawMode.FREE, turning_limited=limits.angular_acceleration < math.inf)
    task = _Task(path, airframe, limits, Ends(start, end), track, shape, backend)
    layout = layout_of(shape)
    problem = pose(layout, path, airframe, limits, track, yaw_angle, task.ends, penalties or Penalties())

    failures: list[str] = []
    for solve in (interior_point, ipopt):
        attempt = solve(problem, backend)
        flaw = _flaw(attempt, problem, task)
        if not flaw:
            break
        failures.append(f"{attempt.solver}: {flaw}")
    else:
        return Solution(Status.NOT_CONVERGED, None, "; ".join(failures))

    profile, rounds, iterations = _tightened_between(attempt, problem, task)
    stats: dict[str, float | int | str] = {
        "solve_seconds": time.perf_counter() - began,
        "iterations": attempt.iterations + iterations,
        "rounds": rounds,
        "solver": attempt.solver,
        "backend": str(backend or backend_in_use()),
    }
    return Solution(Status.SOLVED, profile, "; ".join(failures), stats)


def _tightened_between(attempt: Attempt, problem: Problem, task: _Task) -> tuple[SpeedProfile, int, int]:
    """The profile that keeps its limits between the points too, the rounds and the iterations that took."""
    dense = DensePath(task.path, task.shape.nodes, held_by(task.ends, task.shape.nodes))
    iterations = 0
    for done in range(ROUNDS):
        profile = profile_of(attempt.table, problem, task.track, task.path.end)
        excess = dense.excess(profile, task.airframe, task.limits)
        if excess.worst <= ENOUGH:
            return profile, done, iterations
        problem = tightened(problem, excess, attempt.at_points)
        again = interior_point(problem, task.backend, attempt.table)
        iterations += again.iterations
        if _flaw(again, problem, task):  # what there is is nearly right; slowing will do the rest
            return profile, done, iterations
        attempt = again
    return profile_of(attempt.table, problem, task.track, task.path.end), ROUNDS, iterations


def _flaw(attempt: Attempt, problem: Problem, task: _Task) -> str:
    """What is wrong with an answer, also with one that the solver calls solved; empty where nothing is."""
    if not attempt.solved:
        return attempt.words
    profile = profile_of(attempt.table, problem, task.track, task.path.end)
    if not all(np.isfinite(values).all() for values in astuple(profile)):
        return "the solution is not finite"
    places = np.linspace(0.0, 1.0, 9)
    nodes = np.arange(task.shape.nodes)
    s = profile.s[:-1, None] + np.diff(profile.s)[:, None] * places
    if (profile.at(s, np.repeat(nodes[:, None], len(places), axis=1)).h <= 0).any():
        return "h falls to zero between nodes"
    return ""
