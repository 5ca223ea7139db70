"""The measures that limits bind at thousands of points, some 40 ns each; and full states, which take twice that.

Points are taken side by side, up to WIDTH at a time. A panel holds rows of one quantity each, WIDTH long, one behind
the other in one array: so the compiler knows that they do not overlap, and works on several points with one
instruction. How many places of the rows are in use is known at run time only, else it would write the loops out.
"""

from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.geometry.path import Derivatives, Path, horner_step
from cfplan.machine_code import njit
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.flatness import ROUNDING, Body, Flat, compiled_body, flat_state
from cfplan.vehicle.measures import MEASURES, measures
from cfplan.vehicle.profile import SpeedProfile, h_within, yaw_within
from cfplan.vehicle.rotations import hopf_quaternion
from cfplan.vehicle.trigonometry import cosine, sine

# Rows of what `sample` gives: the measures, and
POSITION = MEASURES  # m, and the two rows behind
PLACE = MEASURES + 3  # s
SAMPLED_ROWS = MEASURES + 4

# What `flat_states` gives, by row.
STATES: dict[str, slice | int] = {
    "position": slice(0, 3), "velocity": slice(3, 6), "acceleration": slice(6, 9), "jerk": slice(9, 12),
    "snap": slice(12, 15), "thrust_axis": slice(15, 18), "body_rate": slice(18, 21),
    "angular_acceleration": slice(21, 24), "torque": slice(24, 27), "motor_thrust": slice(27, 31),
    "quaternion": slice(31, 35), "yaw": 35, "specific_thrust": 36,
}  # fmt: skip
STATE_ROWS = 37

_WHOLE, _THRUST, _RATE, _ACCELERATION = 0, 1, 2, 3  # parts of the full state
_FIND = np.empty(0, dtype=np.int64)  # in place of intervals: they are to be found

WIDTH = 64
LANES = 4  # points that the compiler may want to take at once: the places in use are a multiple
# Rows of a panel: γ to γ'''', the place in the interval, the profile where that begins, and the results.
_CURVE, _X, _NODE, _RESULT = 0, 15, 16, 23
_SIZE = (_RESULT + STATE_ROWS) * WIDTH
_BLOCK = 8  # coefficients at a time
# h with three derivatives and yaw with two, where an interval begins.
_Node = tuple[float, float, float, float, float, float, float]


class Segments(NamedTuple):
    """Parts of a flight on which everything is smooth, (K,) each, and how many samples are taken of each."""

    left: NDArray  # s
    right: NDArray  # s
    interval: NDArray  # of the profile
    piece: NDArray  # of the path
    counts: NDArray  # samples, evenly spaced, both ends included; at least two


class SampleSource(NamedTuple):
    """The part of a trajectory that sample() reads, in a form that compiles."""

    body: Body
    coefficients: NDArray  # (M, D, 3) of the path, D a multiple of _BLOCK
    origins: NDArray  # (M,) of its pieces
    nodes: NDArray  # the profile as its table() has it


def dense_rows(
    airframe: Airframe, derivatives: NDArray, profile: SpeedProfile, places: NDArray, interval: NDArray
) -> NDArray:
    """Return the measures, (MEASURES, N), at N points of a path, whose `derivatives` γ' to γ'''', (4, 3, N), are known.

    `places`, (N,), is s less that of the grid point at which each point's `interval`, (N,), begins.
    """
    count = len(places)
    if count < LANES:  # the first point again and again
        more = np.r_[:count, np.zeros(LANES - count, dtype=int)]
        return dense_rows(airframe, derivatives[:, :, more], profile, places[more], interval[more])[:, :count]
    out = np.empty((MEASURES, count))
    curves = np.ascontiguousarray(derivatives, dtype=float).reshape(12, count)
    _at_points(out, compiled_body(airframe), curves, profile.table(), places, interval)
    return out


def flat_states(source: SampleSource, breaks: NDArray, s: NDArray, interval: NDArray | None = None) -> NDArray:
    """Return (STATE_ROWS, N): position, the full state, and the attitude at each s, (N,); `breaks` are the path's.

    `interval` tells whose polynomials of the profile hold, that on the right of a grid point where it is not given; a
    break of the path belongs to the piece on its right.
    """
    return _filled(STATE_ROWS, _WHOLE, source, breaks, s, interval)


