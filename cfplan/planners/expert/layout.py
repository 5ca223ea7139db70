"""The points at which a speed-profile problem holds its limits, and the spline coefficients that are its variables.

Coefficients lie in a table: N+3 of h, a cubic B-spline on the grid, in its first column and, where yaw is free, N+2 of
yaw, a quadratic one, in its second. Read row by row it is the vector v of variables, in which an interval's
coefficients lie side by side. A boundary state fixes three coefficients of h and two of yaw; at a rest the first four
of h have one value, so that h is constant in that interval, and the first two of yaw.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.planners.expert import point_constraints
from cfplan.vehicle import measures, yaw_spline
from cfplan.vehicle.profile_spline import weights_at

_FIXED = -1


@dataclass(frozen=True, slots=True)
class Shape:
    """What a problem's structure depends on."""

    nodes: int
    free_yaw: bool
    turning_limited: bool = False  # whether angular acceleration has a limit of its own
    end_intervals: tuple[int, int] = (3, 3)  # intervals at each end with more points inside
    end_places: tuple[float, ...] = (0.2, 0.5, 0.8)
    middle_places: tuple[float, ...] = (0.5,)  # points inside every other interval
    speed_places: tuple[float, ...] = (0.5,)  # where the speed limit holds besides the nodes


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """Where the points lie: the first of all intervals, then the second of all, and so on.

    The last one is repeated, without limits, until they fill the kernels' lanes.
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
    # At an interval's right end the rest holds as it does at the next one's left end.
    inner_right = (place == 1.0) & (interval < shape.nodes - 1)
    bounded = np.where(inner_right, jumping[:, None], all_rows[:, None])
    bounded[:, count:] = False
    weight = np.where(place == 0.0, 1.0, 0.0)  # penalties count once an interval
    weight[count:] = 0.0
    node = np.arange(shape.nodes + 1)
    speed_interval = np.concatenate([np.minimum(node, shape.nodes - 1), np.tile(node[:-1], len(shape.speed_places))])
    speed_place = np.concatenate([(node == shape.nodes) * 1.0, np.repeat(np.array(shape.speed_places), shape.nodes)])
    return Layout(shape, interval, place, weight, bounded, speed_interval, speed_place)


class Sparsity(NamedTuple):
    """How v, the intervals and the points belong together, for compiled loops.

    Points, and linear rows, lie in runs: of as many intervals, one after another. (R, 3): the first point of each run,
    its interval, and how many. So the loops pass through memory in order, several numbers at a time, which takes
    unsigned numbers: compiled code looks at the sign of an index.
    """

    runs: NDArray  # of the P points
    slots: NDArray  # (k, N) entry of v of each of an interval's coefficients, -1 where it is fixed
    entries: NDArray  # (2, k(k+1)/2, N) of the flattened matrix for each pair, -1 if fixed, and how often it counts
    linear: NDArray  # (4, E) weights of four of an interval's coefficients in each linear row
    linear_runs: NDArray  # of the E rows
    of_yaw: int  # how many of the linear rows, the last ones, weigh yaw's coefficients, not those of h


@dataclass(frozen=True, slots=True, eq=False)
class Variables:
    """Which coefficients are variables."""

    slots: NDArray  # (N+3, 1 or 2) entry of v of each coefficient, -1 where it is fixed
    local: NDArray  # (k, N) where an interval's coefficients lie in the flattened table
    positive: int  # how many coefficients of h have an entry of v of their own
    size: int  # of v
    band: int  # how far apart two coefficients that meet can be
    sparsity: Sparsity


@lru_cache(maxsize=128)
def variables_of(layout: Layout, held: tuple[bool, bool], rests: tuple[bool, bool]) -> Variables:
    """Return the variables, where each end is held by a boundary state or not, and at rest or not."""
    nodes, free_yaw = layout.shape.nodes, layout.shape.free_yaw
    table, own = _slots(nodes, 2 if free_yaw else 1, held, rests)
    k = point_constraints.variables(free_yaw)
    local = (
        np.array([0, 1, 2, 3, 0, 1, 2][:k])[:, None] + np.arange(nodes),
        np.array([0, 0, 0, 0, 1, 1, 1][:k])[:, None],
    )
    slots = table[local]
    free = np.where(slots >= 0, slots, slots.max(axis=0))
    band = int((free.max(axis=0) - free.min(axis=0)).max())
    right, left = np.array([(a, b) for b in range(k) for a in range(b, k)]).T
    low, high = np.minimum(slots[left], slots[right]), np.maximum(slots[left], slots[right])
    entry = np.where(low >= 0, high * (band + 1) + high - low, _FIXED)
    entries = np.stack([entry, np.where((low == high) & (left != right)[:, None], 2, 1)])
    positive = np.flatnonzero(own[:, 0])
    sparsity = Sparsity(_runs(layout.interval), slots, entries, *_linear_rows(layout, positive))
    return Variables(table, local[0] * table.shape[1] + local[1], len(positive), table.size, band, sparsity)


def _slots(nodes: int, columns: int, held: tuple[bool, bool], rests: tuple[bool, bool]) -> tuple[NDArray, NDArray]:
    """Return the entry of v of each coefficient, -1 where it is fixed; and which have an entry of their own."""
    own = np.arange((nodes + 3) * columns).reshape(nodes + 3, columns)
    slots = own.copy()
    for end, (h, yaw) in enumerate((
        ([0, 1, 2, 3], [0, 1]), ([nodes + 2, nodes + 1, nodes, nodes - 1], [nodes + 1, nodes])
    )):  # fmt: skip
        if held[end]:
            slots[h[:3], 0] = _FIXED
            if columns == 2:
                slots[yaw, 1] = _FIXED
        elif rests[end]:
            slots[h, 0] = slots[h[3], 0]
            if columns == 2:
                slots[yaw, 1] = slots[yaw[1], 1]
    if columns == 2:
        slots[-1, 1] = _FIXED  # yaw has a coefficient less
    return slots, slots == own


def _linear_rows(layout: Layout, positive: NDArray) -> tuple[NDArray, NDArray, int]:
    """Return (weights (4, E), runs, how many of yaw): h where the speed limit holds, its coefficients, yaw's start."""
    of_positive = np.clip(positive - 1, 0, layout.shape.nodes - 1)
    weights = [np.stack(weights_at(layout.speed_place)), np.eye(4)[positive - of_positive].T]
    interval = [layout.speed_interval, of_positive]
    if layout.shape.free_yaw:
        weights.append(np.append(0.0, yaw_spline.AT_NODE[0])[:, None])
        interval.append(np.zeros(1, dtype=int))
    linear = np.ascontiguousarray(np.concatenate(weights, axis=1))
    return linear, _runs(np.concatenate(interval)), int(layout.shape.free_yaw)


def _runs(interval: NDArray) -> NDArray:
    """Return the runs, (R, 3), in which these intervals follow one another."""
    first = np.flatnonzero(np.diff(interval, prepend=-2) != 1)
    return np.stack([first, interval[first], np.diff(first, append=len(interval))], axis=1).astype(np.uint64)
