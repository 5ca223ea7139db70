"""Certificate: no limit is exceeded anywhere on a trajectory, between samples included.

The trajectory is cut at the grid points of its profile and at the breaks of its path, so that every piece is smooth.
Each piece is sampled, including both ends, at no less than ten points and at most a millisecond of flight apart, so
both sides of a grid point are checked, where h''' and ψ'' jump. Between two samples a smooth quantity exceeds both by
at most an eighth of its second difference; twice that is added to every worst value as an allowance. If the allowance
is so large that usage would be overstated, the sample spacing is divided by four, up to twice. The distance to
obstacles is that of the path, see space.py.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.geometry.path import Path
from cfplan.geometry.polynomials import derivatives_on
from cfplan.machine_code import njit
from cfplan.numbers import shown
from cfplan.safety.limits import PlanLimits
from cfplan.safety.quantities import AT_LEAST, QUANTITIES, Quantity
from cfplan.safety.space import Space, beyond_obstacles, inside
from cfplan.safety.speed_caps import SpeedCaps
from cfplan.vehicle.airframe import Airframe
from cfplan.vehicle.flatness import Body, compiled_body
from cfplan.vehicle.measures import MEASURES, measures_of
from cfplan.vehicle.motion import fill
from cfplan.vehicle.profile import h_within
from cfplan.vehicle.trajectory import Trajectory

TIME_STEP = 1e-3  # s, largest sample spacing
BATCH = 1_000  # samples at a time, about: as many as fit the cache
BLOCK = 512  # samples per search for a peak
LEAST_POINTS = 11  # of a piece, including its ends
WALLS, OBSTACLES = "distance to the walls", "distance to obstacles"
OF_PLACE = (WALLS, OBSTACLES)  # depend only on the path, not on speed
CAPPED_SPEED = "speed, capped"  # against the caps along the path, if there are any
POSITION = MEASURES  # row after the measures, with two more: position, m
_ALLOWANCE = 2.0 / 8.0  # of the second difference
MAX_ALLOWANCE = 0.01  # fraction of a limit; with a larger allowance the spacing is refined
REFINE_FACTOR, MAX_REFINEMENTS = (
    4,
    2,
)  # a flight that needs more refinement fails anyway
_SAME = 1e-12  # fraction of a path's length in s, within which two places are the same


@dataclass(frozen=True, slots=True)
class Margin:
    """The margin of one limit at the worst moment of the trajectory."""

    name: str
    unit: str
    worst: float  # including the allowance between samples
    limit: float
    share: float  # usage of the limit; for a least thrust, from hover down to it; NaN if a value is not finite
    time: float  # s
    s: float
    position: tuple[float, float, float]  # m

    @property
    def passed(self) -> bool:
        """Return whether the limit holds; False for NaN."""
        return bool(self.share <= 1.0)

    def shown(self, value: float) -> str:
        """Return a value in the unit of safety.yaml, where angles are in degrees."""
        if self.unit == "rad":
            return f"{shown(math.degrees(value), '.1f')} °"
        return f"{shown(value, '.3f' if self.unit == 'N' else '.2f')} {self.unit}"


@dataclass(frozen=True, slots=True)
class Certificate:
    """Every limit with its margin, for one trajectory and one set of limits."""

    margins: tuple[Margin, ...]
    duration: float  # s
    samples: int

    @property
    def passed(self) -> bool:
        """Return whether no limit is exceeded anywhere."""
        return all(margin.passed for margin in self.margins)

    @property
    def worst(self) -> Margin:
        """Return the margin with the largest usage; NaN comes first."""
        return max(self.margins, key=lambda margin: np.inf if np.isnan(margin.share) else margin.share)

    def rows(self) -> list[tuple[str, str, str, str, str, str]]:
        """Return rows of a table: limit, worst value with its unit, allowed value, usage, time, position in m."""
        return [
            (
                margin.name,
                margin.shown(margin.worst),
                margin.shown(margin.limit).split()[0],
                f"{shown(100 * margin.share, '.1f')} %",
                f"{margin.time:.2f} s",
                " ".join(shown(each, ".2f") for each in margin.position),
            )
            for margin in self.margins
        ]

    def to_dict(self) -> dict[str, Any]:
        """Return a document for JSON; numbers that are not finite become None."""
        return {
            "passed": self.passed,
            "duration": self.duration,
            "samples": self.samples,
            "margins": [
                {key: _plain(value) for key, value in asdict(margin).items()} | {"passed": margin.passed}
                for margin in self.margins
            ],
        }


class Segments(NamedTuple):
    """Smooth parts of a flight, (K,) each, and the number of samples of each."""

    left: NDArray  # s
    right: NDArray  # s
    interval: NDArray  # of the profile
    piece: NDArray  # of the path
    counts: NDArray  # samples, evenly spaced, both ends included; at least two


class _Bound(NamedTuple):
    """A quantity and its limit; `unused` is the value of usage 0."""

    quantity: Quantity
    limit: float
    unused: float


def certify(
    trajectory: Trajectory, limits: PlanLimits, space: Space | None = None, caps: SpeedCaps | None = None
) -> Certificate:
    """Check every limit everywhere, also space and speed caps if given. Never raises: NaN fails."""
    segments, (bounds, table) = segments_of(trajectory), _bounds(trajectory.airframe, limits, space)
    walls = np.zeros((2, 0)) if space is None else np.array([space.low, space.high])
    path, body, nodes = trajectory.path, compiled_body(trajectory.airframe), trajectory.timing.nodes
    values, added, places = _search(table, walls, BATCH, body, path.origins, path.coefficients, nodes, segments)
    for _ in range(MAX_REFINEMENTS):
        if not any(map(_overstated, bounds, values.tolist(), added.tolist())):
            break
        segments = segments._replace(counts=REFINE_FACTOR * (segments.counts - 1) + 1)
        values, added, places = _search(table, walls, BATCH, body, path.origins, path.coefficients, nodes, segments)
    when, where = trajectory.time_at(places).tolist(), trajectory.path(places).tolist()
    peaks = zip(bounds, values.tolist(), when, places.tolist(), where, strict=True)
    margins = [_margin(*each) for each in peaks]
    if space is not None and space.obstacles:
        margins.append(obstacle_margin(trajectory.path, space, trajectory.time_at))
    if caps is not None:
        margins.append(_capped_speed(trajectory, caps, segments))
    return Certificate(
        margins=tuple(margins),
        duration=trajectory.duration,
        samples=int(segments.counts.sum()),
    )


def shares(trajectory: Trajectory, limits: PlanLimits, time: NDArray) -> dict[str, NDArray]:
    """Return the usage of each limit at each time, (N,) each, as in the certificate, without the walls."""
    state = trajectory.at(time)
    measured = measures_of(
        state.velocity, state.acceleration, state.body_rate, state.thrust_axis, state.specific_thrust,
        angular_acceleration=state.angular_acceleration, motor_thrust=state.motor_thrust,
    )  # fmt: skip
    bounds, _ = _bounds(trajectory.airframe, limits, None)
    return {q.name: (q.worst(measured) - unused) / (limit - unused) for q, limit, unused in bounds}


@lru_cache(maxsize=16)
def _bounds(airframe: Airframe, limits: PlanLimits, space: Space | None) -> tuple[tuple[_Bound, ...], NDArray]:
    """Return the finite limits; and for compiled code, (Q, 3): first row, number of rows and side of each."""
    bounds = [_Bound(q, q.allowed(limits), q.unused(airframe)) for q in QUANTITIES if q.allowed(limits) != math.inf]
    if space is not None:
        walls = Quantity(WALLS, "m", "", "", AT_LEAST, POSITION, 3)  # replaces the position itself
        bounds.append(_Bound(walls, space.margin, half_of(space)))
    return tuple(bounds), np.array([(q.measure, q.count, q.side) for q, _, _ in bounds])


def _plain(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _overstated(bound: _Bound, peak: float, added: float) -> bool:
    """Return whether the allowance of a peak is large relative to the limit; False for NaN."""
    quantity, limit, unused = bound
    sampled, worst = (float(quantity.value(quantity.side * value)) for value in (peak - added, peak))
    return abs(worst - sampled) > MAX_ALLOWANCE * (abs(limit) or abs(unused))


def _margin(bound: _Bound, peak: float, time: float, s: float, position: Sequence[float]) -> Margin:
    """Return the margin of a peak, which is the side times the measure."""
    quantity, limit, unused = bound
    worst = float(quantity.value(quantity.side * peak))
    share = share_of(quantity, worst, limit, unused)
    x, y, z = position
    return Margin(
        name=quantity.name,
        unit=quantity.unit,
        worst=worst,
        limit=limit,
        share=max(0.0, float(share)) if math.isfinite(worst) and math.isfinite(limit) else math.nan,
        time=time,
        s=s,
        position=(x, y, z),
    )


def share_of(quantity: Quantity, worst: float, limit: float, unused: float) -> float:
    """Return the usage of a limit; of a distance it is at most 1 if the margin is kept within rounding."""
    room = limit - unused
    share = (worst - unused) / room if room * quantity.side > 0 else math.inf
    return min(share, 1.0) if quantity.name in OF_PLACE and inside(limit - worst) else share


def half_of(space: Space) -> float:
    """Return the distance from walls and obstacles, m, of usage 0: half the room's least size."""
    return float(np.subtract(space.high, space.low).min()) / 2