def thrusts_at(source: SampleSource, breaks: NDArray, s: NDArray) -> NDArray:
    """Return the specific thrust, (1, N) m/s², at each s, (N,), and nothing else of the full state."""
    return _filled(1, _THRUST, source, breaks, s)


def body_rates_at(source: SampleSource, breaks: NDArray, s: NDArray) -> NDArray:
    """Return the body rates, (3, N) rad/s, at each s, (N,), and nothing else of the full state."""
    return _filled(3, _RATE, source, breaks, s)


def accelerations_at(source: SampleSource, breaks: NDArray, s: NDArray) -> NDArray:
    """Return the acceleration, (3, N) m/s², at each s, (N,), and nothing else of the full state."""
    return _filled(3, _ACCELERATION, source, breaks, s)


def _filled(
    rows: int, part: int, source: SampleSource, breaks: NDArray, s: NDArray, interval: NDArray | None = None
) -> NDArray:
    out, (body, coefficients, origins, nodes) = np.empty((rows, len(s))), source
    _states(out, part, body, breaks, origins, coefficients, nodes, s, _FIND if interval is None else interval)
    return out


def sample_source(airframe: Airframe, path: Path, profile: SpeedProfile) -> SampleSource:
    """Return what sample() reads of a trajectory."""
    return SampleSource(compiled_body(airframe), _whole_blocks(path.coefficients), path.origins, profile.table())


def _whole_blocks(coefficients: NDArray) -> NDArray:
    """Return a path's coefficients, (M, D, 3), with D a multiple of _BLOCK."""
    if missing := -coefficients.shape[1] % _BLOCK:
        pieces, degrees, axes = coefficients.shape
        whole = np.zeros((pieces, degrees + missing, axes))
        whole[:, :degrees] = coefficients
        whole.setflags(write=False)  # as a path's are: one type for the compiler
        return whole
    return coefficients


@njit(error_model="numpy", fastmath=ROUNDING)
def _at_points(
    out: NDArray, body: Body, derivatives: NDArray, nodes: NDArray, places: NDArray, interval: NDArray
) -> None:
    panel = np.empty(_SIZE)
    for start in range(0, len(places), WIDTH):
        lanes = min(WIDTH, _whole(len(places) - start))
        begin = min(start, len(places) - lanes)
        _place(panel, 3, derivatives, nodes, places, interval, begin, lanes)
        _flatten(panel, body, lanes)
        for row in range(MEASURES):
            for n in range(lanes):
                out[row, begin + n] = panel[(_RESULT + row) * WIDTH + n]


@njit(error_model="numpy", fastmath=ROUNDING, nogil=True)
def _states(
    out: NDArray, part: int, body: Body, breaks: NDArray, origins: NDArray, coefficients: NDArray, nodes: NDArray,
    s: NDArray, given: NDArray,
) -> None:  # fmt: skip
    """Fill in a part of the full state, consecutive points of one piece of the path together, up to WIDTH of them.

    Each point lies in the interval of the profile that is `given`; where none are, they are found.
    """
    panel = np.empty(_SIZE)
    begin, piece, interval, last, finds = 0, 0, 0, len(origins) - 1, len(given) != len(s)
    while begin < len(s):
        if s[begin] < breaks[piece]:
            piece = 0
        while piece < last and s[begin] >= breaks[piece + 1]:
            piece += 1
        count, room = 1, min(WIDTH, len(s) - begin)
        while (
            count < room
            and (piece == 0 or breaks[piece] <= s[begin + count])
            and (piece == last or s[begin + count] < breaks[piece + 1])
        ):
            count += 1
        lanes = min(_whole(count), WIDTH)
        for n in range(lanes):  # those beyond the last point repeat it
            panel[_X * WIDTH + n] = min(max(s[begin + min(n, count - 1)], 0.0), breaks[-1]) - origins[piece]
        _trace(panel, coefficients[piece], lanes)
        for n in range(lanes):
            at = begin + min(n, count - 1)
            interval = _interval(nodes, s[at], interval) if finds else given[at]
            panel[_X * WIDTH + n] = s[at] - nodes[interval, 0]
            for row in range(7):
                panel[(_NODE + row) * WIDTH + n] = nodes[interval, 1 + row]
        _flatten_part(panel, part, body, lanes)
        if part == _WHOLE:
            for row in range(3):
                for n in range(count):
                    out[row, begin + n] = panel[(_CURVE + row) * WIDTH + n]
            for row in range(3, STATE_ROWS):
                for n in range(count):
                    out[row, begin + n] = panel[(_RESULT + row) * WIDTH + n]
        else:
            for row in range(len(out)):
                for n in range(count):
                    out[row, begin + n] = panel[(_RESULT + row) * WIDTH + n]
        begin += count


