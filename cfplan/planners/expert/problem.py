"""The numbers of one problem: path and limits into parameters and bounds, and a solution back into a profile."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cfplan.geometry.path import Path
from cfplan.machine_code import njit
from cfplan.planners.expert import point_constraints
from cfplan.planners.expert.initial_guess import guess_spline
from cfplan.planners.expert.intersample import Excess, spread
from cfplan.planners.expert.program import Layout
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.measures import SPEED
from cfplan.vehicle.profile import BoundaryState, SpeedProfile
from cfplan.vehicle.profile_spline import spline_profile
from cfplan.vehicle.yaw_spline import YawSpline

MARGIN = 1e-3
# share by which limits are tightened, for what happens between points
FADE = 5
# intervals over which that margin grows from nothing, next to a boundary state that may lie at a limit
JOINT_MARGIN, AROUND_JOINT = 0.01, 6
# by how much limits are tightened around a joint, and over how many intervals on each side, so that the search which
# goes on from there is not cornered
LEAD = 3.0
# intervals over which the guess comes away from a boundary state
HASTE = 1.5
# times an excess between points, by which the limits around it are lowered: lower points lower the peak by less
CEILING = 20.0
# h at most, where the path nearly stands still, in squares of the speed limit
FLOOR = 1e-4
# h at least, likewise
REST = 1e-9
# |γ'| below which a path stands still
_JUMPS = np.isin(np.arange(point_constraints.ROWS), point_constraints.JUMPING)


@dataclass(frozen=True, slots=True)
class Ends:
    """Boundary states, None where the end is free."""

    start: BoundaryState | None
    end: BoundaryState | None
    continues: bool = False
    # whether the start is a joint, crossed by another problem's solution with room to spare
    joint: int | None = None
    # the interval before which this problem's solution will be cut, for another to go on from there


@dataclass(frozen=True, slots=True)
class Problem:
    """As the solvers take it; see Layout for the order of variables and constraints."""

    layout: Layout
    unit: float
    # h where x is 1
    step: float
    # of s, an interval
    p: NDArray
    lbx: NDArray
    ubx: NDArray
    lbg: NDArray
    ubg: NDArray
    ends: Ends
    rests: tuple[bool, bool]
    # whether the path stands still at its start and end
    table: NDArray
    # (N+3, 1 or 2) spline coefficients of x, and of yaw where it is free, from which to search


def pose(
    layout: Layout,
    path: Path,
    airframe: Airframe,
    limits: PlanLimits,
    track: YawSpline,
    yaw_angle: float,
    ends: Ends,
    penalties: point_constraints.Penalties,
    table: NDArray | None = None,
) -> Problem:
    """The problem of a path. Where yaw is free its first value lies from `yaw_angle` to a quarter turn more.

    `table`, (N+3, 1 or 2), is from where to search, else a guess; it must agree with the boundary states.
    """
    nodes = layout.shape.nodes
    step, unit = path.end / nodes, limits.speed**2
    common = point_constraints.common_data(airframe, limits, unit / step**2)
    p = _parameters(
        path.derivatives(layout.s * step), layout.interval, layout.place, layout.weight, track.yaw, track.dyaw,
        track.ddyaw, step, np.concatenate([common, penalties.weights()]),
    )  # fmt: skip
    margin = MARGIN * (1.0 - held_by(ends, nodes))
    if ends.joint is not None:
        margin[ends.joint - AROUND_JOINT : ends.joint + AROUND_JOINT] = JOINT_MARGIN
    velocity = path(layout.speed_s * step, 1)
    # What a boundary state alone decides was checked before, and may be at its limit.
    decided = (0 if ends.start else -1, len(layout.interval) - 1 if ends.end else -1)
    lbx, ubx, lbg, ubg = _bounds(
        velocity, margin, limits.speed, unit, layout.block, layout.variables, layout.constraints, layout.interval,
        layout.row, layout.point, layout.point_rows, layout.speed_rows, decided, _JUMPS,
        point_constraints.LOWER, point_constraints.UPPER,
    )  # fmt: skip
    if table is None:
        table = _guess(layout, path, airframe, limits, yaw_angle, ends, unit, step)
    if layout.shape.free_yaw:
        lbx[3], ubx[3] = yaw_angle, yaw_angle + math.pi / 2
    at_rest = (math.hypot(*velocity[0]) < REST, math.hypot(*velocity[nodes]) < REST)
    for variable, value in _held(layout, at_rest, ends, unit, step):
        lbx[variable] = ubx[variable] = value
    return Problem(layout, unit, step, p, lbx, ubx, lbg, ubg, ends, at_rest, table)


def tightened(problem: Problem, excess: Excess, at_points: NDArray) -> Problem:
    """The problem with limits lowered, in each interval that exceeds one between the points, by what it exceeds.

    `at_points` is what the rows came to, as layout.selected has them: a peak far from every point lowers the limits
    from there.
    """
    layout = problem.layout
    upper, lower = HASTE * spread(excess.upper), HASTE * spread(excess.lower)
    lbg, ubg, ubx = problem.lbg.copy(), problem.ubg.copy(), problem.ubx.copy()
    row, interval = layout.row, layout.interval[layout.point]
    least = np.full(excess.upper.shape, np.inf)
    most = -least
    np.minimum.at(least, (interval, row), at_points)
    np.maximum.at(most, (interval, row), at_points)
    below = np.where(excess.upper > 0, most, np.inf)[interval, row]
    above = np.where(excess.lower > 0, least, -np.inf)[interval, row]
    ubg[layout.point_rows] = np.minimum(ubg[layout.point_rows], below) - np.maximum(upper[interval, row], 0.0)
    lbg[layout.point_rows] = np.maximum(lbg[layout.point_rows], above) + np.maximum(lower[interval, row], 0.0)
    slower = 1.0 - np.maximum(upper[:, SPEED], 0.0)
    ubg[layout.speed_rows] *= slower[:, None]
    first = np.arange(layout.shape.nodes + 1) * layout.block
    free = problem.lbx[first] < ubx[first]
    around = np.minimum(np.append(slower, 1.0), np.append(1.0, slower))
    ubx[first] *= np.where(free, around, 1.0)
    return replace(problem, lbg=lbg, ubg=ubg, ubx=ubx)


def table_of(x: NDArray, layout: Layout) -> NDArray:
    """(N+3, 1 or 2) the spline coefficients that a solver's variables imply."""
    rows = np.append(x, np.zeros(layout.controls)).reshape(layout.shape.nodes + 1, layout.block)
    inner = rows[:, 0] - rows[:, 2] / 6
    cubic = np.concatenate([[inner[1] - 2 * rows[0, 1]], inner, [inner[-2] + 2 * rows[-1, 1]]])
    if not layout.shape.free_yaw:
        return cubic[:, None]
    half = rows[:, 4] / 2
    return np.stack([cubic, np.concatenate([rows[:, 3] - half, [rows[-1, 3] + half[-1], 0.0]])], axis=1)


