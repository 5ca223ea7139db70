"""Timing: t(s) = ∫ ds/√h and its inverse, both within 1e-9.

Each interval of the profile is split until eight-point Gauss-Legendre quadrature agrees with itself on the two halves
and until a polynomial of degree 7 in time, which matches s and three time derivatives at both ends, gives s(t) back.
"""

from dataclasses import dataclass

import numpy as np
from numba.extending import register_jitable
from numpy.typing import ArrayLike, NDArray

from cfplan.errors import NotCertifiedError
from cfplan.geometry.polynomials import intervals_of
from cfplan.machine_code import njit
from cfplan.vehicle.profile import SpeedProfile, h_within, yaw_within

TOLERANCE = 1e-12  # s, of each piece
LONGEST = 3600.0  # s; a longer profile is an error
_REMEDY = "plan the path anew; for a profile from elsewhere, h must be positive and smooth"
_SPLITS = 40  # halvings of an interval before its speed counts as zero
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
_NODES, _WEIGHTS = (_NODES + 1.0) / 2.0, _WEIGHTS / 2.0
_PROBES = (0.2, 0.5, 0.8)  # places in a piece where the inverse is checked
_CONTINUOUS = (1, 2, 3, 5, 6)  # columns of a profile's table that must not jump: h, h', h'', yaw, yaw'
_JUMP = 1e-6  # relative tolerance of jumps, for rounding
# Coefficients 4 to 7 of a polynomial on [0, 1] from what is left of it and three derivatives at 1.
_FAR_END = np.linalg.inv(np.array([[1, 1, 1, 1], [4, 5, 6, 7], [12, 20, 30, 42], [24, 60, 120, 210]], dtype=float))


@dataclass(frozen=True, slots=True)
class Timing:
    """The map between s and time in K pieces, each within one interval of the profile."""

    profile: SpeedProfile
    s: NDArray  # (K+1,)
    time: NDArray  # (K+1,) s, from 0 to the duration
    interval: NDArray  # (K,) of the profile
    polynomial: NDArray  # (K, 8) s less that of the piece's start, by the share of the piece's duration
    nodes: NDArray  # the profile as its table() has it

    def time_at(self, s: ArrayLike) -> NDArray:
        """Return the time, s, at which the vehicle is at s."""
        places = np.array(s, dtype=float)
        return _times(self.s, self.time, self.interval, self.nodes, places.ravel()).reshape(places.shape)

    def s_at(self, time: ArrayLike) -> NDArray:
        """Return where on the path the vehicle is at each time."""
        times = np.array(time, dtype=float)
        return _places(self.s, self.time, self.polynomial, times.ravel()).reshape(times.shape)


def measure(profile: SpeedProfile) -> Timing:
    """Measure the timing of a profile. Raises NotCertifiedError where h is not positive or not smooth."""
    nodes = check(profile)
    left, duration, interval, polynomial, stuck = _split(nodes)
    if not np.isnan(stuck):
        raise NotCertifiedError("the speed falls to almost zero", where=f"s = {stuck:.6g}", hint=_REMEDY)
    s, time = _edges(left, duration, profile.s[-1])
    total = float(time[-1])
    if not total <= LONGEST:
        raise NotCertifiedError(
            f"the speed profile takes {total:.0f} s, longer than any flight", where="the whole path", hint=_REMEDY
        )
    return Timing(profile=profile, s=s, time=time, interval=interval, polynomial=polynomial, nodes=nodes)


@njit
def _edges(left: NDArray, duration: NDArray, end: float) -> tuple[NDArray, NDArray]:
    """Return where pieces begin and the last one ends, and when, (K+1,) each."""
    s, time = np.empty(len(left) + 1), np.zeros(len(left) + 1)
    for k in range(len(left)):
        s[k], time[k + 1] = left[k], time[k] + duration[k]
    s[len(left)] = end
    return s, time


def duration_of(profile: SpeedProfile) -> float:
    """Return the time, s, that a profile takes, by one quadrature an interval.

    It is within 1e-6 of the duration if h changes less than tenfold per interval. Raises NotCertifiedError like
    measure(), except for speeds that fall to almost zero.
    """
    return float(_duration(check(profile)))