@register_jitable
def _interval(nodes: NDArray, s: float, guess: int) -> int:
    """Return the interval of the profile that holds s, of a grid point that on its right; fast near the guess."""
    last = len(nodes) - 2
    if nodes[guess, 0] <= s:
        for interval in range(guess, min(guess + 4, last)):
            if s < nodes[interval + 1, 0]:
                return interval
    below, above = 0, last + 1
    while above - below > 1:
        middle = (below + above) // 2
        if nodes[middle, 0] <= s:
            below = middle
        else:
            above = middle
    return below


@njit(error_model="numpy")
def rest_outside(table: NDArray, times: NDArray, duration: float, hover_thrust: float) -> None:
    """Turn the full states, (STATE_ROWS, N), at times before 0 and after the duration, s, to level hover there."""
    for n in range(len(times)):
        if not 0.0 <= times[n] <= duration:
            for row in range(3, STATE_ROWS - 2):
                table[row, n] = 0.0
            table[17, n] = 1.0  # the thrust axis
            for row in range(27, 31):
                table[row, n] = hover_thrust
            table[33, n], table[34, n] = np.sin(table[35, n] / 2.0), np.cos(table[35, n] / 2.0)
            table[36, n] = GRAVITY


@register_jitable(fastmath=ROUNDING)
def sample(
    out: NDArray, body: Body, curve: NDArray, origin: float, node: NDArray, left: float, right: float
) -> None:  # fmt: skip
    """Fill in one segment's samples, (SAMPLED_ROWS, count), of a piece of the path and an interval of the profile."""
    panel, s = np.empty(_SIZE), np.empty(WIDTH)
    last, width, last_s = out.shape[1] - 1, right - left, np.nextafter(right, -np.inf)
    profile = _node(node)
    for done in range(0, last + 1, WIDTH):
        lanes = min(WIDTH, _whole(last + 1 - done))
        for n in range(lanes):
            s[n] = left + (done + n) / last * width if done + n < last else last_s
            panel[_X * WIDTH + n] = s[n] - origin
        _trace(panel, curve, lanes)
        for n in range(lanes):
            panel[_X * WIDTH + n] = s[n] - node[0]
        _flatten_segment(panel, body, profile, lanes)
        count = min(WIDTH, last + 1 - done)
        for row in range(MEASURES):
            for n in range(count):
                out[row, done + n] = panel[(_RESULT + row) * WIDTH + n]
        for row in range(3):
            for n in range(count):
                out[POSITION + row, done + n] = panel[row * WIDTH + n]
        for n in range(count):
            out[PLACE, done + n] = s[n]


@register_jitable(fastmath=ROUNDING)
def _place(
    panel: NDArray, first: int, curves: NDArray, nodes: NDArray, places: NDArray, interval: NDArray, begin: int,
    lanes: int,
) -> None:  # fmt: skip
    """Write the points from `begin` on; `curves` holds rows of the path from number `first` on."""
    for row in range(len(curves)):
        for n in range(lanes):
            panel[(_CURVE + first + row) * WIDTH + n] = curves[row, begin + n]
    for n in range(lanes):
        panel[_X * WIDTH + n] = places[begin + n]
        for row in range(7):
            panel[(_NODE + row) * WIDTH + n] = nodes[interval[begin + n], 1 + row]