def obstacle_margin(path: Path, space: Space, time_at: Callable[[NDArray], Any]) -> Margin:
    """Return the margin of a path's distance to obstacles; `time_at` returns when the flight passes s, in s."""
    s, beyond = beyond_obstacles(path, space)
    worst = np.unravel_index(int(np.argmax(beyond)), beyond.shape)
    bound = _Bound(Quantity(OBSTACLES, "m", "", "", AT_LEAST, POSITION, 1), space.margin, half_of(space))
    place, peak = s[worst], float(beyond[worst]) - space.margin
    return _margin(bound, peak, float(time_at(place)), float(place), path(place).tolist())


def _capped_speed(trajectory: Trajectory, caps: SpeedCaps, segments: Segments) -> Margin:
    """Return the margin of speed against caps, sampled like other limits, and at the caps' corners and half-way.

    A corner is the end of a segment, so no allowance spans it.
    """
    steps = np.repeat((segments.right - segments.left) / (segments.counts - 1), segments.counts)
    number = np.arange(len(steps)) - np.repeat(np.cumsum(segments.counts) - segments.counts, segments.counts)
    bends, end = np.array(caps.s), trajectory.path.end
    s = np.concatenate(
        [np.repeat(segments.left, segments.counts) + number * steps, bends, (bends[1:] + bends[:-1]) / 2]
    )
    s = np.unique(s[s <= end])
    s = s[np.append(True, np.diff(s) > _SAME * end)]
    cap = caps.at(s)
    square = trajectory.profile.at(s).h * np.square(trajectory.path(s, 1)).sum(axis=1) / cap**2
    gap = np.diff(s)
    sag = np.maximum(-np.diff(np.diff(square) / gap) * 2.0 / (gap[1:] + gap[:-1]), 0.0)  # second derivative downwards
    at_bends = np.searchsorted(s, bends - 2.0 * _SAME * end)
    sag[at_bends[(at_bends > 0) & (at_bends < len(s) - 1)] - 1] = 0.0
    widest = np.maximum(gap[1:], gap[:-1])
    bound = np.maximum(np.maximum(square[:-2], square[1:-1]), square[2:]) + _ALLOWANCE * widest**2 * sag
    index = int(np.argmax(np.where(np.isnan(bound), np.inf, bound)))
    share, at = math.sqrt(bound[index]), index + int(np.argmax(square[index : index + 3]))
    x, y, z = trajectory.path(s[at]).tolist()
    return Margin(
        CAPPED_SPEED, "m/s", share * float(cap[at]), float(cap[at]), share, float(trajectory.time_at(s[at])),
        float(s[at]), (x, y, z),
    )  # fmt: skip


