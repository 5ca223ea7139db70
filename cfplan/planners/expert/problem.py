"""A speed-profile problem: a segment of path, the points at which its limits hold, and how these are lowered.

Its variables are coefficients of splines on the grid: a cubic one of x = h/unit and, where yaw is free, a quadratic one
of yaw (transcription.py). Numbers are in node units: s counted in intervals of the grid.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from cfplan.geometry.path import Path
from cfplan.machine_code import njit
from cfplan.planners.expert import point_constraints
from cfplan.planners.expert.initial_guess import guess
from cfplan.planners.expert.intersample import CONTINUOUS, Violation, spread
from cfplan.planners.expert.tuning import TUNING
from cfplan.planners.task import FREE_START
from cfplan.safety.limits import PlanLimits
from cfplan.safety.speed_caps import SpeedCaps, allowed_speed
from cfplan.vehicle import measures
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.measures import SPEED
from cfplan.vehicle.profile import BoundaryState, SpeedProfile, yaw_within
from cfplan.vehicle.profile_spline import spline_profile
from cfplan.vehicle.yaw_spline import YawSpline

REST = 1e-9  # |γ'| below which a path stands still


@dataclass(frozen=True, slots=True)
class Shape:
    """The parameters of a problem's structure."""

    nodes: int
    free_yaw: bool
    turning_limited: bool = False  # whether angular acceleration is limited
    end_intervals: tuple[int, int] = (3, 3)  # intervals at each end with more points inside
    end_places: tuple[float, ...] = (0.2, 0.5, 0.8)
    middle_places: tuple[float, ...] = (0.5,)  # points inside every other interval
    speed_places: tuple[float, ...] = (0.5,)  # where the speed limit holds besides the nodes


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """The places of the points: the first point of all intervals, then the second of all, and so on.

    The last point is repeated, without limits, to fill the kernels' lanes.
    """

    shape: Shape
    interval: NDArray  # (P,) of each point
    place: NDArray  # (P,) in its interval, 0 to 1
    weight: NDArray  # (P,) of the penalties: 1 at the left end of an interval, else 0
    bounded: NDArray  # (ROWS, P) whether each row of point_constraints has its limits there
    speed_interval: NDArray  # (N + 1 + N speed places,) where the speed limit holds: at the nodes, and then between
    speed_place: NDArray  # likewise

    @property
    def s(self) -> NDArray:
        """Return where the points lie, (P,), in intervals from the first node."""
        return self.interval + self.place

    @property
    def speed_s(self) -> NDArray:
        """Return where the speed limit holds, in intervals."""
        return self.speed_interval + self.speed_place


@lru_cache(maxsize=128)
def layout_of(shape: Shape) -> Layout:
    """Return the layout of a shape, made once a process."""
    all_rows = np.ones(point_constraints.ROWS, dtype=bool)
    all_rows[measures.ANGULAR_ACCELERATION] = shape.turning_limited
    jumping = all_rows & point_constraints.JUMPS
    k = np.arange(shape.nodes)
    at_end = (k < shape.end_intervals[0]) | (k >= shape.nodes - shape.end_intervals[1])
    of_end, of_middle = (0.0, *shape.end_places, 1.0), (0.0, *shape.middle_places, 1.0)
    intervals, places = [], []
    for j in range(max(len(of_end), len(of_middle))):
        here = np.where(at_end, j < len(of_end), j < len(of_middle))
        intervals.append(k[here])
        places.append(np.where(at_end, (of_end + (1.0,) * j)[j], (of_middle + (1.0,) * j)[j])[here])
    interval, place = np.concatenate(intervals), np.concatenate(places)
    count, padding = len(interval), -len(interval) % point_constraints.LANES
    interval, place = (np.append(each, np.repeat(each[-1:], padding)) for each in (interval, place))
    # At an interval's right end the other rows equal those at the left end of the next one.
    inner_right = (place == 1.0) & (interval < shape.nodes - 1)
    bounded = np.where(inner_right, jumping[:, None], all_rows[:, None])
    bounded[:, count:] = False
    weight = np.where(place == 0.0, 1.0, 0.0)  # penalties count once per interval
    weight[count:] = 0.0
    node = np.arange(shape.nodes + 1)
    speed_interval = np.concatenate([np.minimum(node, shape.nodes - 1), np.tile(node[:-1], len(shape.speed_places))])
    speed_place = np.concatenate([(node == shape.nodes) * 1.0, np.repeat(np.array(shape.speed_places), shape.nodes)])
    return Layout(shape, interval, place, weight, bounded, speed_interval, speed_place)