@register_jitable(fastmath=ROUNDING)
def _trace(panel: NDArray, table: NDArray, lanes: int) -> None:
    """Trace γ to γ'''' from a piece's coefficients, (D, 3), at x from its origin; D is a multiple of _BLOCK."""
    lanes = min(lanes, WIDTH)  # the compiler must see that no index overflows
    for axis in range(3):
        for k in range(len(table) - _BLOCK, -1, -_BLOCK):
            c0, c1, c2, c3 = table[k, axis], table[k + 1, axis], table[k + 2, axis], table[k + 3, axis]
            c4, c5, c6, c7 = table[k + 4, axis], table[k + 5, axis], table[k + 6, axis], table[k + 7, axis]
            if k == len(table) - _BLOCK:
                for n in range(lanes):
                    x = panel[_X * WIDTH + n]
                    p = horner_step(x, c0, horner_step(x, c1, horner_step(x, c2, _begun(x, c3, c4, c5, c6, c7))))
                    _write_curve(panel, axis, n, p)
            else:
                for n in range(lanes):
                    x, at = panel[_X * WIDTH + n], axis * WIDTH + n
                    p = (
                        panel[at], panel[3 * WIDTH + at], panel[6 * WIDTH + at], panel[9 * WIDTH + at],
                        panel[12 * WIDTH + at],
                    )  # fmt: skip
                    p = horner_step(x, c4, horner_step(x, c5, horner_step(x, c6, horner_step(x, c7, p))))
                    p = horner_step(x, c0, horner_step(x, c1, horner_step(x, c2, horner_step(x, c3, p))))
                    _write_curve(panel, axis, n, p)
    for row in range(6, 9):
        for n in range(lanes):
            panel[row * WIDTH + n] *= 2.0
            panel[(row + 3) * WIDTH + n] *= 6.0
            panel[(row + 6) * WIDTH + n] *= 24.0


@register_jitable(forceinline=True, fastmath=ROUNDING)
def _write_curve(panel: NDArray, axis: int, n: int, p: Derivatives) -> None:
    panel[(_CURVE + axis) * WIDTH + n] = p[0]
    panel[(_CURVE + 3 + axis) * WIDTH + n] = p[1]
    panel[(_CURVE + 6 + axis) * WIDTH + n] = p[2]
    panel[(_CURVE + 9 + axis) * WIDTH + n] = p[3]
    panel[(_CURVE + 12 + axis) * WIDTH + n] = p[4]


@register_jitable(forceinline=True, fastmath=ROUNDING)
def _begun(x: float, c3: float, c4: float, c5: float, c6: float, c7: float) -> Derivatives:
    """Take the first five steps of Horner's scheme, without products with zero."""
    p1, p0 = c7, x * c7 + c6
    p2, p1, p0 = p1, x * p1 + p0, x * p0 + c5
    p3, p2, p1, p0 = p2, x * p2 + p1, x * p1 + p0, x * p0 + c4
    return x * p0 + c3, x * p1 + p0, x * p2 + p1, x * p3 + p2, p3


@register_jitable(forceinline=True, fastmath=ROUNDING)
def _flat_at(panel: NDArray, body: Body, node: _Node, n: int) -> tuple[Flat, float]:
    """Return the full state, and yaw, from path and profile."""
    x = panel[_X * WIDTH + n]
    h, yaw = h_within(x, node[0], node[1], node[2], node[3]), yaw_within(x, node[4], node[5], node[6])
    derivatives = _vector(panel, 3, n), _vector(panel, 6, n), _vector(panel, 9, n), _vector(panel, 12, n)
    return flat_state(body, derivatives, h, yaw, cosine, sine), yaw[0]


@register_jitable(forceinline=True, fastmath=ROUNDING)
def _node(node: NDArray) -> _Node:
    """Return the profile where an interval begins, from its row of the profile's table."""
    return node[1], node[2], node[3], node[4], node[5], node[6], node[7]


