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
from dataclasses import astuple

import numpy as np

from cfplan.expert.between import ALLOWANCE, DensePath
from cfplan.expert.compiled import Backend, backend
from cfplan.expert.preconditions import broken_by, check_arguments, unsolvable
from cfplan.expert.problem import Ends, Problem, pose, profile_of, tightened
from cfplan.expert.program import Shape, program
from cfplan.expert.solution import Solution, Status
from cfplan.expert.solvers import Attempt, fatrop, ipopt
from cfplan.expert.stage import Penalties
from cfplan.expert.yaw_track import YawTrack, fixed_yaw, tangent_yaw
from cfplan.geometry.path import Path
from cfplan.geometry.yaw import YawMode
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.profile import BoundaryState, SpeedProfile

ROUNDS = 5
# of tightening, at most
ENOUGH = 0.5 * ALLOWANCE
# excess into the allowance that ends them
UNMET = 0.2
# an excess that says the solver did not meet the limits at all


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
    chosen: Backend | None = None,
) -> Solution:
    """Plan over `nodes` intervals uniform in s; see Planner.

    Yaw is that of the Hopf fibration. FIXED holds `yaw_angle`, TANGENT follows the horizontal direction of flight;
    both are laid out before the speed (see yaw_track), which then respects what turning takes. FREE leaves yaw to the
    optimiser, from a first yaw between `yaw_angle` and a quarter turn more, as the paper has it. A start or end state
    brings its own yaw in every mode.

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
    layout = program(shape, chosen).layout
    problem = pose(layout, path, airframe, limits, track, yaw_angle, Ends(start, end), penalties or Penalties())

    profile, failures = None, []
    for solve in (fatrop, ipopt):
        attempt = solve(shape, problem, chosen)
        profile = profile_of(attempt.x, problem, track, path.end)
        flaw = "" if attempt.solved else attempt.words
        if not (flaw := flaw or _flaw(profile)):
            break
        failures.append(f"{attempt.solver}: {flaw}")
    else:
        return Solution(Status.NOT_CONVERGED, None, "; ".join(failures), {"backend": str(chosen or backend())})

    profile, rounds, iterations, excess = _between_points(
        profile, attempt, problem, shape, track, path, airframe, limits, chosen
    )
    if excess > UNMET:
        return Solution(Status.NOT_CONVERGED, None, f"a limit is exceeded by {excess:.0%} of it")
    return Solution(
        Status.SOLVED,
        profile,
        "; ".join(failures),
        {
            "solve_seconds": time.perf_counter() - began,
            "iterations": attempt.iterations + iterations,
            "rounds": rounds,
            "solver": attempt.solver,
            "backend": str(chosen or backend()),
        },
    )


def _between_points(
    profile: SpeedProfile,
    attempt: Attempt,
    problem: Problem,
    shape: Shape,
    track: YawTrack,
    path: Path,
    airframe: Airframe,
    limits: PlanLimits,
    chosen: Backend | None,
) -> tuple[SpeedProfile, int, int, float]:
    """The profile, the rounds and iterations that it took, and the excess that is left."""
    dense = DensePath(path, shape.nodes)
    excess = dense.excess(profile, airframe, limits)
    x, iterations = attempt.x, 0
    for done in range(ROUNDS):
        if excess.worst <= ENOUGH:
            return profile, done, iterations, excess.worst
        problem = tightened(problem, excess)
        again = fatrop(shape, problem, chosen, x)
        iterations += again.iterations
        candidate = profile_of(again.x, problem, track, path.end)
        if not again.solved or _flaw(candidate):
            return profile, done, iterations, excess.worst
        x, profile = again.x, candidate
        excess = dense.excess(profile, airframe, limits)
    return profile, ROUNDS, iterations, excess.worst


def _flaw(profile: SpeedProfile) -> str:
    """What is wrong with a profile that a solver calls solved; empty where nothing is."""
    if not all(np.isfinite(values).all() for values in astuple(profile)):
        return "the solution is not finite"
    places = np.linspace(0.0, 1.0, 9)
    nodes = np.arange(len(profile.s) - 1)
    s = profile.s[:-1, None] + np.diff(profile.s)[:, None] * places
    if (profile.at(s, np.repeat(nodes[:, None], len(places), axis=1)).h <= 0).any():
        return "h falls to zero between nodes"
    return ""
