"""The proof before take-off: no limit is exceeded anywhere on a trajectory, between samples included.

The trajectory is cut at the grid points of its profile and at the breaks of its path, so that every piece is smooth,
and each piece is sampled from end to end, closed: at least ten points, and never further apart than a millisecond of
flight. Both sides of a grid point are thus seen, where h''' and ψ'' jump. Between two samples a smooth quantity exceeds
the larger of them by at most an eighth of its second difference there; that is added, twice over, to every worst value.
"""

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cfplan.safety.limits import PlanLimits
from cfplan.safety.space import Space
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.trajectory import FullState, Trajectory, state_at

TIME_STEP = 1e-3  # s, the most between two samples
BATCH = 20_000  # samples at a time, about
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
    # (N,) or (k, N) where k must keep the same limit
    limit: float
    at_rest: float
    # what it is in hover, which counts as share 0


class _Peak(NamedTuple):
    """The worst of one quantity."""

    quantity: _Quantity
    value: float
    # its sign times the value
    s: float
    position: NDArray


class _Pieces(NamedTuple):
    """Stretches of the trajectory on which everything is smooth, (K,) each."""

    left: NDArray
    right: NDArray
    interval: NDArray
    counts: NDArray
    # samples, ends included


def certify(trajectory: Trajectory, limits: PlanLimits, space: Space | None = None) -> Certificate:
    """Check every limit everywhere; the space too, where given. Never raises: what is not a number fails."""
    pieces = _pieces(trajectory)
    ends = np.cumsum(pieces.counts)
    worst: dict[str, _Peak] = {}
    for batch in np.split(np.arange(len(ends)), np.flatnonzero(np.diff(ends // BATCH)) + 1):
        s, interval, starts = _samples(pieces, batch)
        with np.errstate(all="ignore"):
            state = state_at(trajectory.path, trajectory.profile, trajectory.airframe, s, time=s, interval=interval)
            for quantity in _quantities(state, trajectory, limits, space):
                rows = np.ascontiguousarray(np.atleast_2d(quantity.sign * quantity.values))
                index, value = _peak(rows, starts, pieces.counts[batch])
                known = worst.get(quantity.name)
                if known is None or not value <= known.value:  # NaN is worse than everything and stays
                    worst[quantity.name] = known if known and np.isnan(known.value) else _Peak(
                        quantity, value, float(s[index]), state.position[index]
                    )  # fmt: skip
    return Certificate(
        margins=tuple(_margin(peak, trajectory) for peak in worst.values()),
        duration=trajectory.duration,
        samples=int(ends[-1]),
    )


def shares(trajectory: Trajectory, limits: PlanLimits, time: NDArray) -> dict[str, NDArray]:
    """How much of each limit is used at each time, (N,) each; counted as in the certificate, the walls left out."""
    quantities = _quantities(trajectory.at(time), trajectory, limits, None)
    return {
        quantity.name: ((np.atleast_2d(quantity.values) - quantity.at_rest) / (quantity.limit - quantity.at_rest)).max(
            axis=0
        )
        for quantity in quantities
    }


def _quantities(
    state: FullState, trajectory: Trajectory, limits: PlanLimits, space: Space | None
) -> Iterator[_Quantity]:
    hover = trajectory.airframe.hover_thrust
    tilt = np.arctan2(np.hypot(state.thrust_axis[:, 0], state.thrust_axis[:, 1]), state.thrust_axis[:, 2])
    motors = state.motor_thrust.T
    yield _Quantity("speed", "m/s", 1, _norm(state.velocity), limits.speed, 0.0)
    yield _Quantity("acceleration", "m/s²", 1, _norm(state.acceleration), limits.acceleration, 0.0)
    yield _Quantity("angular velocity", "rad/s", 1, _norm(state.body_rate), limits.angular_velocity, 0.0)
    if limits.angular_acceleration != math.inf:
        turning = _norm(state.angular_acceleration)
        yield _Quantity("angular acceleration", "rad/s²", 1, turning, limits.angular_acceleration, 0.0)
    yield _Quantity("tilt", "rad", 1, tilt, limits.tilt, 0.0)
    yield _Quantity("motor thrust, most", "N", 1, motors, limits.motor_thrust_max, 0.0)
    yield _Quantity("motor thrust, least", "N", -1, motors, limits.motor_thrust_min, hover)
    yield _Quantity("specific thrust, least", "m/s²", -1, state.specific_thrust, limits.specific_thrust_min, GRAVITY)
    if space is not None:
        low, high = np.array(space.low), np.array(space.high)
        middle, half = (low + high) / 2, (high - low) / 2
        # The walls of one axis after the other; the least of the distances is kept.
        distance = (half - np.abs(state.position - middle)).T
        yield _Quantity(WALLS, "m", -1, distance, space.margin, float(half.min()))


def _norm(vectors: NDArray) -> NDArray:
    return np.sqrt(np.einsum("ij,ij->i", vectors, vectors))


def _plain(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _margin(peak: _Peak, trajectory: Trajectory) -> Margin:
    quantity = peak.quantity
    worst = quantity.sign * peak.value
    room = quantity.limit - quantity.at_rest
    share = (worst - quantity.at_rest) / room if room * quantity.sign > 0 else np.inf
    x, y, z = (float(v) for v in peak.position)
    return Margin(
        name=quantity.name,
        unit=quantity.unit,
        worst=float(worst),
        limit=float(quantity.limit),
        share=max(0.0, float(share)) if np.isfinite(worst) and np.isfinite(quantity.limit) else float("nan"),
        time=float(trajectory.time_at(peak.s)),
        s=peak.s,
        position=(x, y, z),
    )


def _pieces(trajectory: Trajectory) -> _Pieces:
    """Cut at the grid points, at the breaks of the path, and where the timing was refined because h changes fast."""
    timing, path = trajectory.timing, trajectory.path
    edges = np.union1d(timing.s, path.breaks)
    edges = edges[np.r_[True, np.diff(edges) > 1e-12 * edges[-1]]]
    edges[-1] = timing.s[-1]
    width = np.diff(edges)
    interval = timing.interval[np.searchsorted(timing.s, edges[:-1] + width / 2) - 1]
    inside = [trajectory.profile.at(edges[:-1] + share * width, interval).h for share in (0.0, 0.25, 0.5, 0.75, 1.0)]
    needed = width / (TIME_STEP * np.sqrt(np.min(inside, axis=0)))
    counts = np.maximum(np.ceil(needed).astype(int) + 1, LEAST_POINTS)
    return _Pieces(edges[:-1], edges[1:], interval, counts)


def _samples(pieces: _Pieces, batch: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """s, (N,), the profile's interval of each, and where each piece starts."""
    left, right, interval, counts = (values[batch] for values in pieces)
    starts = np.cumsum(counts) - counts
    piece = np.repeat(np.arange(len(counts)), counts)
    share = (np.arange(len(piece)) - starts[piece]) / (counts[piece] - 1)
    s = left[piece] + share * (right - left)[piece]
    # The last sample of a piece must fall on its own side of a break of the path.
    s[starts + counts - 1] = np.nextafter(right, -np.inf)
    return s, interval[piece], starts


@njit(cache=True)
def _peak(rows: NDArray, starts: NDArray, counts: NDArray) -> tuple[int, float]:
    """Index of the largest of (k, N) values, and that value with what may rise above it between samples.

    Pieces begin at `starts` and have `counts` samples each, at least three. NaN is larger than everything.
    """
    index, peak = 0, -np.inf
    for row in rows:
        for piece in range(len(starts)):
            start, count = starts[piece], counts[piece]
            # Each inner sample answers for both gaps beside it, so all gaps of the piece are covered.
            for n in range(start + 1, start + count - 1):
                before, here, after = row[n - 1], row[n], row[n + 1]
                sag = 2.0 * here - before - after
                bound = max(before, here, after) + _ALLOWANCE * (0.0 if sag <= 0.0 else sag)
                if not bound <= peak:
                    peak = bound
                    index = n if here >= before and here >= after else n - 1 if before >= after else n + 1
                    if np.isnan(bound):
                        return n, peak
    return index, peak