@register_jitable(forceinline=True, fastmath=ROUNDING)
def _node_at(panel: NDArray, n: int) -> _Node:
    """Return the profile where a point's own interval begins."""
    (h, dh, ddh), (dddh, yaw, dyaw) = _vector(panel, _NODE, n), _vector(panel, _NODE + 3, n)
    return h, dh, ddh, dddh, yaw, dyaw, panel[(_NODE + 6) * WIDTH + n]


@register_jitable(fastmath=ROUNDING)
def _flatten(panel: NDArray, body: Body, lanes: int) -> None:
    """Write the measures of points in intervals of their own."""
    lanes = min(lanes, WIDTH)
    for n in range(lanes):
        flat, _ = _flat_at(panel, body, _node_at(panel, n), n)
        _write_measures(panel, n, flat)


@register_jitable(fastmath=ROUNDING)
def _flatten_segment(panel: NDArray, body: Body, node: _Node, lanes: int) -> None:
    """Write the measures of points that all lie in one interval."""
    lanes = min(lanes, WIDTH)
    for n in range(lanes):
        flat, _ = _flat_at(panel, body, node, n)
        _write_measures(panel, n, flat)


@register_jitable(forceinline=True, fastmath=ROUNDING)
def _write_measures(panel: NDArray, n: int, flat: Flat) -> None:
    values = measures(flat)
    for row in range(MEASURES):
        panel[(_RESULT + row) * WIDTH + n] = values[row]


@register_jitable(fastmath=ROUNDING)
def _flatten_whole(panel: NDArray, body: Body, lanes: int) -> None:
    """Write the full state as STATES has it, but for the position."""
    lanes = min(lanes, WIDTH)
    for n in range(lanes):
        flat, yaw = _flat_at(panel, body, _node_at(panel, n), n)
        _write(panel, 3, n, flat.velocity)
        _write(panel, 6, n, flat.acceleration)
        _write(panel, 9, n, flat.jerk)
        _write(panel, 12, n, flat.snap)
        _write(panel, 15, n, flat.thrust_axis)
        _write(panel, 18, n, flat.body_rate)
        _write(panel, 21, n, flat.angular_acceleration)
        _write(panel, 24, n, flat.torque)
        _write(panel, 27, n, flat.motor_thrust[:3])
        panel[(_RESULT + 30) * WIDTH + n] = flat.motor_thrust[3]
        quaternion = hopf_quaternion(flat.thrust_axis, cosine(yaw / 2), sine(yaw / 2))
        _write(panel, 31, n, quaternion[:3])
        _write(panel, 34, n, (quaternion[3], yaw, flat.specific_thrust))


@register_jitable(fastmath=ROUNDING)
def _flatten_part(panel: NDArray, part: int, body: Body, lanes: int) -> None:
    """Write a part of the full state; what only other parts need is not computed."""
    lanes = min(lanes, WIDTH)
    if part == _WHOLE:
        _flatten_whole(panel, body, lanes)
    elif part == _THRUST:
        for n in range(lanes):
            flat, _ = _flat_at(panel, body, _node_at(panel, n), n)
            panel[_RESULT * WIDTH + n] = flat.specific_thrust
    elif part == _RATE:
        for n in range(lanes):
            flat, _ = _flat_at(panel, body, _node_at(panel, n), n)
            _write(panel, 0, n, flat.body_rate)
    else:
        for n in range(lanes):
            flat, _ = _flat_at(panel, body, _node_at(panel, n), n)
            _write(panel, 0, n, flat.acceleration)


@register_jitable(forceinline=True, fastmath=ROUNDING)
def _write(panel: NDArray, row: int, n: int, vector: tuple[float, float, float]) -> None:
    panel[(_RESULT + row) * WIDTH + n] = vector[0]
    panel[(_RESULT + row + 1) * WIDTH + n] = vector[1]
    panel[(_RESULT + row + 2) * WIDTH + n] = vector[2]


@register_jitable(fastmath=ROUNDING)
def _whole(count: int) -> int:
    return (count + LANES - 1) // LANES * LANES


@register_jitable(forceinline=True, fastmath=ROUNDING)
def _vector(panel: NDArray, row: int, n: int) -> tuple[float, float, float]:
    return panel[row * WIDTH + n], panel[(row + 1) * WIDTH + n], panel[(row + 2) * WIDTH + n]
