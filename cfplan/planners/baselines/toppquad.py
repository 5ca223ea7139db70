"""TOPPQuad as a planner: the paper's method, a baseline for the expert and the learned planner.

K. Mao, I. Spasojevic, M. A. Hsieh, V. Kumar, "TOPPQuad: Dynamically-Feasible Time-Optimal Path Parametrization for
Quadrotors", IROS 2024, arXiv:2309.11637; as used in K. Mao et al., "Sequence Modeling for Time-Optimal Quadrotor
Trajectory Optimization with Sampling-based Robustness Analysis", 2025, arXiv:2506.13915, which is "the paper".

Only h and yaw at the grid points are taken from the solution: attitude, rates and thrusts follow from them through
flatness, as in the paper, and the solver's own values of them are dropped.
"""

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.geometry.path import Path
from cfplan.geometry.yaw import YawMode
from cfplan.planners.baselines.selection import select_fastest
from cfplan.planners.baselines.toppquad_nlp import (
    H_LEAST,
    PENALTY,
    ROWS,
    STEP_ROWS,
    VARIABLES,
    ToppquadNlp,
    build_toppquad,
)
from cfplan.planners.solution import Solution, Status
from cfplan.planners.task import PlanningTask
from cfplan.safety.feasibility import spare_turning
from cfplan.safety.limits import PlanLimits
from cfplan.safety.speed_caps import allowed_speed
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.profile_spline import profile_through
from cfplan.vehicle.rotations import hopf_quaternion, product
from cfplan.vehicle.yaw_spline import YawSpline

MIN_NODES = 8
MAX_ITERATIONS = 1000
MAX_SECONDS = 30.0  # of one attempt
# ds/dt of the min-snap timings to start from: the paper's, which solved 98 % of its paths, and one for a second attempt
GUESS_SPEEDS = (1.0, 0.5)
END_NODES = 2
END_USAGE = 0.5
# Of the spline through h: the paper's grid is too coarse to determine h between its points
H_STIFFNESSES = (1e-2, 1e-1, 1.0, 10.0, 100.0)
YAW_STIFFNESS = 1e-2


def plan_toppquad(task: PlanningTask, *, penalty: float = PENALTY) -> Solution:
    """Solve the paper's problem with λ = `penalty`. Free yaw starts in [0, π/2], as in the paper.

    Of a boundary state, h, h' and the initial yaw are met: the problem has no further states.
    """
    path, airframe, limits, nodes = task.path, task.airframe, task.limits, task.nodes
    yaw, yaw_angle = task.yaw, task.yaw_angle
    if nodes < MIN_NODES:
        return Solution(Status.NOT_CONVERGED, None, f"{nodes} intervals are too few: use at least {MIN_NODES}")
    begun = time.process_time()
    nlp = build_toppquad(nodes + 1, airframe, limits.angular_acceleration, MAX_ITERATIONS, MAX_SECONDS, penalty)
    built = time.process_time()
    grid = np.linspace(0.0, path.end, nodes + 1)
    if task.start is not None and yaw is YawMode.FREE:
        yaw_angle = task.start.yaw
    angles = YawSpline.along(path, nodes, yaw, yaw_angle).yaw
    asked = program_bounds(task, grid, yaw)
    held = program_bounds(task, grid, YawMode.FIXED)
    guesses = [_guess(path, grid, airframe, angles, _guessed_h(path, grid, limits, speed)) for speed in GUESS_SPEEDS]
    parameters = _parameters(path, grid, angles)

    attempts = [_solve(nlp, guesses[0], parameters, asked)]
    if not attempts[-1].solved:
        # With yaw held the problem is far easier; its solution is a good guess for free yaw, and a valid answer to it.
        attempts.append(_solve(nlp, guesses[1], parameters, held))
        if attempts[-1].solved and yaw is YawMode.FREE:
            attempts.append(_solve(nlp, attempts[-1].x, parameters, asked))
    found = next((attempt for attempt in reversed(attempts) if attempt.solved), attempts[0])
    solved = time.process_time()
    stats: dict[str, float | int | str] = {
        "solver": "IPOPT",
        "build_seconds": built - begun,
        "solve_seconds": solved - built,
        "tries": len(attempts),
        "iterations": sum(attempt.iterations for attempt in attempts),
        "message": found.message,
    }
    if not found.solved:
        status = Status.INFEASIBLE if "Infeasible" in found.message else Status.NOT_CONVERGED
        return Solution(status, None, f"IPOPT: {found.message}", stats)
    if yaw is YawMode.FREE:
        angles = np.unwrap(2 * np.arctan2(found.x[:, 4], found.x[:, 5]), period=4 * np.pi)
    profiles = (
        profile_through(grid, grid, found.x[:, 0], angles, h_stiffness=stiffness, yaw_stiffness=YAW_STIFFNESS)
        for stiffness in H_STIFFNESSES
    )
    profile = select_fastest(task, profiles)
    stats["fit_seconds"] = time.process_time() - solved
    if profile is None:
        return Solution(Status.NOT_CONVERGED, None, "no spline through the solution stays above h = 0", stats)
    return Solution(Status.SOLVED, profile, stats=stats)


@dataclass(frozen=True, slots=True)
class _Attempt:
    x: NDArray  # (N+1, 16)
    solved: bool
    message: str  # the solver's
    iterations: int


def _solve(nlp: ToppquadNlp, guess: NDArray, parameters: NDArray, bounds: dict[str, NDArray]) -> _Attempt:
    answer = nlp.solver(x0=guess.ravel(), p=parameters, **bounds)
    report = nlp.solver.stats()
    x = np.array(answer["x"]).reshape(nlp.nodes, VARIABLES)
    return _Attempt(x, bool(report["success"]), str(report["return_status"]), int(report["iter_count"]))