def variables_of(table: NDArray, layout: Layout) -> NDArray:
    """A solver's variables that follow these splines, so that the dynamics hold."""
    first = np.arange(layout.shape.nodes + 1) * layout.block
    x = np.zeros(layout.variables)
    cubic = table[:, 0]
    x[first] = (cubic[:-2] + 4 * cubic[1:-1] + cubic[2:]) / 6
    x[first + 1] = (cubic[2:] - cubic[:-2]) / 2
    x[first + 2] = np.diff(cubic, 2)
    x[first[:-1] + layout.states] = np.diff(cubic, 3)
    if layout.shape.free_yaw:
        quadratic = table[:-1, 1]
        x[first + 3], x[first + 4] = (quadratic[:-1] + quadratic[1:]) / 2, np.diff(quadratic)
        x[first[:-1] + layout.states + 1] = np.diff(quadratic, 2)
    return x


def profile_of(table: NDArray, unit: float, track: YawSpline, end: float) -> SpeedProfile:
    """The profile of these splines, and of the track where yaw is not among them."""
    if table.shape[1] == 2:
        quadratic, step = table[:-1, 1], end / (len(table) - 3)
        track = YawSpline(
            (quadratic[:-1] + quadratic[1:]) / 2, np.diff(quadratic) / step, np.diff(quadratic, 2) / step**2
        )
    return spline_profile(table[:, 0] * unit, end, track)


@njit(error_model="numpy")
def _parameters(
    curve: NDArray, interval: NDArray, place: NDArray, weight: NDArray, yaw: NDArray, dyaw: NDArray, ddyaw: NDArray,
    step: float, behind: NDArray,
) -> NDArray:  # fmt: skip
    """The point data, in node units, of points where the path has the derivatives `curve`; and what is put behind."""
    p = np.empty(len(place) * point_constraints.POINT_DATA + len(behind))
    for n in range(len(place)):
        k, data = interval[n], p[n * point_constraints.POINT_DATA : (n + 1) * point_constraints.POINT_DATA]
        unit = 1.0
        for order in range(4):
            unit *= step
            for axis in range(3):
                data[3 * order + axis] = curve[order + 1, axis, n] * unit
        data[12], data[13] = place[n], weight[n]
        x = place[n] * step
        data[14] = yaw[k] + x * (dyaw[k] + x * ddyaw[k] / 2)
        data[15], data[16] = (dyaw[k] + x * ddyaw[k]) * step, ddyaw[k] * step**2
    for n in range(len(behind)):
        p[len(p) - len(behind) + n] = behind[n]
    return p


