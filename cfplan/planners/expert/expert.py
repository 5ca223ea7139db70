"""The expert: the fastest profile that keeps every limit, by the reduced formulation.

State (h, h', h'', ψ, ψ') and control (h''', ψ''), constant in each interval, so the dynamics are linear and exact
and everything physical follows point by point through the flatness map (docs/architecture.md). Minimised is the time of
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

from numpy.typing import NDArray

from cfplan.geometry.yaw import YawMode
from cfplan.planners.expert.kernel import Backend
from cfplan.planners.expert.point_constraints import Penalties
from cfplan.planners.expert.problem import Ends, pose, profile_of
from cfplan.planners.expert.program import Shape, layout_of
from cfplan.planners.expert.solvers import interior_point, ipopt
from cfplan.planners.expert.tightening import Kept, Task, flaw, kept_between
from cfplan.planners.expert.windows import by_windows
from cfplan.planners.solution import Solution, Status
from cfplan.planners.task import PlanningTask
from cfplan.vehicle.yaw_spline import YawSpline

WINDOW = (96, 24)
# intervals that a window keeps, and how much further it looks: longer windows take more steps


def plan_expert(
    task: PlanningTask,
    *,
    penalties: Penalties | None = None,
    windows: bool = True,
    backend: Backend | None = None,
) -> Solution:
    """Plan the fastest profile that keeps every limit of the task.

    Yaw is that of the Hopf fibration. FIXED holds the yaw angle, TANGENT follows the horizontal direction of flight;
    both are laid out before the speed (see yaw_track), which then respects what turning takes. FREE leaves yaw to the
    optimiser, from a first yaw between that angle and a quarter turn more, as the paper has it. A start or end state
    brings its own yaw in every mode. Long paths are taken window by window, unless `windows` is False. `backend` is for
    tests: left out, compiled code.

    Raises:
        InputError: fewer nodes than the path needs.
    """
    task.check_nodes()
    if task.refusal:
        return task.refusal
    began = time.perf_counter()
    path, airframe, limits, nodes = task.path, task.airframe, task.limits, task.nodes
    yaw, yaw_angle, start, end = task.yaw, task.yaw_angle, task.start, task.end
    track = YawSpline.along(path, nodes, yaw, yaw_angle, start, end)
    shape = Shape(nodes, yaw is YawMode.FREE, turning_limited=limits.angular_acceleration < math.inf)
    whole = Task(path, airframe, limits, Ends(start, end), track, layout_of(shape), backend)
    failures: list[str] = []
    solvers: set[str] = set()

    def search(window: Task, _near: NDArray) -> Kept | str:
        problem = pose(
            window.layout, window.path, airframe, limits, window.track, yaw_angle, window.ends, penalties or Penalties()
        )
        reasons: list[str] = []
        for solve in (interior_point, ipopt):
            attempt = solve(problem, backend)
            reason = flaw(attempt, problem, window)
            if not reason:
                failures.extend(reasons)
                solvers.add(attempt.solver)
                return kept_between(attempt, problem, window)
            reasons.append(f"{attempt.solver}: {reason}")
        return "; ".join(reasons)

    joined = by_windows(whole, WINDOW if windows else (nodes, 0), search)
    if isinstance(joined, str):
        return Solution(Status.NOT_CONVERGED, None, joined)
    stats: dict[str, float | int | str] = {
        "solve_seconds": time.perf_counter() - began,
        "iterations": joined.iterations,
        "rounds": joined.rounds,
        "windows": 1 + len(joined.joints),
        "solver": " and ".join(sorted(solvers)),
        "backend": str(backend or Backend.COMPILED),
    }
    profile = profile_of(joined.table, limits.speed**2, track, path.end)
    return Solution(Status.SOLVED, profile, "; ".join(failures), stats, joined.joints)
