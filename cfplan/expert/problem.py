"""The numbers of one problem: path and limits into parameters and bounds, and a solution back into a profile."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cfplan.expert import stage
from cfplan.expert.between import SPEED, Excess, spread
from cfplan.expert.guess import guess_spline
from cfplan.expert.program import Layout
from cfplan.expert.spline_profile import spline_profile
from cfplan.expert.yaw_track import YawTrack
from cfplan.geometry.path import Path
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.profile import BoundaryState, SpeedProfile

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


def rests(path: Path, s: float) -> bool:
    """Whether the path stands still there, whatever h is."""
    return bool(np.linalg.norm(path(s, 1)) < REST)


def pose(
    layout: Layout,
    path: Path,
    airframe: Airframe,
    limits: PlanLimits,
    track: YawTrack,
    yaw_angle: float,
    ends: Ends,
    penalties: stage.Penalties,
    table: NDArray | None = None,
) -> Problem:
    """The problem of a path. Where yaw is free its first value lies from `yaw_angle` to a quarter turn more.

    `table`, (N+3, 1 or 2), is from where to search, else a guess; it must agree with the boundary states.
    """
    nodes = layout.shape.nodes
    step, unit = path.end / nodes, limits.speed**2
    p = _parameters(layout, path, airframe, limits, track, penalties, unit, step)
    margin = MARGIN * (1.0 - held_by(ends, nodes))
    if ends.joint is not None:
        margin[ends.joint - AROUND_JOINT : ends.joint + AROUND_JOINT] = JOINT_MARGIN
    lbx, ubx = _variable_bounds(layout, path, limits, unit, step, margin)
    lbg, ubg = _constraint_bounds(layout, path, limits, unit, step, margin, ends)
    if table is None:
        table = _guess(layout, path, airframe, limits, yaw_angle, ends, unit, step)
    if layout.shape.free_yaw:
        lbx[3], ubx[3] = yaw_angle, yaw_angle + math.pi / 2
    at_rest = (rests(path, 0.0), rests(path, path.end))
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


def profile_of(table: NDArray, unit: float, track: YawTrack, end: float) -> SpeedProfile:
    """The profile of these splines, and of the track where yaw is not among them."""
    if table.shape[1] == 2:
        quadratic, step = table[:-1, 1], end / (len(table) - 3)
        track = YawTrack(
            (quadratic[:-1] + quadratic[1:]) / 2, np.diff(quadratic) / step, np.diff(quadratic, 2) / step**2
        )
    return spline_profile(table[:, 0] * unit, end, track)


def _parameters(
    layout: Layout,
    path: Path,
    airframe: Airframe,
    limits: PlanLimits,
    track: YawTrack,
    penalties: stage.Penalties,
    unit: float,
    step: float,
) -> NDArray:
    data = np.zeros((len(layout.interval), stage.POINT_DATA))
    s = (layout.interval + layout.place) * step
    data[:, :12] = (path.derivatives(s)[1:] * step ** np.arange(1, 5)[:, None, None]).reshape(12, -1).T
    data[:, 12], data[:, 13] = layout.place, layout.weight
    psi, psi_ds, psi_dds = track.at(layout.interval, layout.place, step)
    data[:, 14], data[:, 15], data[:, 16] = psi, psi_ds * step, psi_dds * step**2
    common = stage.common_data(airframe, limits, unit / step**2)
    return np.concatenate([data.ravel(), common, penalties.weights()])


def held_by(ends: Ends, nodes: int) -> NDArray:
    """(N,) 1 next to a boundary state, 0 from FADE intervals on.

    A state may lie at a limit, and what follows is all but decided: there is no room to lower limits there.
    """
    free = np.ones(nodes)
    distance = np.arange(nodes) + 0.5
    if ends.start and not ends.continues:
        free = np.minimum(free, (distance - 1.5) / FADE)
    if ends.end:
        free = np.minimum(free, (nodes - distance - 1.5) / FADE)
    return 1.0 - np.clip(free, 0.0, 1.0)


def _highest(path: Path, limits: PlanLimits, s: NDArray, margin: NDArray, unit: float) -> NDArray:
    """x where the speed limit is reached."""
    nominal = np.maximum(np.linalg.norm(path(s, 1), axis=-1), REST)
    return np.minimum(((1 - margin) * limits.speed / nominal) ** 2 / unit, CEILING)


def _variable_bounds(
    layout: Layout, path: Path, limits: PlanLimits, unit: float, step: float, margin: NDArray
) -> tuple[NDArray, NDArray]:
    nodes = layout.shape.nodes
    first = np.arange(nodes + 1) * layout.block
    lbx, ubx = np.full(layout.variables, -np.inf), np.full(layout.variables, np.inf)
    lbx[first] = FLOOR
    ubx[first] = _highest(path, limits, np.arange(nodes + 1) * step, np.append(margin, margin[-1]), unit)
    return lbx, ubx


def _constraint_bounds(
    layout: Layout, path: Path, limits: PlanLimits, unit: float, step: float, margin: NDArray, ends: Ends
) -> tuple[NDArray, NDArray]:
    lbg, ubg = np.zeros(layout.constraints), np.zeros(layout.constraints)
    row = layout.row
    tighter = 2 * margin[layout.interval[layout.point]]  # most rows are squares
    # What a boundary state alone decides was checked before, and may be at its limit.
    for boundary, point in ((ends.start, 0), (ends.end, len(layout.interval) - 1)):
        if boundary:
            tighter[(layout.point == point) & ~np.isin(row, stage.JUMPING)] = -0.1
    lbg[layout.point_rows] = stage.LOWER[row] + tighter
    ubg[layout.point_rows] = stage.UPPER[row] - tighter
    s = (np.arange(layout.shape.nodes)[:, None] + np.array(layout.shape.speed_places)) * step
    lbg[layout.speed_rows] = FLOOR
    ubg[layout.speed_rows] = _highest(path, limits, s, margin[:, None], unit)
    return lbg, ubg


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