def segments_of(trajectory: Trajectory) -> Segments:
    """Cut at the grid points, at the breaks of the path, and where the timing was refined because h changes fast."""
    timing = trajectory.timing
    return Segments(*_cut(timing.s, timing.interval, timing.nodes, trajectory.path.breaks))


@njit(error_model="numpy")
def _cut(
    s: NDArray, intervals: NDArray, nodes: NDArray, breaks: NDArray
) -> tuple[NDArray, NDArray, NDArray, NDArray, NDArray]:
    """Return the result of `segments_of` from the timing's pieces, which end at `s`, and its profile's table."""
    every, here, there = np.empty(len(s) + len(breaks)), 0, 0  # both in order
    for n in range(len(every)):
        if there == len(breaks) or (here < len(s) and s[here] <= breaks[there]):
            every[n] = s[here]
            here += 1
        else:
            every[n] = breaks[there]
            there += 1
    edges, count = every.copy(), 1
    for n in range(1, len(every)):
        if every[n] - every[n - 1] > _SAME * every[-1]:
            edges[count] = every[n]
            count += 1
    edges = edges[:count]
    edges[-1] = s[-1]
    interval, piece = np.empty(count - 1, np.int64), np.empty(count - 1, np.int64)
    counts = np.empty(count - 1, np.int64)
    at, on = 0, 0
    for k in range(count - 1):
        width = edges[k + 1] - edges[k]
        middle = edges[k] + width / 2
        while at < len(intervals) - 1 and s[at + 1] < middle:
            at += 1
        while on < len(breaks) - 2 and breaks[on + 1] < middle:
            on += 1
        interval[k], piece[k] = intervals[at], on
        node, slowest = nodes[intervals[at]], np.inf
        for quarter in range(5):
            x = edges[k] + quarter / 4 * width - node[0]
            slowest = min(slowest, h_within(x, node[1], node[2], node[3], node[4])[0])
        counts[k] = max(int(np.ceil(width / (TIME_STEP * np.sqrt(slowest)))) + 1, LEAST_POINTS)
    return edges[:-1], edges[1:], interval, piece, counts