def check(profile: SpeedProfile) -> NDArray:
    """Return the profile's table. Raises NotCertifiedError unless it is finite and smooth, and h is positive."""
    intervals = len(profile.s) - 1
    for name in SpeedProfile.__slots__:
        values = getattr(profile, name)
        if values.shape != (intervals + (name not in ("dddh", "ddyaw")),) or intervals < 1:
            raise NotCertifiedError(
                f"the speed profile has {values.shape} values of {name} for {intervals} intervals",
                where="the whole path",
                hint=_REMEDY,
            )
    nodes = profile.table()
    sound, least, jumps, allowed = _inspect(nodes)
    if sound:
        return nodes
    wrong = ~np.isfinite(nodes)
    if wrong.any():
        column = int(np.argmax(wrong.any(axis=0)))
        raise NotCertifiedError(
            f"the speed profile's {SpeedProfile.__slots__[column]} is not finite",
            where=_node(nodes, wrong[:, column]),
            hint=_REMEDY,
        )
    if not np.all(np.diff(nodes[:, 0]) > 0):
        raise NotCertifiedError("the speed profile's grid does not ascend", where="the whole path", hint=_REMEDY)
    if not np.all(least > 0):
        raise NotCertifiedError(
            "the speed profile falls to zero or below", where=_node(nodes, ~(least > 0)), hint=_REMEDY
        )
    for column, jump, limit in zip(_CONTINUOUS, jumps.T, allowed, strict=True):
        if not np.all(jump <= limit):
            raise NotCertifiedError(
                f"the speed profile's {SpeedProfile.__slots__[column]} jumps",
                where=_node(nodes, np.append(0.0, jump) == jump.max()),
                hint=_REMEDY,
            )
    return nodes


def _node(nodes: NDArray, bad: NDArray) -> str:
    index = int(np.flatnonzero(bad)[0])
    return f"node {index}, s = {nodes[index, 0]:.6g}"


@njit(error_model="numpy")
def _inspect(nodes: NDArray) -> tuple[bool, NDArray, NDArray, NDArray]:
    """Return whether the profile is valid; the least h in each interval, (N,); jumps at its end, (N, 5), and their
    tolerances, (5,), of h, h', h'', yaw and yaw'."""
    count = len(nodes) - 1
    least, jumps, allowed = np.empty(count), np.empty((count, 5)), np.zeros(5)
    for k in range(count + 1):
        for j in range(5):
            allowed[j] = max(allowed[j], abs(nodes[k, _CONTINUOUS[j]]))
    for j in range(5):
        allowed[j] = _JUMP * (1.0 + allowed[j])
    for k in range(count):
        node, after = nodes[k], nodes[k + 1]
        slope, bend, jerk, x = node[2], node[3], node[4], after[0] - node[0]
        # h is least at an end or where h' = 0: both roots, each in the form that does not cancel.
        far = -(bend + np.copysign(np.sqrt(max(bend * bend - 2.0 * jerk * slope, 0.0)), bend))
        least[k] = min(node[1], _h(node, after[0]))
        for root in (far / jerk, 2.0 * slope / far):
            if np.isfinite(root):
                least[k] = min(least[k], _h(node, node[0] + min(max(root, 0.0), x)))
        h, dh, ddh, _ = h_within(x, node[1], slope, bend, jerk)
        yaw, dyaw, _ = yaw_within(x, node[5], node[6], node[7])
        jumps[k, 0], jumps[k, 1], jumps[k, 2] = abs(h - after[1]), abs(dh - after[2]), abs(ddh - after[3])
        jumps[k, 3], jumps[k, 4] = abs(yaw - after[5]), abs(dyaw - after[6])
    sound = True
    for k in range(count):
        sound = sound and nodes[k + 1, 0] > nodes[k, 0] and least[k] > 0.0
        for j in range(5):
            sound = sound and jumps[k, j] <= allowed[j]
    for k in range(count + 1):
        for j in range(nodes.shape[1]):
            sound = sound and np.isfinite(nodes[k, j])
    return sound, least, jumps, allowed


@njit(error_model="numpy")
def _split(nodes: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray, float]:
    """Return start, duration, interval and inverse of each piece; and the s where splitting failed, else NaN."""
    room = 2 * len(nodes) + 100
    starts, durations, polynomials = np.empty(room), np.empty(room), np.empty((room, 8))
    parts = np.empty(len(_NODES))
    intervals = np.empty(room, dtype=np.int64)
    ends, depths = np.empty(_SPLITS + 1), np.empty(_SPLITS + 1, dtype=np.int64)  # right ends of the pending parts
    count = 0
    for k in range(len(nodes) - 1):
        node, left, waiting = nodes[k], nodes[k, 0], 1
        ends[0], depths[0] = nodes[k + 1, 0], 0
        while waiting:
            right, depth = ends[waiting - 1], depths[waiting - 1]
            if count == len(starts):
                starts, durations, intervals = _longer(starts), _longer(durations), _longer(intervals)
                more = np.empty((2 * len(polynomials), 8))
                for row in range(count):
                    for column in range(8):
                        more[row, column] = polynomials[row, column]
                polynomials = more
            middle = (left + right) / 2.0
            duration = _quadrature(parts, node, left, right)
            halves = _quadrature(parts, node, left, middle) + _quadrature(parts, node, middle, right)
            _invert(polynomials[count], node, left, right, duration)
            good = abs(duration - halves) < TOLERANCE + 1e-14 * duration
            if good and _inverse_error(polynomials[count], node, left, duration, parts) < 1e-10:
                starts[count], durations[count], intervals[count] = left, duration, k
                count += 1
                left = right
                waiting -= 1
            elif depth + 1 == _SPLITS:
                return starts[:0], durations[:0], intervals[:0], polynomials[:0], left
            else:
                depths[waiting - 1] = depth + 1
                ends[waiting], depths[waiting] = middle, depth + 1
                waiting += 1
    return starts[:count], durations[:count], intervals[:count], polynomials[:count], np.nan


