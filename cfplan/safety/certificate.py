"""The proof before take-off: no limit is exceeded anywhere on a trajectory, between samples included.

The trajectory is cut at the grid points of its profile and at the breaks of its path, so that every piece is smooth,
and each piece is sampled from end to end, closed: at least ten points, and never further apart than a millisecond of
flight. Both sides of a grid point are thus seen, where h''' and ψ'' jump. Between two samples a smooth quantity exceeds
the larger of them by at most an eighth of its second difference there; that is added, twice over, to every worst value.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
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
BATCH = 4_000  # samples at a time, about: as many as stay near the processor
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
    values: NDArray
    # (k, N), of which all must keep the same limit
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
    stretches = _stretches(trajectory)
    ends = np.cumsum(stretches.counts)
    worst: dict[str, _Peak] = {}
    first = 0
    for last in [*(1 + np.flatnonzero(np.diff(ends // BATCH))).tolist(), len(ends)]:
        batch = Stretches(*(values[first:last] for values in stretches))
        rows = sampled_rows(trajectory.airframe, trajectory.path, trajectory.profile, batch)
        for quantity in _quantities(rows, trajectory.airframe.hover_thrust, limits, space):
            index, value = _peak(quantity.values, quantity.sign, batch.counts)
            known = worst.get(quantity.name)
            if known is None or not (np.isnan(known.value) or value <= known.value):  # NaN is the worst and stays
                worst[quantity.name] = _Peak(quantity, value, float(rows[dense.PLACE, index]))
        first = last
    places = np.array([peak.s for peak in worst.values()])
    when, where = trajectory.time_at(places).tolist(), trajectory.path(places).tolist()
    return Certificate(
        margins=tuple(_margin(*each) for each in zip(worst.values(), when, where, strict=True)),
        duration=trajectory.duration,
        samples=int(ends[-1]),
    )


def shares(trajectory: Trajectory, limits: PlanLimits, time: NDArray) -> dict[str, NDArray]:
    """How much of each limit is used at each time, (N,) each; counted as in the certificate, the walls left out."""
    rows = _rows(trajectory.at(time))
    return {
        quantity.name: ((quantity.values - quantity.at_rest) / (quantity.limit - quantity.at_rest)).max(axis=0)
        for quantity in _quantities(rows, trajectory.airframe.hover_thrust, limits, None)
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


def _quantities(rows: NDArray, hover: float, limits: PlanLimits, space: Space | None) -> Iterator[_Quantity]:
    def part(first: int, count: int = 1) -> NDArray:
        return rows[first : first + count]

    motors = part(dense.MOTOR_THRUST, 4)
    yield _Quantity("speed", "m/s", 1, part(dense.SPEED), limits.speed, 0.0)
    yield _Quantity("acceleration", "m/s²", 1, part(dense.ACCELERATION), limits.acceleration, 0.0)
    yield _Quantity("angular velocity", "rad/s", 1, part(dense.BODY_RATE), limits.angular_velocity, 0.0)
    if limits.angular_acceleration != math.inf:
        turning = part(dense.ANGULAR_ACCELERATION)
        yield _Quantity("angular acceleration", "rad/s²", 1, turning, limits.angular_acceleration, 0.0)
    yield _Quantity("tilt", "rad", 1, part(dense.TILT), limits.tilt, 0.0)
    yield _Quantity("motor thrust, most", "N", 1, motors, limits.motor_thrust_max, 0.0)
    yield _Quantity("motor thrust, least", "N", -1, motors, limits.motor_thrust_min, hover)
    specific = part(dense.SPECIFIC_THRUST)
    yield _Quantity("specific thrust, least", "m/s²", -1, specific, limits.specific_thrust_min, GRAVITY)
    if space is not None:
        low, high = np.array(space.low), np.array(space.high)
        middle, half = (low + high) / 2, (high - low) / 2
        # The walls of one axis after the other; the least of the distances is kept.
        distance = half[:, None] - np.abs(part(dense.POSITION, 3) - middle[:, None])
        yield _Quantity(WALLS, "m", -1, distance, space.margin, float(half.min()))


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
