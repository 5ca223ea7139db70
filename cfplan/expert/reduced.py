"""The expert: the fastest profile that keeps every limit, by the reduced formulation.

State (h, h', h'', ψ, ψ') and control (h''', ψ''), constant in each interval, so the dynamics are linear and exact
and everything physical follows point by point through the flatness map (DESIGN section 4). Minimised is the time of
flight, by Gauss quadrature, with small penalties on angular acceleration, yaw rate and roughness. Limits hold at both
ends of every interval, where the controls jump, and at points inside, a trifle tighter than asked, so that they hold
between the points as well.

Where the path rests (γ' = γ'' = γ''' = 0) h has no bearing on motion and hardly any on its first derivatives: left
alone, an optimiser lets it run away or stop short. There h stays constant over the first, or last, interval.
"""

import math
import time
from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError
from cfplan.expert import stage
from cfplan.expert.compiled import Backend, backend
from cfplan.expert.guess import guess_profile
from cfplan.expert.program import Layout, Shape, fatrop_solver, ipopt_solver, program
from cfplan.expert.solution import Solution, Status
from cfplan.expert.yaw_track import YawTrack, fixed_yaw, tangent_yaw
from cfplan.geometry.path import Path
from cfplan.geometry.yaw import YawMode
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.flatness import flat_state
from cfplan.vehicle.profile import BoundaryState, SpeedProfile

MARGIN = 1e-3
# share by which limits are tightened, for what happens between points
LEAST_NODES = 12
NODES_PER_PIECE = 3
CEILING = 20.0
# h at most, where the path nearly stands still, in squares of the speed limit
FLOOR = 1e-4
# h at least, likewise
RESIDUAL = 1e-5
# how exactly a solution must follow the dynamics, relative
HARDLY = 1e-3
# by how much a boundary state may exceed a limit: noise of whoever made it


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
    penalties: stage.Penalties | None = None,
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
    _check_arguments(path, nodes, yaw_angle, start, end)
    began = time.perf_counter()
    if reason := _unsolvable(airframe, limits):
        return Solution(Status.INFEASIBLE, None, reason)
    for name, boundary, s in (("start", start, 0.0), ("end", end, path.end)):
        if boundary and (reason := _broken_by(boundary, path, s, airframe, limits)):
            return Solution(Status.BAD_BOUNDARY, None, f"{name}: {reason}")

    shape = Shape(nodes, free_yaw=yaw is YawMode.FREE)
    track = {YawMode.FIXED: fixed_yaw, YawMode.TANGENT: tangent_yaw, YawMode.FREE: fixed_yaw}[yaw](
        path, nodes, yaw_angle, start, end
    )
    problem = _pose(path, airframe, limits, shape, track, yaw_angle, start, end, penalties or stage.Penalties(), chosen)
    built = time.perf_counter()
    stats: dict[str, float | int | str] = {"backend": str(chosen or backend())}
    failures = []
    for name, solver in (("fatrop", fatrop_solver), ("ipopt", ipopt_solver)):
        x, said = _run(solver(shape, chosen), problem)
        stats |= {"solver": name, "iterations": said["iterations"], "solve_seconds": time.perf_counter() - built}
        if not said["success"]:
            failures.append(f"{name}: {said['status']}")
            continue
        profile = _profile(x, problem, track, path.end)
        if flaw := _flaw(profile):
            failures.append(f"{name}: {flaw}")
            continue
        stats["total_seconds"] = time.perf_counter() - began
        return Solution(Status.SOLVED, profile, "", stats)
    return Solution(Status.NOT_CONVERGED, None, "; ".join(failures), stats)


@dataclass(frozen=True, slots=True)
class _Problem:
    """Numbers of one problem, as the solvers take them."""

    layout: Layout
    unit: float
    # h of x = 1
    step: float
    x0: NDArray
    p: NDArray
    lbx: NDArray
    ubx: NDArray
    lbg: NDArray
    ubg: NDArray


