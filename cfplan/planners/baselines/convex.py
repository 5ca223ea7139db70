"""Convex time-optimal path parameterisation (TOPP): a proven lower bound on the time of flight, and a planner.

With speed, acceleration and collective thrust as the only limits, and no attitude, the problem is convex in
b = (ds/dt)² by arc length and is solved by reachability analysis (copp-py). The outer approximation relaxes every
limit, so its time is a lower bound; the inner approximation tightens them, and its profile is smoothed to be flyable.
The problem ignores motors and body rates: where the acceleration jumps the profile exceeds their limits, and repair
slows it down.
"""

import time
from dataclasses import replace
from typing import Any

import copp_py
import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InfeasibleError
from cfplan.planners.baselines.convex_profile import smooth_profile
from cfplan.planners.baselines.convex_rows import Rows, inner_rows, outer_rows
from cfplan.planners.baselines.convex_stations import Stations, stations
from cfplan.planners.baselines.selection import select_fastest
from cfplan.planners.solution import Solution, Status
from cfplan.planners.task import PlanningTask
from cfplan.safety.feasibility import smoothing_half_width
from cfplan.safety.limits import PlanLimits
from cfplan.safety.speed_caps import allowed_speed
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.yaw_spline import YawSpline

# Between stations, m and rad: the bound's discretisation error falls with both, to 0.3 % of time at 2 m/s
BOUND_SPACING, BOUND_TURN = 0.005, 0.004
PLAN_SPACING, PLAN_TURN = 0.03, 0.03  # coarser: the planner's profile is certified, not proven
# Of the window width at which a jump of acceleration uses up a limit; wider windows round off tight corners too much
WINDOW_FRACTIONS = (0.25, 0.5, 1.0)
BOUNDARY_SLACK = 1.01  # factor on b in a boundary state: a state that keeps a limit may lie outside the inner polygon
Boundary = tuple[float | None, float | None]  # m²/s² at the start and the end of the path, None where it is free


def lower_bound(task: PlanningTask) -> float:
    """Return a lower bound, s, on the time of a motion within the limits of speed, acceleration and collective thrust.

    The bound is proven: a feasible motion sampled at the stations meets every row (`outer_rows`), so at each station it
    is no faster than the reachable set's top; between two stations it cannot exceed what full acceleration from both
    gives. Curvature and slope are bounded over each interval by their extremes at its samples, not by interval
    arithmetic.

    Raises:
        InfeasibleError: not even these limits can be met.
    """
    at = stations(task.path, spacing=BOUND_SPACING, turn=BOUND_TURN)
    top = _outer_top(at, task.airframe, task.limits, _boundary(task))
    return float(np.sum(_least_times(at, top, task.limits)))


def _outer_top(at: Stations, airframe: Airframe, limits: PlanLimits, boundary: Boundary) -> NDArray:
    """Return (M,) m²/s², an upper bound on b at the stations.

    The second pass bounds drag by the speeds that the first allows.
    """
    fastest = np.full(len(at.length), limits.speed)
    top = _reachable_top(at, outer_rows(at, airframe, limits, fastest), boundary)
    return _reachable_top(at, outer_rows(at, airframe, limits, _fastest(at, top, limits)), boundary)


def _fastest(at: Stations, top: NDArray, limits: PlanLimits) -> NDArray:
    """Return (M,) m/s, an upper bound on speed in the two intervals beside each station."""
    spacing = np.diff(at.length)
    inside = np.maximum(top[:-1], top[1:]) + 2 * limits.acceleration * spacing
    around = np.maximum(np.append(inside, inside[-1]), np.insert(inside, 0, inside[0]))
    return np.minimum(np.sqrt(around), limits.speed)


def plan_convex(task: PlanningTask) -> Solution:
    """Solve the inner approximation and smooth it. Of a boundary state only h is met, and only approximately."""
    begun = time.perf_counter()
    airframe, limits, boundary = task.airframe, task.limits, _boundary(task)
    at = stations(task.path, spacing=PLAN_SPACING, turn=PLAN_TURN)
    fastest = np.full(len(at.length), limits.speed)
    rows = inner_rows(at, airframe, limits, fastest)
    rows = replace(rows, ceiling=np.minimum(rows.ceiling, allowed_speed(limits.speed, task.speed_caps, at.s) ** 2))
    try:
        speeds = solve_rows(at, rows, boundary)
    except InfeasibleError as error:
        return Solution(Status.INFEASIBLE, None, str(error))
    along = YawSpline.along(task.path, task.nodes, task.yaw, task.yaw_angle)
    width = smoothing_half_width(airframe, limits)
    profiles = (
        smooth_profile(task.path, at, speeds, fraction * width, task.nodes, along) for fraction in WINDOW_FRACTIONS
    )
    profile = select_fastest(task, (profile for profile in profiles if profile is not None))
    stats: dict[str, float | int | str] = {
        "solver": "copp-py",
        "solve_seconds": time.perf_counter() - begun,
        "point_mass_time": float(np.sum(2 * np.diff(at.length) / (np.sqrt(speeds[1:]) + np.sqrt(speeds[:-1])))),
    }
    if profile is None:
        return Solution(Status.NOT_CONVERGED, None, "no smoothing of the solution stays above h = 0", stats)
    return Solution(Status.SOLVED, profile, stats=stats)


