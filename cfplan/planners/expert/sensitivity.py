"""The gradient of the flight time by the path.

At an optimum the flight time changes with the data of its problem as the Lagrangian does at fixed profile and
multipliers (the envelope theorem). The path enters the Lagrangian by γ' to γ'''' at the problem's points alone; the
kernels evaluate it there with each of these twelve numbers perturbed. Where the limit on speed is active, γ' enters by
the bound on h. A yaw along the path is held fixed; penalties count as time, as in the problem.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.geometry.path import Path
from cfplan.planners.expert import point_constraints
from cfplan.planners.expert.expert import Attempt, early, refining, rejection_reason, segment_of, solve
from cfplan.planners.expert.kernel import Kernels
from cfplan.planners.expert.problem import Problem, build_problem, interval_of
from cfplan.planners.expert.transcription import OBJECTIVE_SCALE
from cfplan.planners.task import PlanningTask
from cfplan.vehicle.timing import duration_of

_MOVED = 1e-6  # perturbation, as a fraction of the largest value of that derivative of the path
_STILL = 1e-9  # |γ'|² below which the path stands still


class Sensitivity(NamedTuple):
    """The flight time along a path, and its gradient by the path."""

    duration: float  # s, within about 1 %: limits hold at the points of the grid only
    s: NDArray  # (P,) places along the path
    by_path: NDArray  # (4, 3, P) s per unit of γ' to γ'''' at the places
    coefficients: NDArray  # (N+3, 1 or 2) of the profile's splines


def sensitivity(task: PlanningTask, near: NDArray | None = None) -> Sensitivity | None:
    """Return the flight time of a task and its gradient by the path, from one search for the profile; None if it fails.

    `near` are the coefficients of a similar path's profile, which save half of the iterations.
    """
    if task.refusal:
        return None
    segment = segment_of(task, task.nodes)
    problem = build_problem(segment, task.yaw_angle)
    interval = interval_of(segment, problem.coefficients)
    tries = [(near, refining(interval).starts[:1])] if near is not None else []
    for coefficients, starts in [*tries, (problem.coefficients, early(interval).starts)]:
        attempt = solve(problem, coefficients, starts, task.deadline)
        if not rejection_reason(attempt, segment):
            duration = float(duration_of(segment.profile(attempt.coefficients)))
            return Sensitivity(duration, *_by_path(problem, attempt, task.path), attempt.coefficients)
    return None


def _by_path(problem: Problem, attempt: Attempt, path: Path) -> tuple[NDArray, NDArray]:
    """Return the places, (P,), where the Lagrangian depends on the path, and its derivatives there, (4, 3, P), in s."""
    layout = problem.layout
    of_points = len(layout.interval) * point_constraints.ROWS
    multipliers = (attempt.multipliers.slacks[2] - attempt.multipliers.slacks[1]) / OBJECTIVE_SCALE
    at_points = _by_point_data(problem, attempt, multipliers[:of_points])
    speed_s = layout.speed_s * problem.step
    tangent = path(speed_s, 1).T
    held = np.where(np.isfinite(problem.highest), problem.highest, 0.0) * multipliers[of_points:][: len(speed_s)]
    by_speed = np.zeros((4, 3, len(speed_s)))
    by_speed[0] = 2.0 * held * tangent / np.maximum((tangent**2).sum(axis=0), _STILL)
    return np.append(layout.s * problem.step, speed_s), np.concatenate([at_points, by_speed], axis=-1)


def _by_point_data(problem: Problem, attempt: Attempt, multipliers: NDArray) -> NDArray:
    """Return the gradient of the Lagrangian by γ' to γ'''' at the points, (4, 3, P)."""
    layout, free_yaw = problem.layout, problem.layout.shape.free_yaw
    points = len(layout.interval)
    local = [attempt.coefficients[layout.interval + k, 0] for k in range(4)]
    if free_yaw:
        local += [attempt.coefficients[layout.interval + k, 1] for k in range(3)]
    moved = _MOVED * np.abs(problem.point_data[:12]).reshape(4, -1).max(axis=1).repeat(3)
    data = np.repeat(problem.point_data[:, None], 13, axis=1)  # unchanged, and with each of twelve rows perturbed
    data[np.arange(12), np.arange(1, 13)] += moved[:, None]
    kernels = Kernels(free_yaw, data.reshape(len(data), -1), problem.common, OBJECTIVE_SCALE * problem.penalties, 0)
    kernels.coefficients[:] = np.tile(local, 13)
    rows, penalty = kernels.evaluate()
    of_rows = (rows.reshape(-1, 13, points) * multipliers.reshape(-1, 1, points)).sum(axis=0)
    lagrangian = of_rows + penalty.reshape(13, points) / OBJECTIVE_SCALE
    by_data = (lagrangian[1:] - lagrangian[0]) / moved[:, None]
    return by_data.reshape(4, 3, points) * problem.step ** np.arange(1.0, 5.0)[:, None, None]