def _pose(
    path: Path,
    airframe: Airframe,
    limits: PlanLimits,
    shape: Shape,
    track: YawTrack,
    yaw_angle: float,
    start: BoundaryState | None,
    end: BoundaryState | None,
    penalties: stage.Penalties,
    chosen: Backend | None,
) -> _Problem:
    layout = program(shape, chosen).layout
    nodes, block, states = shape.nodes, layout.block, layout.states
    step = path.end / nodes
    unit = limits.speed**2
    first = np.arange(nodes + 1) * block  # of each node's variables
    control = first[:-1] + states

    data = np.zeros((len(layout.interval), stage.POINT_DATA))
    s = (layout.interval + layout.place) * step
    for order in (1, 2, 3, 4):
        data[:, 3 * order - 3 : 3 * order] = path(s, order) * step**order
    data[:, 12], data[:, 13] = layout.place, layout.weight
    psi, psi_ds, psi_dds = track.at(layout.interval, layout.place, step)
    data[:, 14], data[:, 15], data[:, 16] = psi, psi_ds * step, psi_dds * step**2
    p = np.concatenate([
        data.ravel(), stage.common_data(airframe, limits, unit / step**2), astuple(penalties)
    ])  # fmt: skip

    # Tightening fades out towards a boundary state, which may lie at a limit.
    place = np.arange(nodes) + 0.5
    fade = np.ones(nodes)
    if start:
        fade = np.minimum(fade, np.clip(place / 5 - 0.3, 0, 1))
    if end:
        fade = np.minimum(fade, np.clip((nodes - place) / 5 - 0.3, 0, 1))
    margin = MARGIN * fade

    def highest(at: NDArray, tighter: NDArray) -> NDArray:
        speed = np.maximum(np.linalg.norm(path(at, 1), axis=-1), 1e-9)
        return np.minimum(((1 - tighter) * limits.speed / speed) ** 2 / unit, CEILING)

    lbx, ubx = np.full(layout.variables, -np.inf), np.full(layout.variables, np.inf)
    lbx[first] = FLOOR
    ubx[first] = highest(np.arange(nodes + 1) * step, np.append(margin, margin[-1]))
    lbg, ubg = np.zeros(layout.constraints), np.zeros(layout.constraints)
    row = layout.selected % stage.ROWS
    tighter = 2 * margin[layout.interval[layout.selected // stage.ROWS]]
    lbg[layout.point_rows] = stage.LOWER[row] * (1 + np.sign(stage.LOWER[row]) * np.where(row < 4, tighter, tighter))
    lbg[layout.point_rows] = np.where(
        row == stage.SPECIFIC_THRUST, 1 + tighter, np.where(row > stage.SPECIFIC_THRUST, -1 + tighter, -np.inf)
    )
    ubg[layout.point_rows] = np.where(row == stage.SPECIFIC_THRUST, np.inf, 1 - tighter)
    places = np.array(shape.speed_places)
    lbg[layout.speed_rows] = FLOOR
    ubg[layout.speed_rows] = highest((np.arange(nodes)[:, None] + places) * step, margin[:, None])

    spline = guess_profile(path, airframe, limits, nodes, CEILING * unit) / unit
    x0 = np.zeros(layout.variables)
    x0[first] = (spline[:-2] + 4 * spline[1:-1] + spline[2:]) / 6
    x0[first + 1] = (spline[2:] - spline[:-2]) / 2
    x0[first + 2] = np.diff(spline, 2)
    x0[control] = np.diff(spline, 3)
    if shape.free_yaw:
        x0[first + 3] = start.yaw if start else yaw_angle + math.pi / 4
        lbx[3], ubx[3] = yaw_angle, yaw_angle + math.pi / 2

    def hold(variable: int, value: float) -> None:
        lbx[variable] = ubx[variable] = x0[variable] = value

    scale = unit / step ** np.arange(3)
    for boundary, node, interval in ((start, 0, 0), (end, nodes, nodes - 1)):
        at = node * block
        if boundary:
            for k, value in enumerate(np.array([boundary.h, boundary.dh, boundary.ddh]) / scale):
                hold(at + k, float(value))
            if shape.free_yaw:
                hold(at + 3, boundary.yaw)
                hold(at + 4, boundary.dyaw * step)
        elif rests(path, node * step):
            at = interval * block
            for k in (1, 2, states):
                hold(at + k, 0.0)
            if shape.free_yaw:
                hold(node * block + 4, 0.0)
    return _Problem(layout, unit, step, x0, p, lbx, ubx, lbg, ubg)


def rests(path: Path, s: float) -> bool:
    """Whether the path stands still there, whatever h is."""
    return bool(np.linalg.norm(path(s, 1)) < 1e-9)


def _run(solver, problem: _Problem) -> tuple[NDArray, dict]:
    try:
        result = solver(x0=problem.x0, p=problem.p, lbx=problem.lbx, ubx=problem.ubx, lbg=problem.lbg, ubg=problem.ubg)
        said = solver.stats()
    except RuntimeError as error:
        return problem.x0, {"success": False, "status": str(error).splitlines()[0], "iterations": 0}
    return np.array(result["x"]).ravel(), {
        "success": bool(said["success"]),
        "status": f"ended with {said['return_status']} after {said['iter_count']} iterations",
        "iterations": int(said["iter_count"]),
    }


def _profile(x: NDArray, problem: _Problem, track: YawTrack, end: float) -> SpeedProfile:
    layout, step, unit = problem.layout, problem.step, problem.unit
    nodes, block, states = layout.shape.nodes, layout.block, layout.states
    table = np.append(x, np.zeros(layout.controls)).reshape(nodes + 1, block)
    free = layout.shape.free_yaw
    return SpeedProfile(
        s=np.linspace(0.0, end, nodes + 1),
        h=table[:, 0] * unit,
        dh=table[:, 1] * unit / step,
        ddh=table[:, 2] * unit / step**2,
        dddh=table[:-1, states] * unit / step**3,
        yaw=table[:, 3] if free else track.yaw,
        dyaw=table[:, 4] / step if free else track.dyaw,
        ddyaw=table[:-1, states + 1] / step**2 if free else track.ddyaw,
    )


def _flaw(profile: SpeedProfile) -> str:
    """What is wrong with a profile that a solver calls solved; empty where nothing is."""
    if not all(np.isfinite(values).all() for values in astuple(profile)):
        return "the solution is not finite"
    nodes = np.arange(len(profile.s) - 1)
    inside = profile.s[:-1, None] + np.diff(profile.s)[:, None] * np.linspace(0, 1, 9)
    if (profile.at(inside, nodes[:, None].repeat(9, axis=1)).h <= 0).any():
        return "h falls to zero between nodes"
    right = profile.at(profile.s[1:], nodes)
    step = profile.s[1]
    for name, power in (("h", 0), ("dh", 1), ("ddh", 2)):
        error = np.abs(getattr(right, name) - getattr(profile, name)[1:]) * step**power
        if (error > RESIDUAL * profile.h.max()).any():
            return f"{name} jumps by {error.max():.2g} at a node"
    return ""


def _check_arguments(
    path: Path, nodes: int, yaw_angle: float, start: BoundaryState | None, end: BoundaryState | None
) -> None:
    if not math.isfinite(yaw_angle):
        raise InputError(f"the yaw angle must be a finite number, not {yaw_angle}")
    for name, boundary in (("start", start), ("end", end)):
        if boundary and not all(math.isfinite(value) for value in astuple(boundary)):
            raise InputError(f"the {name} state is not finite")
    pieces = len(path.breaks) - 1
    least = max(LEAST_NODES, NODES_PER_PIECE * pieces)
    if nodes < least:
        raise InputError(
            f"{nodes} nodes are too few for a path of {pieces} pieces", hint=f"take at least {least}; 100 is usual"
        )


def _unsolvable(airframe: Airframe, limits: PlanLimits) -> str:
    """Which limit excludes every flight, because it excludes hovering; empty where none does."""
    for name, value in zip(PlanLimits.__slots__, astuple(limits), strict=True):
        if not math.isfinite(value) or value < 0 or (value == 0 and name != "motor_thrust_min"):
            return f"the limit {name} is {value}"
    hover = airframe.hover_thrust
    if hover >= limits.motor_thrust_max:
        return f"hovering takes {hover:.3g} N a motor, motor_thrust_max allows {limits.motor_thrust_max:.3g} N"
    if hover <= limits.motor_thrust_min:
        return f"hovering takes {hover:.3g} N a motor, motor_thrust_min asks for {limits.motor_thrust_min:.3g} N"
    if limits.specific_thrust_min >= GRAVITY:
        return f"hovering gives {GRAVITY} m/s², specific_thrust_min asks for {limits.specific_thrust_min:.3g} m/s²"
    return ""


def _broken_by(boundary: BoundaryState, path: Path, s: float, airframe: Airframe, limits: PlanLimits) -> str:
    """Which limit a boundary state breaks; empty where it breaks none."""
    if boundary.h <= 0:
        return f"h must be positive, not {boundary.h:g}"
    derivatives = tuple(tuple(float(v) for v in path(s, order)) for order in (1, 2, 3, 4))
    flat = flat_state(
        airframe, derivatives, (boundary.h, boundary.dh, boundary.ddh, 0.0),  # type: ignore[arg-type]
        (boundary.yaw, boundary.dyaw, 0.0), math.cos, math.sin,
    )  # fmt: skip
    checks = (
        ("speed", math.hypot(*flat.velocity), limits.speed, "m/s"),
        ("acceleration", math.hypot(*flat.acceleration), limits.acceleration, "m/s²"),
        ("angular velocity", math.hypot(*flat.body_rate), limits.angular_velocity, "rad/s"),
        ("tilt", math.acos(max(-1.0, min(1.0, flat.thrust_axis[2]))), limits.tilt, "rad"),
    )
    for name, value, limit, unit in checks:
        if not value <= limit * (1 + HARDLY):
            return f"{name} is {value:.3g} {unit}, the limit {limit:.3g} {unit}"
    if not flat.specific_thrust >= limits.specific_thrust_min * (1 - HARDLY):
        return f"specific thrust is {flat.specific_thrust:.3g} m/s², the least {limits.specific_thrust_min:.3g} m/s²"
    return ""