def _boundary(task: PlanningTask) -> Boundary:
    """Return b at the path's ends: 0 at a rest end, None where it is free."""
    values = []
    for s, state in ((0.0, task.start), (task.path.end, None)):
        square = float(np.sum(task.path(np.array([s]), 1) ** 2))
        values.append(0.0 if square == 0.0 else None if state is None else state.h * square)
    return values[0], values[1]


def _problem(at: Stations, rows: Rows, boundary: Boundary) -> Any:
    ceiling, most, ends = rows.ceiling.copy(), rows.most.copy(), []
    for index, beside, value in ((0, 1, boundary[0]), (-1, -2, boundary[1])):
        if value is None:  # free: let b jump in the interval at that end, which only relaxes the problem
            most[[index, beside]] = 1e6
            value = ceiling[index]
        elif value > ceiling[index] * BOUNDARY_SLACK:
            raise InfeasibleError(
                f"a boundary state of {value**0.5:.3f} m/s is faster than the limits allow there, "
                f"{ceiling[index] ** 0.5:.3f} m/s",
                where="start of the path",
                hint="start slower, or loosen the limits",
            )
        ceiling[index] = max(value, 1e-9)  # the library requires a positive value
        ends.append(float(value))
    constraints = copp_py.constraints.Constraints(3, capacity=len(at.length))
    constraints.append_s(at.length)
    constraints.add_constraint_1st(ceiling[:, None], 0)
    constraints.add_constraint_2nd(rows.first, rows.second, most, 0)
    reachability: Any = copp_py.solver.topp2_ra  # its stub forgets to export Problem
    return reachability.Problem(constraints, idx_s_interval=(0, len(at.length) - 1), a_boundary=(ends[0], ends[1]))


def _reachable_top(at: Stations, rows: Rows, boundary: Boundary) -> NDArray:
    try:
        return copp_py.solver.reach_set2.bidirectional(_problem(at, rows, boundary)).a_max
    except copp_py.core.CoppError as error:
        raise InfeasibleError(
            "no motion along the path meets the limits of speed, acceleration and collective thrust",
            hint="loosen the limits or start slower",
        ) from error


def solve_rows(at: Stations, rows: Rows, boundary: Boundary) -> NDArray:
    try:
        return copp_py.solver.topp2_ra.solve(_problem(at, rows, boundary))
    except copp_py.core.CoppError as error:
        raise InfeasibleError(
            f"the convex problem has no solution: {error}",
            where="the whole path",
            hint="loosen the limits, or start slower",
        ) from error


def _least_times(at: Stations, top: NDArray, limits: PlanLimits) -> NDArray:
    """Return (M-1,) s, the least time of each interval with b at most `top` at its ends and |b'| at most 2 a_max."""
    spacing = np.diff(at.length)
    left, right = top[:-1], top[1:]
    gain = 2 * limits.acceleration
    meet = np.clip(0.5 * ((right - left) / gain + spacing), 0.0, spacing)
    with np.errstate(divide="ignore"):
        low = np.maximum(at.curvature_low[:-1], at.curvature_low[1:])
        # low bounds curvature over both intervals beside a station, so either one bounds it over this one
        cap = np.minimum(limits.speed**2, np.where(low > 0, limits.acceleration / low, np.inf))
    return _rush(left, meet, gain, cap) + _rush(right, spacing - meet, gain, cap)


def _rush(b: NDArray, distance: NDArray, gain: float, cap: NDArray) -> NDArray:
    """Return the time, s, to cover a distance when b grows by `gain` a metre until it reaches `cap`."""
    cap = np.maximum(cap, b)
    rising = np.minimum(distance, (cap - b) / gain)
    peak = np.sqrt(b + gain * rising)
    return 2 * (peak - np.sqrt(b)) / gain + (distance - rising) / np.maximum(np.sqrt(cap), 1e-9)