@njit(error_model="numpy")
def _search(
    table: NDArray, walls: NDArray, batch: int, body: Body, origins: NDArray, coefficients: NDArray, nodes: NDArray,
    segments: Segments,
) -> tuple[NDArray, NDArray, NDArray]:  # fmt: skip
    """Return the peak of each of the table's quantities, the allowance in it, and s there.

    Takes about `batch` samples at a time.
    """
    values, added, places = np.full(len(table), -np.inf), np.zeros(len(table)), np.zeros(len(table))
    counts, begin = segments.counts, 0
    while begin < len(counts):
        end, samples = begin, 0
        while end < len(counts) and samples < batch:
            samples += counts[end]
            end += 1
        s, piece, interval = sampled(segments, begin, end)
        curve, rows = derivatives_on(origins, coefficients, s, piece), np.empty((MEASURES + walls.shape[1], samples))
        fill(rows[:MEASURES], body, curve, nodes, s, interval)
        for axis in range(walls.shape[1]):  # distances of positions from the walls
            middle, half = (walls[0, axis] + walls[1, axis]) / 2, (walls[1, axis] - walls[0, axis]) / 2
            rows[POSITION + axis] = half - np.abs(curve[0, axis] - middle)
        raise_peaks(values, added, places, table, rows, s, counts[begin:end])
        begin = end
    return values, added, places


@njit(error_model="numpy")
def sampled(segments: Segments, begin: int, end: int) -> tuple[NDArray, NDArray, NDArray]:
    """Return the samples of segments: s, just left of their right ends too, piece of the path, interval of profile."""
    total = segments.counts[begin:end].sum()
    s, piece, interval = np.empty(total), np.empty(total, np.int64), np.empty(total, np.int64)
    first = 0
    for k in range(begin, end):
        last, width = segments.counts[k] - 1, segments.right[k] - segments.left[k]
        for n in range(last + 1):
            s[first + n] = segments.left[k] + n / last * width
            piece[first + n], interval[first + n] = segments.piece[k], segments.interval[k]
        first += last + 1
        s[first - 1] = np.nextafter(segments.right[k], -np.inf)
    return s, piece, interval


@njit
def raise_peaks(
    values: NDArray, added: NDArray, places: NDArray, table: NDArray, rows: NDArray, s: NDArray, counts: NDArray
) -> None:
    """Update the running maxima with this batch. `table`, (Q, 3): first row, how many, and side.

    Segments have `counts` samples each, at least three, one segment after the other.
    """
    total = 0
    for n in range(len(counts)):
        total += counts[n]
    lift = np.zeros(total)  # infinite at the ends of segments
    at = 0
    for n in range(len(counts)):
        lift[at] = np.inf
        at += counts[n]
        lift[at - 1] = np.inf
    for k in range(len(table)):
        first, count, sign = table[k, 0], table[k, 1], table[k, 2]
        for which in range(first, first + count):
            row = rows[which]
            for begin in range(0, len(lift) - 2, BLOCK):
                if not np.isnan(values[k]):  # NaN is the worst and stays
                    end = min(begin + BLOCK + 2, len(lift))
                    index, values[k] = _peak(row[begin:end], sign, lift[begin:end], values[k])
                    if index >= 0:
                        places[k] = s[begin + index]
                        added[k] = values[k] - sign * row[begin + index]


@njit
def _peak(row: NDArray, sign: int, lift: NDArray, peak: float) -> tuple[int, float]:
    """Return the index of the largest of `sign` times (N,), and its value with the allowance between samples.

    If that does not exceed `peak`, return -1 and `peak`. NaN is larger than everything.
    """
    # Each inner sample covers both gaps beside it, so all gaps of a segment are covered.
    before, here, after, lift = row[:-2], row[1:-1], row[2:], lift[1:-1]
    index, higher = -1, 0  # counting is vectorised; the search is seldom needed
    for n in range(len(here)):
        higher += not _bound(sign * before[n], sign * here[n], sign * after[n]) <= peak + lift[n]
    if higher:
        for n in range(len(here)):
            left, middle, right = sign * before[n], sign * here[n], sign * after[n]
            bound = _bound(left, middle, right)
            if lift[n] == 0.0 and not bound <= peak:
                peak = bound
                if np.isnan(bound):
                    return n + 1, peak
                index = n + (1 if middle >= left and middle >= right else 0 if left >= right else 2)
    return index, peak


@register_jitable(forceinline=True)
def _bound(before: float, here: float, after: float) -> float:
    sag = 2.0 * here - before - after
    higher = before if before > after else after
    return (here if here > higher else higher) + _ALLOWANCE * (0.0 if sag <= 0.0 else sag)