@dataclass(frozen=True, slots=True)
class Ends:
    """The start of a segment, and whether another continues it. Its end is free, or at rest where the path is."""

    start: BoundaryState | None  # None where it is free
    continues: bool = False  # whether the start is a joint, which another problem's solution crossed with room to spare
    joint: int | None = None  # the interval before which this problem's solution will be cut, for another to go on

    @property
    def held(self) -> bool:
        """Return whether a boundary state decides the start."""
        return self.start is not None


@dataclass(frozen=True, slots=True)
class Segment:
    """A unit of planning: a path, or a window of one."""

    path: Path
    airframe: Airframe
    limits: PlanLimits
    ends: Ends
    yaw: YawSpline  # fixed before the speed; unused if yaw is free
    layout: Layout
    caps: SpeedCaps | None = None
    slowness: float = 1.0  # the speed limit over the speed where x is 1; see slowness_of()

    @property
    def unit(self) -> float:
        """Return h where x is 1."""
        return (self.limits.speed / self.slowness) ** 2

    def profile(self, coefficients: NDArray) -> SpeedProfile:
        """Return the profile of a table of spline coefficients, (N+3, 1 or 2) of x and, where yaw is free, of yaw."""
        yaw = self.yaw
        if coefficients.shape[1] == 2:
            yaw = YawSpline.from_coefficients(coefficients[:-1, 1], self.path.end / self.layout.shape.nodes)
        return spline_profile(coefficients[:, 0] * self.unit, self.path.end, yaw)