@register_jitable
def _longer(array: NDArray) -> NDArray:
    """Return a copy, (2 N,), whose second half is to be filled in."""
    out = np.empty(2 * len(array), array.dtype)
    for n in range(len(array)):
        out[n] = array[n]
    return out


@njit(error_model="numpy")
def _duration(nodes: NDArray) -> float:
    total, parts = 0.0, np.empty(len(_NODES))
    for k in range(len(nodes) - 1):
        total += _quadrature(parts, nodes[k], nodes[k, 0], nodes[k + 1, 0])
    return total


@njit(error_model="numpy")
def _times(edges: NDArray, time: NDArray, interval: NDArray, nodes: NDArray, places: NDArray) -> NDArray:
    places = np.minimum(np.maximum(places, edges[0]), edges[-1])
    piece, out, parts = intervals_of(edges, places), np.empty(len(places)), np.empty(len(_NODES))
    for n in range(len(places)):
        k = piece[n]
        out[n] = time[k] + _quadrature(parts, nodes[interval[k]], edges[k], places[n])
    return out


@njit(error_model="numpy")
def _places(edges: NDArray, time: NDArray, polynomial: NDArray, times: NDArray) -> NDArray:
    times = np.minimum(np.maximum(times, 0.0), time[-1])
    piece, out = intervals_of(time, times), np.empty(len(times))
    for n in range(len(times)):
        k = piece[n]
        offset = _horner(polynomial[k], (times[n] - time[k]) / (time[k + 1] - time[k]))
        out[n] = min(max(edges[k] + offset, edges[k]), edges[k + 1])
    return out


@njit(error_model="numpy")
def _h(node: NDArray, s: float) -> float:
    """Return h at s in the interval that begins with this row of a profile's table."""
    x = s - node[0]
    return h_within(x, node[1], node[2], node[3], node[4])[0]


@njit(error_model="numpy")
def _quadrature(parts: NDArray, node: NDArray, left: float, right: float) -> float:
    """Return the time, s, from `left` to `right`, both in the interval; `parts`, (8,), are to be overwritten.

    The compiler vectorises it.
    """
    width = right - left
    for k in range(len(_NODES)):
        parts[k] = _WEIGHTS[k] / np.sqrt(_h(node, left + width * _NODES[k]))
    total = 0.0
    for k in range(len(_NODES)):
        total += parts[k]
    return width * total


@njit(error_model="numpy")
def _invert(polynomial: NDArray, node: NDArray, left: float, right: float, duration: float) -> None:
    """Write the coefficients of s(t): ds/dt = √h, d²s/dt² = h'/2, d³s/dt³ = √h h''/2."""
    near, far = _time_derivatives(node, left, duration), _time_derivatives(node, right, duration)
    low1, low2, low3 = near[0], near[1] / 2.0, near[2] / 6.0
    polynomial[0], polynomial[1], polynomial[2], polynomial[3] = 0.0, low1, low2, low3
    missing = (
        right - left - (low1 + low2 + low3),
        far[0] - (low1 + 2.0 * low2 + 3.0 * low3),
        far[1] - (2.0 * low2 + 6.0 * low3),
        far[2] - 6.0 * low3,
    )
    for row in range(4):
        polynomial[4 + row] = 0.0
        for column in range(4):
            polynomial[4 + row] += _FAR_END[row, column] * missing[column]


@njit(error_model="numpy")
def _time_derivatives(node: NDArray, s: float, unit: float) -> tuple[float, float, float]:
    """Return the first three time derivatives of s, with time in units of `unit`."""
    h, dh, ddh, _ = h_within(s - node[0], node[1], node[2], node[3], node[4])
    speed = np.sqrt(h)
    return speed * unit, dh / 2.0 * unit**2, speed * ddh / 2.0 * unit**3


@njit(error_model="numpy")
def _inverse_error(polynomial: NDArray, node: NDArray, left: float, duration: float, parts: NDArray) -> float:
    """Return the largest error of the inverse at the probes, the larger of s and of seconds."""
    worst = 0.0
    for share in _PROBES:
        place = left + _horner(polynomial, share)
        late = abs(_quadrature(parts, node, left, place) - duration * share) * max(1.0, np.sqrt(_h(node, place)))
        if not late <= worst:
            worst = late if np.isfinite(late) else np.inf
    return worst


@njit(error_model="numpy")
def _horner(coefficients: NDArray, x: float) -> float:
    value = 0.0
    for k in range(len(coefficients) - 1, -1, -1):
        value = value * x + coefficients[k]
    return value