@njit(error_model="numpy")
def _bounds(
    velocity: NDArray, margin: NDArray, speed: float, unit: float, block: int, variables: int, constraints: int,
    interval: NDArray, row: NDArray, point: NDArray, point_rows: NDArray, speed_rows: NDArray,
    decided: tuple[int, int], jumps: NDArray, lower: NDArray, upper: NDArray,
) -> tuple[NDArray, NDArray, NDArray, NDArray]:  # fmt: skip
    """Of variables, lower and upper, and of constraints. `velocity`, (…, 3), is γ' as layout.speed_s has the places;
    `decided` are points whose rows a boundary state decides, but for those that jump."""
    lbx, ubx = np.full(variables, -np.inf), np.full(variables, np.inf)
    lbg, ubg = np.zeros(constraints), np.zeros(constraints)
    nodes, between = speed_rows.shape
    for n in range(len(velocity)):
        k = min(n, nodes - 1) if n <= nodes else (n - nodes - 1) // between
        nominal = max(math.sqrt(velocity[n, 0] ** 2 + velocity[n, 1] ** 2 + velocity[n, 2] ** 2), REST)
        highest = min(((1 - margin[k]) * speed / nominal) ** 2 / unit, CEILING)
        if n <= nodes:
            lbx[n * block], ubx[n * block] = FLOOR, highest
        else:
            at = speed_rows[k, (n - nodes - 1) % between]
            lbg[at], ubg[at] = FLOOR, highest
    for j in range(len(row)):
        tighter = 2.0 * margin[interval[point[j]]]  # most rows are squares
        if (point[j] == decided[0] or point[j] == decided[1]) and not jumps[row[j]]:
            tighter = -0.1
        lbg[point_rows[j]], ubg[point_rows[j]] = lower[row[j]] + tighter, upper[row[j]] - tighter
    return lbx, ubx, lbg, ubg


def held_by(ends: Ends, nodes: int) -> NDArray:
    """(N,) 1 next to a boundary state, 0 from FADE intervals on.

    A state may lie at a limit, and what follows is all but decided: there is no room to lower limits there.
    """
    if not ends.start and not ends.end:
        return np.zeros(nodes)
    free = np.ones(nodes)
    distance = np.arange(nodes) + 0.5
    if ends.start and not ends.continues:
        free = np.minimum(free, (distance - 1.5) / FADE)
    if ends.end:
        free = np.minimum(free, (nodes - distance - 1.5) / FADE)
    return 1.0 - np.clip(free, 0.0, 1.0)


def _guess(
    layout: Layout,
    path: Path,
    airframe: Airframe,
    limits: PlanLimits,
    yaw_angle: float,
    ends: Ends,
    unit: float,
    step: float,
) -> NDArray:
    """(N+3, 1 or 2) coefficients of the guess, led into boundary states over some intervals."""
    nodes = layout.shape.nodes
    cubic = guess_spline(path, airframe, limits, nodes, CEILING * unit) / unit
    for boundary, coefficients, towards in ((ends.start, cubic, 1.0), (ends.end, cubic[::-1], -1.0)):
        if not boundary:
            continue
        h, slope, bend = boundary.h / unit, towards * boundary.dh * step / unit, boundary.ddh * step**2 / unit
        first = np.array([h - slope + bend / 3, h - bend / 6, h + slope + bend / 3])
        if first[2] > 0:
            weight = np.exp(-np.arange(len(coefficients) - 3) / LEAD)
            coefficients[3:] *= (first[2] / coefficients[3:]) ** weight
        coefficients[:3] = first
    if not layout.shape.free_yaw:
        return cubic[:, None]
    yaw = ends.start.yaw if ends.start else yaw_angle + math.pi / 4
    quadratic = np.linspace(yaw, ends.end.yaw if ends.end else yaw, nodes + 3)
    for boundary, at in ((ends.start, [0, 1]), (ends.end, [nodes, nodes + 1])):
        if boundary:
            quadratic[at] = boundary.yaw + boundary.dyaw * step * np.array([-0.5, 0.5])
    return np.stack([cubic, quadratic], axis=1)


def _held(layout: Layout, at_rest: tuple[bool, bool], ends: Ends, unit: float, step: float) -> list[tuple[int, float]]:
    """Variables that have one value: boundary states, and at rest ends the derivatives of h and the yaw rate."""
    nodes, block, states, free_yaw = layout.shape.nodes, layout.block, layout.states, layout.shape.free_yaw
    held: list[tuple[int, float]] = []
    for boundary, rested, node, interval in ((ends.start, at_rest[0], 0, 0), (ends.end, at_rest[1], nodes, nodes - 1)):
        at = node * block
        if boundary:
            held += [(at, boundary.h / unit), (at + 1, boundary.dh * step / unit)]
            held += [(at + 2, boundary.ddh * step**2 / unit)]
            held += [(at + 3, boundary.yaw), (at + 4, boundary.dyaw * step)] if free_yaw else []
        elif rested:
            held += [(interval * block + k, 0.0) for k in (1, 2, states)]
            held += [(at + 4, 0.0)] if free_yaw else []
    return held
