"""The proof before take-off: no limit is exceeded anywhere on a trajectory, between samples included.

The trajectory is cut at the grid points of its profile and at the breaks of its path, so that every piece is smooth,
and each piece is sampled from end to end, closed: at least ten points, and never further apart than a millisecond of
flight. Both sides of a grid point are thus seen, where h''' and ψ'' jump. Between two samples a smooth quantity exceeds
the larger of them by at most an eighth of its second difference there; that is added, twice over, to every worst value.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cfplan.safety.limits import PlanLimits
from cfplan.safety.space import Space
from cfplan.vehicle import dense
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.dense import Stretches, sampled_rows
from cfplan.vehicle.trajectory import FullState, Trajectory

TIME_STEP = 1e-3  # s, the most between two samples
BATCH = 2_000  # samples at a time, about: as many as stay near the processor
LEAST_POINTS = 11  # of a piece, its ends included
WALLS = "distance to the walls"
_ALLOWANCE = 2.0 / 8.0  # of the second difference


@dataclass(frozen=True, slots=True)
class Margin:
    """How near the trajectory comes to one limit, at the worst."""

    name: str
    unit: str
    worst: float
    # with the allowance for what lies between samples
    limit: float
    share: float
    # of the limit; for a least thrust, of the way from hover down to it; NaN where a value is not finite
    time: float
    # s
    s: float
    position: tuple[float, float, float]
    # m

    @property
    def passed(self) -> bool:
        """False for NaN too."""
        return bool(self.share <= 1.0)


@dataclass(frozen=True, slots=True)
class Certificate:
    """Every limit with its margin. Holds for this trajectory and these limits, nothing else."""

    margins: tuple[Margin, ...]
    duration: float
    # s
    samples: int

    @property
    def passed(self) -> bool:
        """Whether no limit is exceeded anywhere."""
        return all(margin.passed for margin in self.margins)

    @property
    def worst(self) -> Margin:
        """The margin with the largest share; one that is not a number before all others."""
        return max(self.margins, key=lambda margin: np.inf if np.isnan(margin.share) else margin.share)

    def rows(self) -> list[tuple[str, str, str, str, str, str]]:
        """For a table: limit, worst value, allowed, share, time, place."""
        return [
            (
                margin.name,
                f"{margin.worst:.3f} {margin.unit}",
                f"{margin.limit:.3f} {margin.unit}",
                f"{100 * margin.share:.1f} %",
                f"{margin.time:.3f} s",
                "({:.2f}, {:.2f}, {:.2f}) m".format(*margin.position),
            )
            for margin in self.margins
        ]

    def to_dict(self) -> dict[str, Any]:
        """For JSON; what is not finite becomes None."""
        return {
            "passed": self.passed,
            "duration": self.duration,
            "samples": self.samples,
            "margins": [
                {key: _plain(value) for key, value in asdict(margin).items()} | {"passed": margin.passed}
                for margin in self.margins
            ],
        }


@dataclass(frozen=True, slots=True)
class _Quantity:
    """What must not rise above 1 as a share; `sign` is -1 where the limit is a least value."""

    name: str
    unit: str
    sign: int
    row: int
    # of dense.sampled_rows
    count: int
    # of rows, all of which must keep the same limit
    limit: float
    at_rest: float
    # what it is in hover, which counts as share 0


class _Peak(NamedTuple):
    """The worst of one quantity."""

    quantity: _Quantity
    value: float
    # its sign times the value
    s: float


def certify(trajectory: Trajectory, limits: PlanLimits, space: Space | None = None) -> Certificate:
    """Check every limit everywhere; the space too, where given. Never raises: what is not a number fails."""
    stretches, quantities = _stretches(trajectory), list(_quantities(trajectory, limits, space))
    table = np.array([(quantity.row, quantity.count, quantity.sign) for quantity in quantities])
    ends = np.cumsum(stretches.counts)
    bounds = [0, *(1 + np.flatnonzero(np.diff(ends // BATCH))).tolist(), len(ends)]
    rows = np.empty((dense.SAMPLED_ROWS, int(np.diff(np.append(0, ends)[bounds]).max())))
    values, places = np.full(len(table), -np.inf), np.zeros(len(table))
    for first, last in pairwise(bounds):
        batch = Stretches(*(each[first:last] for each in stretches))
        sampled_rows(trajectory.airframe, trajectory.path, trajectory.profile, batch, rows)
        if space is not None:
            _put_distances(rows[dense.POSITION : dense.POSITION + 3, : batch.counts.sum()], space)
        _raise_peaks(values, places, table, rows, rows[dense.PLACE], batch.counts)
    peaks = [_Peak(*each) for each in zip(quantities, values.tolist(), places.tolist(), strict=True)]
    when, where = trajectory.time_at(places).tolist(), trajectory.path(places).tolist()
    return Certificate(
        margins=tuple(_margin(*each) for each in zip(peaks, when, where, strict=True)),
        duration=trajectory.duration,
        samples=int(ends[-1]),
    )


def shares(trajectory: Trajectory, limits: PlanLimits, time: NDArray) -> dict[str, NDArray]:
    """How much of each limit is used at each time, (N,) each; counted as in the certificate, the walls left out."""
    rows = _rows(trajectory.at(time))
    return {
        quantity.name: (
            (rows[quantity.row : quantity.row + quantity.count] - quantity.at_rest)
            / (quantity.limit - quantity.at_rest)
        ).max(axis=0)
        for quantity in _quantities(trajectory, limits, None)
    }


def _rows(state: FullState) -> NDArray:
    """What `sampled_rows` gives, of full states."""
    rows = np.empty((dense.SAMPLED_ROWS, len(state.s)))
    x, y, z = state.thrust_axis.T
    rows[dense.SPEED] = np.linalg.norm(state.velocity, axis=1)
    rows[dense.ACCELERATION] = np.linalg.norm(state.acceleration, axis=1)
    rows[dense.BODY_RATE] = np.linalg.norm(state.body_rate, axis=1)
    rows[dense.ANGULAR_ACCELERATION] = np.linalg.norm(state.angular_acceleration, axis=1)
    rows[dense.TILT] = np.arctan2(np.hypot(x, y), z)
    rows[dense.SPECIFIC_THRUST] = state.specific_thrust
    rows[dense.MOTOR_THRUST : dense.MOTOR_THRUST + 4] = state.motor_thrust.T
    rows[dense.POSITION : dense.POSITION + 3] = state.position.T
    rows[dense.PLACE] = state.s
    return rows


def _quantities(trajectory: Trajectory, limits: PlanLimits, space: Space | None) -> Iterator[_Quantity]:
    hover = trajectory.airframe.hover_thrust
    yield _Quantity("speed", "m/s", 1, dense.SPEED, 1, limits.speed, 0.0)
    yield _Quantity("acceleration", "m/s²", 1, dense.ACCELERATION, 1, limits.acceleration, 0.0)
    yield _Quantity("angular velocity", "rad/s", 1, dense.BODY_RATE, 1, limits.angular_velocity, 0.0)
    if limits.angular_acceleration != math.inf:
        most = limits.angular_acceleration
        yield _Quantity("angular acceleration", "rad/s²", 1, dense.ANGULAR_ACCELERATION, 1, most, 0.0)
    yield _Quantity("tilt", "rad", 1, dense.TILT, 1, limits.tilt, 0.0)
    yield _Quantity("motor thrust, most", "N", 1, dense.MOTOR_THRUST, 4, limits.motor_thrust_max, 0.0)
    yield _Quantity("motor thrust, least", "N", -1, dense.MOTOR_THRUST, 4, limits.motor_thrust_min, hover)
    least = limits.specific_thrust_min
    yield _Quantity("specific thrust, least", "m/s²", -1, dense.SPECIFIC_THRUST, 1, least, GRAVITY)
    if space is not None:
        half = float((np.array(space.high) - np.array(space.low)).min()) / 2
        yield _Quantity(WALLS, "m", -1, dense.POSITION, 3, space.margin, half)


def _put_distances(position: NDArray, space: Space) -> None:
    """In place of positions, (3, N), how far from the walls of each axis they are; the least of them counts."""
    low, high = np.array(space.low)[:, None], np.array(space.high)[:, None]
    position -= (low + high) / 2
    np.abs(position, out=position)
    np.subtract((high - low) / 2, position, out=position)


def _plain(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _margin(peak: _Peak, time: float, position: Sequence[float]) -> Margin:
    quantity = peak.quantity
    worst = quantity.sign * peak.value
    room = quantity.limit - quantity.at_rest
    share = (worst - quantity.at_rest) / room if room * quantity.sign > 0 else math.inf
    x, y, z = position
    return Margin(
        name=quantity.name,
        unit=quantity.unit,
        worst=float(worst),
        limit=float(quantity.limit),
        share=max(0.0, float(share)) if math.isfinite(worst) and math.isfinite(quantity.limit) else math.nan,
        time=time,
        s=peak.s,
        position=(x, y, z),
    )


def _stretches(trajectory: Trajectory) -> Stretches:
    """Cut at the grid points, at the breaks of the path, and where the timing was refined because h changes fast."""
    timing, path = trajectory.timing, trajectory.path
    edges = np.concatenate([timing.s, path.breaks])
    edges.sort()
    edges = edges[np.append(True, np.diff(edges) > 1e-12 * edges[-1])]
    edges[-1] = timing.s[-1]
    width = np.diff(edges)
    middle = edges[:-1] + width / 2
    interval = timing.interval[np.searchsorted(timing.s, middle) - 1]
    piece = np.clip(np.searchsorted(path.breaks, middle) - 1, 0, len(path.breaks) - 2)
    h = trajectory.profile.at(edges[:-1] + np.array([[0.0], [0.25], [0.5], [0.75], [1.0]]) * width, interval).h
    needed = width / (TIME_STEP * np.sqrt(h.min(axis=0)))
    counts = np.maximum(np.ceil(needed).astype(int) + 1, LEAST_POINTS)
    return Stretches(edges[:-1], edges[1:], interval, piece, counts)


@njit(cache=True)
def _raise_peaks(values: NDArray, places: NDArray, table: NDArray, rows: NDArray, s: NDArray, counts: NDArray) -> None:
    """Take over the peaks of these samples where they are higher. `table`, (Q, 3): first row, how many, and sign."""
    for k in range(len(table)):
        if not np.isnan(values[k]):  # NaN is the worst and stays
            index, value = _peak(rows[table[k, 0] : table[k, 0] + table[k, 1]], table[k, 2], counts)
            if not value <= values[k]:
                values[k], places[k] = value, s[index]


@njit(cache=True)
def _peak(rows: NDArray, sign: int, counts: NDArray) -> tuple[int, float]:
    """Index of the largest of `sign` times (k, N) values, and that with what may rise above it between samples.

    Stretches have `counts` samples each, at least three, one stretch behind the other. NaN is larger than everything.
    """
    index, peak = 0, -np.inf
    for row in rows:
        end = 0
        for count in counts:
            start, end = end, end + count
            here, after = sign * row[start], sign * row[start + 1]
            # Each inner sample answers for both gaps beside it, so all gaps of the stretch are covered.
            for n in range(start + 1, end - 1):
                before, here, after = here, after, sign * row[n + 1]
                sag = 2.0 * here - before - after
                bound = max(before, here, after) + _ALLOWANCE * (0.0 if sag <= 0.0 else sag)
                if not bound <= peak:
                    peak = bound
                    index = n if here >= before and here >= after else n - 1 if before >= after else n + 1
                    if np.isnan(bound):
                        return n, peak
    return index, peak
