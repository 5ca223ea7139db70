"""The min-snap baseline: the path at its nominal timing, slowed or sped up uniformly until it is certified."""

import time

import numpy as np

from cfplan.errors import InfeasibleError, NotCertifiedError
from cfplan.planners.solution import Solution, Status
from cfplan.planners.task import PlanningTask
from cfplan.safety.slowing import slow_until_certified
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.trajectory import Trajectory
from cfplan.vehicle.yaw_spline import YawSpline

SAMPLES_PER_UNIT = 200  # of s, where the greatest nominal speed is sought


def plan_min_snap(task: PlanningTask) -> Solution:
    """Plan the largest constant h that the certificate allows. Boundary states are not met: they prescribe h."""
    begun = time.perf_counter()
    path, airframe, limits, nodes = task.path, task.airframe, task.limits, task.nodes
    grid = np.linspace(0.0, path.end, nodes + 1)
    dense = np.linspace(0.0, path.end, max(1000, int(SAMPLES_PER_UNIT * path.end)))
    fastest = limits.speed / np.linalg.norm(path(dense, 1), axis=1).max()  # ds/dt that meets the speed limit
    turning = YawSpline.along(path, nodes, task.yaw, task.yaw_angle)
    zeros = np.zeros(nodes + 1)
    profile = SpeedProfile(
        grid, np.full(nodes + 1, fastest**2), zeros, zeros, zeros[1:], turning.yaw, turning.dyaw, turning.ddyaw
    )
    try:
        slowed = slow_until_certified(Trajectory(path, profile, airframe), limits, caps=task.speed_caps)
    except (InfeasibleError, NotCertifiedError) as error:
        return Solution(Status.INFEASIBLE, None, str(error))
    stats: dict[str, float | int | str] = {
        "solver": "scaling",
        "speed_factor": slowed.speed_factor,
        "solve_seconds": time.perf_counter() - begun,
    }
    return Solution(Status.SOLVED, slowed.trajectory.profile, stats=stats)
