"""When the vehicle is where: t(s) = ∫ ds/√h and its inverse, both within 1e-9.

Each interval of the profile is split until eight-point Gauss-Legendre quadrature agrees with itself on the two halves
and until a polynomial of degree 7 in time, which matches s and three time derivatives at both ends, gives s(t) back.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cfplan.errors import NotCertifiedError
from cfplan.vehicle.profile import SpeedProfile

TOLERANCE = 1e-12  # s, of each piece
LONGEST = 3600.0  # s, beyond which a profile is a mistake
_SPLITS = 40  # halvings of an interval before its speed counts as zero
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
_NODES, _WEIGHTS = (_NODES + 1.0) / 2.0, _WEIGHTS / 2.0
_PROBES = np.array([0.2, 0.5, 0.8])  # where in a piece the inverse is tried
# Coefficients 4 to 7 of a polynomial on [0, 1] from what is left of it and three derivatives at 1.
_FAR_END = np.linalg.inv(np.array([[1, 1, 1, 1], [4, 5, 6, 7], [12, 20, 30, 42], [24, 60, 120, 210]], dtype=float))


@dataclass(frozen=True, slots=True)
class Timing:
    """The map between s and time in K pieces, each within one interval of the profile."""

    profile: SpeedProfile
    s: NDArray
    # (K+1,)
    time: NDArray
    # (K+1,) s, from 0 to the duration
    interval: NDArray
    # (K,) of the profile
    polynomial: NDArray
    # (8, K) s less that of the piece's start, by the share of the piece's duration

    def time_at(self, s: ArrayLike) -> NDArray:
        """s of time at which the vehicle is at s."""
        places = np.clip(np.asarray(s, dtype=float), self.s[0], self.s[-1])
        piece = _piece(self.s, places)
        return self.time[piece] + _quadrature(self.profile, self.interval[piece], self.s[piece], places)

    def s_at(self, time: ArrayLike) -> NDArray:
        """Where on the path the vehicle is at each time."""
        times = np.clip(np.asarray(time, dtype=float), 0.0, self.time[-1])
        piece = _piece(self.time, times)
        share = (times - self.time[piece]) / (self.time[piece + 1] - self.time[piece])
        offset = _horner(self.polynomial[:, piece], share)
        return np.clip(self.s[piece] + offset, self.s[piece], self.s[piece + 1])


def measure(profile: SpeedProfile) -> Timing:
    """The timing of a profile. Raises NotCertifiedError where h is not positive or not smooth."""
    check(profile)
    left, right, interval = profile.s[:-1], profile.s[1:], np.arange(len(profile.s) - 1)
    pieces: list[tuple[NDArray, NDArray, NDArray, NDArray, NDArray]] = []
    for _ in range(_SPLITS):
        middle = (left + right) / 2.0
        duration = _quadrature(profile, interval, left, right)
        halves = _quadrature(profile, interval, left, middle) + _quadrature(profile, interval, middle, right)
        polynomial = _inverse(profile, interval, left, right, duration)
        good = (np.abs(duration - halves) < TOLERANCE + 1e-14 * duration) & (
            _inverse_error(profile, interval, left, duration, polynomial) < 1e-10
        )
        pieces.append((left[good], right[good], interval[good], duration[good], polynomial[:, good]))
        left, middle, right, interval = (values[~good] for values in (left, middle, right, interval))
        if not len(left):
            break
        left, right, interval = np.r_[left, middle], np.r_[middle, right], np.r_[interval, interval]
    else:
        raise NotCertifiedError("the speed falls to almost zero", where=f"s = {left[0]:.6g}")
    left, right, interval, duration = (np.concatenate([piece[k] for piece in pieces]) for k in range(4))
    order = np.argsort(left)
    total = float(duration.sum())
    if not total <= LONGEST:
        raise NotCertifiedError(f"the speed profile takes {total:.0f} s, longer than any flight")
    return Timing(
        profile=profile,
        s=np.r_[left[order], right[order[-1]]],
        time=np.r_[0.0, np.cumsum(duration[order])],
        interval=interval[order],
        polynomial=np.concatenate([piece[4] for piece in pieces], axis=1)[:, order],
    )


def check(profile: SpeedProfile) -> None:
    """Raises NotCertifiedError unless the profile is finite, smooth as it promises, and h positive everywhere."""
    intervals = len(profile.s) - 1
    for name in SpeedProfile.__slots__:
        values = getattr(profile, name)
        if values.shape != (intervals + (name not in ("dddh", "ddyaw")),) or intervals < 1:
            raise NotCertifiedError(f"the speed profile has {values.shape} values of {name} for {intervals} intervals")
        if not np.all(np.isfinite(values)):
            raise NotCertifiedError(
                f"the speed profile's {name} is not finite", where=_node(profile, ~np.isfinite(values))
            )
    if not np.all(np.diff(profile.s) > 0):
        raise NotCertifiedError("the speed profile's grid does not ascend")
    least = _least(profile)
    if not np.all(least > 0):
        raise NotCertifiedError("the speed profile falls to zero or below", where=_node(profile, ~(least > 0)))
    before = profile.at(profile.s[1:], np.arange(intervals))
    for name in ("h", "dh", "ddh", "yaw", "dyaw"):
        values = getattr(profile, name)
        jump = np.abs(getattr(before, name) - values[1:])
        if not np.all(jump <= 1e-6 * (1.0 + np.max(np.abs(values)))):
            raise NotCertifiedError(
                f"the speed profile's {name} jumps", where=_node(profile, np.r_[0.0, jump] == jump.max())
            )


def _node(profile: SpeedProfile, bad: NDArray) -> str:
    index = int(np.flatnonzero(bad)[0])
    return f"node {index}, s = {profile.s[index]:.6g}"


def _least(profile: SpeedProfile) -> NDArray:
    """(N,) the least h in each interval: at its ends or where h' = 0."""
    width = np.diff(profile.s)
    slope, bend, jerk = profile.dh[:-1], profile.ddh[:-1], profile.dddh
    root = np.sqrt(np.maximum(bend * bend - 2.0 * jerk * slope, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        # Both roots of h', each in the form that does not cancel.
        far = -(bend + np.copysign(root, bend))
        roots = np.stack([far / jerk, 2.0 * slope / far])
    inner = np.where(np.isfinite(roots), np.clip(roots, 0.0, width), 0.0)
    places = np.concatenate([inner, np.zeros((1, len(width))), width[None]])
    h = profile.h[:-1] + places * (slope + places * (bend / 2 + places * jerk / 6))
    return h.min(axis=0)


def _piece(edges: NDArray, values: NDArray) -> NDArray:
    return np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)


def _quadrature(profile: SpeedProfile, interval: NDArray, left: NDArray, right: NDArray) -> NDArray:
    """s of time from `left` to `right`, both in `interval`."""
    width = np.asarray(right - left)
    x = (left - profile.s[interval])[..., None] + width[..., None] * _NODES
    h, dh, ddh, dddh = (v[interval][..., None] for v in (profile.h, profile.dh, profile.ddh, profile.dddh))
    return width * ((h + x * (dh + x * (ddh / 2 + x * dddh / 6))) ** -0.5 @ _WEIGHTS)


def _inverse(profile: SpeedProfile, interval: NDArray, left: NDArray, right: NDArray, duration: NDArray) -> NDArray:
    """(8, K) coefficients of s(t): ds/dt = √h, d²s/dt² = h'/2, d³s/dt³ = √h h''/2."""
    near, far = (_time_derivatives(profile, interval, place, duration) for place in (left, right))
    low = np.stack([np.zeros_like(left), near[0], near[1] / 2.0, near[2] / 6.0])
    missing = np.stack(
        [
            right - left - low.sum(axis=0),
            far[0] - (low[1] + 2.0 * low[2] + 3.0 * low[3]),
            far[1] - (2.0 * low[2] + 6.0 * low[3]),
            far[2] - 6.0 * low[3],
        ]
    )
    return np.concatenate([low, _FAR_END @ missing])


def _time_derivatives(profile: SpeedProfile, interval: NDArray, s: NDArray, unit: NDArray) -> tuple[NDArray, ...]:
    """The first three time derivatives of s, with time in units of `unit`."""
    sample = profile.at(s, interval)
    speed = np.sqrt(sample.h)
    return speed * unit, sample.dh / 2.0 * unit**2, speed * sample.ddh / 2.0 * unit**3


def _inverse_error(
    profile: SpeedProfile, interval: NDArray, left: NDArray, duration: NDArray, polynomial: NDArray
) -> NDArray:
    """The most by which the inverse misses at the probes, the larger of s and of seconds."""
    offset = _horner(polynomial[:, :, None], _PROBES)
    x = (left - profile.s[interval])[:, None] + offset
    h, dh, ddh, dddh = (v[interval][:, None] for v in (profile.h, profile.dh, profile.ddh, profile.dddh))
    with np.errstate(invalid="ignore"):
        speed = np.sqrt(h + x * (dh + x * (ddh / 2 + x * dddh / 6)))
        start = np.broadcast_to(left[:, None], offset.shape)
        which = np.broadcast_to(interval[:, None], offset.shape)
        reached = _quadrature(profile, which, start, start + offset)
        late = np.abs(reached - duration[:, None] * _PROBES) * np.maximum(1.0, speed)
    return np.where(np.isfinite(late), late, np.inf).max(axis=1)


def _horner(coefficients: NDArray, x: NDArray) -> NDArray:
    value = coefficients[-1]
    for coefficient in coefficients[-2::-1]:
        value = value * x + coefficient
    return value