def _parameters(path: Path, grid: NDArray, angles: NDArray) -> NDArray:
    half = angles[:, None] / 2
    columns = np.concatenate([path(grid, 1), path(grid, 2), np.cos(half), np.sin(half)], axis=1)
    return np.concatenate([[grid[1] - grid[0]], columns.ravel()])


def program_bounds(task: PlanningTask, grid: NDArray, yaw: YawMode) -> dict[str, NDArray]:
    """Return lbx, ubx, lbg, ubg for this yaw mode."""
    path, airframe, limits = task.path, task.airframe, task.limits
    count = len(grid)
    low, high = np.full((count, VARIABLES), -np.inf), np.full((count, VARIABLES), np.inf)
    square = np.maximum(np.sum(path(grid, 1) ** 2, axis=1), 1e-12)
    speed = allowed_speed(limits.speed, task.speed_caps, grid)
    low[:, 0], high[:, 0] = H_LEAST, np.maximum(speed**2 / square, 2 * H_LEAST)
    high[:, 0] = np.minimum(high[:, 0], _end_caps(path, grid, airframe, limits))
    low[:, 12:16] = limits.motor_thrust_min / airframe.hover_thrust
    high[:, 12:16] = limits.motor_thrust_max / airframe.hover_thrust

    rows_low, rows_high = np.zeros((count, ROWS)), np.zeros((count, ROWS))
    rows_low[:, 6:], rows_high[:, 6:] = -np.inf, np.inf
    rows_high[:, 6], rows_high[:, 7] = limits.acceleration**2, limits.angular_velocity**2
    rows_high[:, 12] = 1.0
    rows_low[:, 8], rows_low[:, 9] = np.cos(limits.tilt), limits.specific_thrust_min
    if yaw is not YawMode.FREE:
        rows_low[:, 10] = rows_high[:, 10] = 0.0
    elif task.start is not None:
        rows_low[0, 10] = rows_high[0, 10] = 0.0
    else:
        low[0, 4], low[0, 5], rows_low[0, 11] = 0.0, 0.0, 0.0  # z ≥ 0, w ≥ 0 and z ≤ w: yaw in [0, π/2]
    if task.start is not None:
        low[0, :2] = high[0, :2] = (task.start.h, task.start.dh)
    steps = np.zeros((count - 1) * STEP_ROWS)
    return {
        "lbx": low.ravel(),
        "ubx": high.ravel(),
        "lbg": np.concatenate([rows_low.ravel(), steps, [1.0]]),
        "ubg": np.concatenate([rows_high.ravel(), steps, [1.0]]),
    }


def _end_caps(path: Path, grid: NDArray, airframe: Airframe, limits: PlanLimits) -> NDArray:
    """Return (N+1,), the upper bound of h at the END_NODES grid points at each end; infinite elsewhere.

    Between the last two grid points of a rest end γ'' grows from zero, so the equations at the points alone let h
    grow without bound there. At constant h the thrust axis turns at h^(3/2) |γ'''| / g and its rate grows by
    h² |γ''''| / g: these stay within the body rate and within END_USAGE of the turning that motors can give.
    """
    caps = np.full(len(grid), np.inf)
    turning = END_USAGE * min(spare_turning(airframe, limits), limits.angular_acceleration)
    for ends in (range(END_NODES), range(len(grid) - END_NODES, len(grid))):
        near = np.linspace(grid[max(ends[0] - 1, 0)], grid[min(ends[-1] + 1, len(grid) - 1)], 8 * END_NODES)
        third, fourth = (float(np.linalg.norm(path(near, order), axis=1).max()) for order in (3, 4))
        rate = (GRAVITY * limits.angular_velocity / max(third, 1e-9)) ** (2 / 3)
        caps[ends] = min(rate, (GRAVITY * turning / max(fourth, 1e-9)) ** 0.5)
    return caps


def _guessed_h(path: Path, grid: NDArray, limits: PlanLimits, speed: float) -> float:
    """Return h of the min-snap timing at that speed, or less where it would break the speed limit."""
    fastest = float(np.linalg.norm(path(grid, 1), axis=1).max())
    return min(speed, speed * limits.speed / max(fastest, 1e-9)) ** 2


def _guess(path: Path, grid: NDArray, airframe: Airframe, angles: NDArray, h: float) -> NDArray:
    """Return (N+1, 16): the min-snap timing h = const, its attitude, and rates by inverting Eq. 23."""
    step = grid[1] - grid[0]
    force = h * path(grid, 2) + np.array([0.0, 0.0, GRAVITY])
    specific = np.linalg.norm(force, axis=1)
    axis = force / specific[:, None]
    q = np.stack(hopf_quaternion((axis[:, 0], axis[:, 1], axis[:, 2]), np.cos(angles / 2), np.sin(angles / 2)), axis=1)
    before, after = q[:-1].T, q[1:].T
    turn = np.stack(product((-before[0], -before[1], -before[2], before[3]), after), axis=1)
    omega = np.zeros((len(grid), 3))
    omega[:-1] = 2 * turn[:, :3] / (step * turn[:, 3:])
    omega[-1] = omega[-2]
    alpha = np.zeros_like(omega)
    alpha[:-1] = np.diff(omega, axis=0) / step
    inertia = np.array(airframe.inertia)
    torque = h * (inertia * alpha + np.cross(omega, inertia * omega))
    wrench = np.concatenate([airframe.mass * specific[:, None], torque], axis=1)
    thrusts = np.linalg.solve(airframe.mixing, wrench.T).T / airframe.hover_thrust
    return np.concatenate([np.full((len(grid), 1), h), np.zeros((len(grid), 1)), q, omega, alpha, thrusts], axis=1)