def slowness_of(h: NDArray, limits: PlanLimits) -> float:
    """Return the speed limit over `speed_cap_ratio` times the typical speed of some h, (K,); at least 1.

    If other limits keep a flight far below the speed limit, h in squares of that limit would be next to its `floor`,
    and the search would stop at once.
    """
    middle = np.sort(h)[(len(h) - 1) // 2 : len(h) // 2 + 1]  # one or two values: np.median() takes ten times as long
    return max(1.0, limits.speed / (TUNING.speed_cap_ratio * (float(middle[0] + middle[-1]) / 2.0) ** 0.5))


@dataclass(frozen=True, slots=True)
class Problem:
    """The numbers of a problem, in node units; see Layout for its points."""

    layout: Layout
    ends: Ends
    rests: tuple[bool, bool]  # whether the path stands still at its start and end
    unit: float  # h where x is 1
    step: float  # of s, an interval
    point_data: NDArray  # (POINT_DATA, P)
    common: NDArray  # (COMMON_DATA,)
    penalties: NDArray  # (3,) weights, of Penalties
    lower: NDArray  # (ROWS, P) bounds of the rows at points, infinite where there is none
    upper: NDArray  # (ROWS, P)
    highest: NDArray  # x at most where layout.speed_s says, by the speed limit
    first_yaw: tuple[float, float]  # least and most ψ at the start, where it is free
    coefficients: NDArray  # (N+3, 1 or 2) from which to search; fixed ones have their values


def build_problem(
    segment: Segment,
    yaw_angle: float = 0.0,
    coefficients: NDArray | None = None,
) -> Problem:
    """Return the problem of a segment. Where yaw is free its first value lies from `yaw_angle` to a quarter turn more.

    `coefficients`, (N+3, 1 or 2), is where the search begins (None: a guess); they must agree with the boundary state.
    """
    layout, path, limits, ends = segment.layout, segment.path, segment.limits, segment.ends
    nodes = layout.shape.nodes
    step, unit = path.end / nodes, segment.unit
    margin = TUNING.margin * (1.0 - held_by(ends, nodes))
    if ends.joint is not None:
        margin[ends.joint - TUNING.around_joint : ends.joint + TUNING.around_joint] = TUNING.joint_margin
    s = layout.speed_s * step
    nominal = np.linalg.norm(path(s, 1), axis=1)
    speed = (1.0 - margin[layout.speed_interval]) * allowed_speed(limits.speed, segment.caps, s)
    highest = np.minimum((speed / np.maximum(nominal, REST)) ** 2 / unit, TUNING.ceiling * segment.slowness**2)
    if ends.held:
        highest[0] = np.inf  # the state decides, and was checked
    lower, upper = _limits_at_points(layout, ends, margin)
    if coefficients is None:
        coefficients = guess(
            path, segment.airframe, limits, nodes, unit=unit, start=ends.start,
            yaw=yaw_angle + FREE_START / 2 if layout.shape.free_yaw else None,
        )  # fmt: skip
    return Problem(
        layout, ends, (nominal[0] < REST, nominal[nodes] < REST), unit, step, _point_data(segment, step),
        point_constraints.common_data(segment.airframe, limits, unit / step**2),
        np.array(TUNING.penalties), lower, upper, highest,
        (yaw_angle, yaw_angle + FREE_START), coefficients,
    )  # fmt: skip


def interval_of(segment: Segment, coefficients: NDArray) -> float:
    """Return the approximate duration of an interval, s, with these coefficients, (N+3, 1 or 2)."""
    h = segment.unit * np.maximum(coefficients[:, 0], TUNING.floor)
    return segment.path.end / segment.layout.shape.nodes * float((1.0 / np.sqrt(h)).sum()) / len(h)


def _point_data(segment: Segment, step: float) -> NDArray:
    """Return the point data, (POINT_DATA, P), in node units."""
    layout, given, k = segment.layout, segment.yaw, segment.layout.interval
    powers = np.array([step, step**2, step**3, step**2 * step**2])
    of_path = segment.path.derivatives(layout.s * step)[1:] * powers[:, None, None]
    yaw, dyaw, ddyaw = yaw_within(layout.place * step, given.yaw[k], given.dyaw[k], given.ddyaw[k])
    return np.stack([*of_path.reshape(12, -1), layout.place, layout.weight, yaw, dyaw * step, ddyaw * step**2])


def _limits_at_points(layout: Layout, ends: Ends, margin: NDArray) -> tuple[NDArray, NDArray]:
    """Return the lower and upper bounds of the rows at points, tightened by the margin of each interval, (N,)."""
    decided = (layout.s == 0.0) & ends.held  # by the boundary state
    tighter = np.where(
        decided & ~point_constraints.JUMPS[:, None],
        -TUNING.boundary_tolerance,
        2.0 * margin[layout.interval],  # as most rows are squares
    )
    return (
        np.where(layout.bounded, point_constraints.LOWER[:, None] + tighter, -np.inf),
        np.where(layout.bounded, point_constraints.UPPER[:, None] - tighter, np.inf),
    )


def tightened(problem: Problem, violation: Violation, rows: NDArray) -> Problem:
    """Return the problem with limits lowered, in each interval that exceeds one between the points, by the violation.

    `rows`, (ROWS, P), is what the solution has at the points: a peak far from every point lowers the limits from there.
    """
    layout = problem.layout
    over, under = (TUNING.overtightening * spread(each, CONTINUOUS) for each in (violation.upper, violation.lower))
    lower, upper = _lowered(
        problem.lower, problem.upper, rows, layout.bounded, layout.interval, violation.lower, violation.upper,
        under, over,
    )  # fmt: skip
    slower = np.maximum(over[:, SPEED], 0.0)  # in each interval; at nodes, of either side's
    at_nodes, between = (
        np.maximum(np.append(slower, 0.0), np.append(0.0, slower)),
        layout.speed_interval[len(slower) + 1 :],
    )
    highest = problem.highest * (1.0 - np.append(at_nodes, slower[between]))
    return replace(problem, lower=lower, upper=upper, highest=highest)


@njit
def _lowered(
    lower: NDArray, upper: NDArray, rows: NDArray, bounded: NDArray, interval: NDArray, below: NDArray, above: NDArray,
    under: NDArray, over: NDArray,
) -> tuple[NDArray, NDArray]:  # fmt: skip
    """Return the bounds of the rows at points, tightened by `under` and `over`, (N, MEASURES), of their intervals.

    In an interval that exceeds a limit between its points by `above`, or `below`, bounds are lowered from the largest,
    or least, value of the rows at its points; elsewhere from the previous bound.
    """
    low, high = np.full(lower.shape, -np.inf), np.full(upper.shape, np.inf)
    for row in range(len(rows)):
        least, most = np.full(len(above), np.inf), np.full(len(above), -np.inf)
        for p in range(len(interval)):
            if bounded[row, p]:
                k, value = interval[p], rows[row, p]
                least[k], most[k] = min(least[k], value), max(most[k], value)
        for p in range(len(interval)):
            if bounded[row, p]:
                k = interval[p]
                highest = min(upper[row, p], most[k]) if above[k, row] > 0.0 else upper[row, p]
                lowest = max(lower[row, p], least[k]) if below[k, row] > 0.0 else lower[row, p]
                high[row, p], low[row, p] = highest - max(over[k, row], 0.0), lowest + max(under[k, row], 0.0)
    return low, high


def held_by(ends: Ends, nodes: int) -> NDArray:
    """Return (N,): 1 next to a boundary state, 0 from TUNING.blend on.

    A state may lie at a limit and nearly determines what follows: there is no room to lower limits there.
    """
    if not ends.held or ends.continues:
        return np.zeros(nodes)
    return 1.0 - np.clip((np.arange(nodes) - 1.0) / TUNING.blend, 0.0, 1.0)
