"""The simulator: a batch of vehicles, each with its own airframe and errors, through a schedule.

What happens in each step, in this order:

1. setpoints that are due arrive, unless the link is lost;
2. snapshots of this step, or of what has just arrived, are noted where they are wanted;
3. the estimate misses what it has no poses for;
4. the supervisor levels out, or stops the motors, by its time-outs;
5. the controller asks the motors for thrusts;
6. the body moves;
7. what it comes to is reduced: the box that it sweeps, its worst deviation and tilt.

Lanes are independent: which others are in the batch changes nothing.
"""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cfplan.machine_code import njit
from cfplan.simulation.engine.body import move, stay_above_floor
from cfplan.simulation.engine.layout import (
    AIRFRAME,
    ASKED,
    FLOOR,
    MISSED,
    SETPOINT,
    SETPOINT_SIZE,
    SNAPSHOT_SIZE,
    VEHICLE_SIZE,
    WIDTH,
    padded,
    quadruple,
    vector,
    write_vector,
)
from cfplan.simulation.engine.mellinger import FULL_STATE, LEVEL_OUT, ON_BOARD, Gains, ask, mellinger, mixed

NEVER = 2**40  # ms
PART = 150  # ms of a sweep in one box, if there are several
_WORTH_THREADS = 2_000_000  # lanes and their ms, of which threads are worth their beginning
# Rows behind those of the vehicle: box swept, setpoint that is due, squared deviation, cosine of tilt, and what the
# estimate misses more and more of without poses, m/s².
_LOW, _HIGH, _DUE, _FARTHEST, _LEAST_LIFT, _BLIND = (VEHICLE_SIZE + k for k in (0, 3, 6, 9, 10, 11))
_ROWS = VEHICLE_SIZE + 14


class Vehicles(NamedTuple):
    """Vehicles, and what becomes of their links."""

    snapshots: NDArray  # (L, 31) at the beginning, as in `layout`
    airframes: NDArray  # (L, 26) as `pack_airframe` makes them
    first: NDArray  # (L,) int, row of the setpoint that arrives at the beginning
    last: NDArray  # (L,) int, row of the last one, which then stays due
    deaf_until: NDArray  # (L,) int, ms until which no other setpoint arrives
    blind: NDArray  # (L, 3) m/s² by which the estimate is wrong without poses: it misses ½ a t² of the motion


class Schedule(NamedTuple):
    """What happens when, from the beginning on."""

    setpoints: NDArray  # (N, 20) as in `mellinger`
    arrivals: NDArray  # (N,) int, ms; each lane's time begins when its first one arrives
    gains: Gains  # (19,) of the controllers
    steps: int
    step: int = 1  # ms of the body
    control: int = 2  # ms of the controller, a multiple
    on_board: bool = False  # whether setpoints are those of the high-level commander
    blind_until: int = NEVER  # ms until which there are no poses
    level_after: int = NEVER  # ms after which the vehicle levels out
    off_after: int = NEVER  # ms after which motors stop, for good; the simulation ends on the floor then
    spread: NDArray = np.zeros(1)  # (steps or 1,) m that boxes are wider to the sides, after each step
    latency: int = 0  # ms by which the estimate is late, where traces are wanted
    noise: NDArray = np.zeros((0, 6))  # (steps or 0, 6) m and m/s, of the estimate


class Outcome(NamedTuple):
    """What is found out; parts have no rows where they are not wanted. Once all have landed, snapshots are NaN."""

    boxes: NDArray  # (L, S, 2, 3) m, low and high corners swept, in S parts of the time
    deviation: NDArray  # (L,) m, worst distance from the setpoint that is due
    tilt: NDArray  # (L,) rad, worst
    arrived: NDArray  # (L or 0, M, 31) snapshot at which each setpoint of a lane arrives
    trace: NDArray  # (L or 0, steps, 31) snapshot at the beginning of each step


def arrival_times(count: int, rate: float) -> NDArray:
    """Return when so many setpoints at `rate`, Hz, arrive, (count,) ms."""
    return np.round(np.arange(count) * (1000 / rate)).astype(np.int64)


def simulate(batch: Vehicles, schedule: Schedule, *, parts: int = 1, arrived: int = 0, trace: bool = False) -> Outcome:
    """Return what becomes of a batch: boxes in so many parts, snapshots of the first `arrived` setpoints, a trace."""
    count = len(batch.snapshots)
    found = Outcome(
        np.empty((count, parts, 2, 3)),
        np.empty(count),
        np.empty(count),
        np.full((count if arrived else 0, arrived, SNAPSHOT_SIZE), np.nan),
        np.full((count if trace else 0, schedule.steps, SNAPSHOT_SIZE), np.nan),
    )
    batch = Vehicles(*(np.ascontiguousarray(each) for each in batch))
    schedule = schedule._replace(gains=tuple(schedule.gains.tolist()))
    shares = list(_split(batch, found, count * schedule.steps * schedule.step))
    if len(shares) == 1:
        _run(batch, schedule, found)
    else:
        with ThreadPoolExecutor(len(shares)) as pool:
            list(pool.map(_run, *zip(*((one, schedule, part) for one, part in shares), strict=True)))
    return found


def _split(batch: Vehicles, found: Outcome, work: int) -> Iterator[tuple[Vehicles, Outcome]]:
    """Cut a batch in two halves where that is worth it."""
    count = len(batch.snapshots)
    middle = count // (2 * WIDTH) * WIDTH if work > _WORTH_THREADS else 0
    for some in (slice(0, middle), slice(middle, count)) if middle else (slice(0, count),):
        yield Vehicles(*(each[some] for each in batch)), Outcome(*(each[some] for each in found))


@njit(nogil=True, error_model="numpy")
def _run(batch: Vehicles, schedule: Schedule, found: Outcome) -> None:
    lanes, newest = np.zeros(_ROWS * WIDTH), np.zeros(WIDTH, dtype=np.int64)
    for first in range(0, len(batch.snapshots), WIDTH):
        _run_lanes(lanes, newest, batch, schedule, found, first)


@njit(allocates=False, error_model="numpy")
def _run_lanes(
    lanes: NDArray, newest: NDArray, batch: Vehicles, schedule: Schedule, found: Outcome, first: int
) -> None:
    """Run as many vehicles as there are lanes, from number `first` on."""
    count = min(WIDTH, len(batch.snapshots) - first)
    _begin(lanes, newest, count, batch, schedule, first)
    _fly(lanes, newest, count, batch, schedule, found, first)
    for n in range(count):
        found.deviation[first + n] = np.sqrt(lanes[_FARTHEST * WIDTH + n])
        found.tilt[first + n] = np.arccos(min(max(lanes[_LEAST_LIFT * WIDTH + n], -1.0), 1.0))


@register_jitable
def _begin(lanes: NDArray, newest: NDArray, count: int, batch: Vehicles, schedule: Schedule, first: int) -> None:
    """Put vehicles into lanes."""
    for n in range(count):
        for row in range(SNAPSHOT_SIZE):
            lanes[row * WIDTH + n] = batch.snapshots[first + n, row]
        for row in range(batch.airframes.shape[1]):
            lanes[(AIRFRAME + row) * WIDTH + n] = batch.airframes[first + n, row]
        for k in range(3):
            lanes[(_LOW + k) * WIDTH + n] = lanes[(_HIGH + k) * WIDTH + n] = batch.snapshots[first + n, k]
            lanes[(_BLIND + k) * WIDTH + n] = batch.blind[first + n, k]
        for row in range(MISSED, MISSED + 6):
            lanes[row * WIDTH + n] = 0.0
        lanes[_FARTHEST * WIDTH + n], lanes[_LEAST_LIFT * WIDTH + n] = 0.0, 1.0
        newest[n] = batch.first[first + n]
        _take_setpoint(lanes, n, schedule.setpoints[newest[n]])
        _note_due(lanes, n, schedule.setpoints[newest[n]])


@register_jitable
def _fly(
    lanes: NDArray, newest: NDArray, count: int, batch: Vehicles, schedule: Schedule, found: Outcome, first: int
) -> None:  # seven, as numba knows no objects
    """Fly the vehicles of all lanes; `first` is the number of the first one."""
    used, step, part, due_at = padded(count), 0.001 * schedule.step, 0, 1
    for n in range(count):
        _note_arrival(lanes, n, found, first + n, 0)
    for k in range(schedule.steps):
        now = k * schedule.step
        if now >= due_at:
            due_at = NEVER
            for n in range(count):
                due_at = min(due_at, _receive(lanes, newest, n, batch, schedule, found, first + n, now))
        if len(found.trace) > 0:
            for n in range(count):
                _read_snapshot(found.trace[first + n, k], lanes, n)
        _miss(lanes, used, 0.001 * now if now < schedule.blind_until else 0.0)
        if schedule.latency > 0 or len(schedule.noise) > 0:
            _err(lanes, count, schedule, found, first, k)
        if now == schedule.level_after:
            for n in range(count):
                lanes[(SETPOINT + 15) * WIDTH + n] = 0.0
        if now == schedule.off_after:
            for row in range(ASKED, ASKED + 4):
                for n in range(count):
                    lanes[row * WIDTH + n] = 0.0
        elif now < schedule.off_after and now % schedule.control == 0:
            levels, period = now >= schedule.level_after, 0.001 * schedule.control
            _control(lanes, used, schedule.gains, period, schedule.on_board, levels)
        _move(lanes, used, step)
        down = _count_down(lanes, count)
        if down > 0:
            for n in range(count):
                stay_above_floor(lanes, WIDTH, n, step)
        aside = schedule.spread[min(k, len(schedule.spread) - 1)]
        _reduce(lanes, used, aside)
        after = min((now + schedule.step) // PART, found.boxes.shape[1] - 1)
        if after != part:
            for n in range(count):
                _next_part(lanes, n, found.boxes[first + n, part])
            _reduce(lanes, used, aside)
            part = after
        if now >= schedule.off_after and down == count:
            break
    for each in range(part, found.boxes.shape[1]):
        for n in range(count):
            _write_box(found.boxes[first + n, each], lanes, n)


@register_jitable
def _receive(
    lanes: NDArray, newest: NDArray, n: int, batch: Vehicles, schedule: Schedule, found: Outcome, number: int, now: int
) -> int:  # eight, as numba knows no objects
    """Let the setpoints of a lane arrive that are due; return when, ms, there is something to receive again."""
    begun, last, deaf_until = schedule.arrivals[batch.first[number]], batch.last[number], batch.deaf_until[number]
    before = newest[n]
    while newest[n] < last and schedule.arrivals[newest[n] + 1] - begun <= now:
        newest[n] += 1
    came = newest[n] > before
    if came:
        _note_due(lanes, n, schedule.setpoints[newest[n]])
        _note_arrival(lanes, n, found, number, newest[n] - batch.first[number])
    if (came and now >= deaf_until) or now == deaf_until:
        _take_setpoint(lanes, n, schedule.setpoints[newest[n]])
    next_one = schedule.arrivals[newest[n] + 1] - begun if newest[n] < last else NEVER
    return min(next_one, deaf_until) if now < deaf_until else next_one


@register_jitable
def _take_setpoint(lanes: NDArray, n: int, setpoint: NDArray) -> None:
    for k in range(SETPOINT_SIZE):
        lanes[(SETPOINT + k) * WIDTH + n] = setpoint[k]


@register_jitable
def _note_due(lanes: NDArray, n: int, setpoint: NDArray) -> None:
    for k in range(3):
        lanes[(_DUE + k) * WIDTH + n] = setpoint[k]


@register_jitable
def _note_arrival(lanes: NDArray, n: int, found: Outcome, number: int, setpoint: int) -> None:
    if len(found.arrived) > 0 and setpoint < found.arrived.shape[1]:
        _read_snapshot(found.arrived[number, setpoint], lanes, n)


@register_jitable
def _read_snapshot(snapshot: NDArray, lanes: NDArray, n: int) -> None:
    for row in range(SNAPSHOT_SIZE):
        snapshot[row] = lanes[row * WIDTH + n]


@njit(allocates=False, error_model="numpy")
def _miss(lanes: NDArray, count: int, blind_for: float) -> None:
    """Let all estimates miss what an error of acceleration makes of so many s without poses."""
    count = min(count, WIDTH)  # the compiler must see that no index overflows
    for n in range(count):
        x, y, z = vector(lanes, WIDTH, n, _BLIND)
        way = 0.5 * blind_for * blind_for
        write_vector(lanes, WIDTH, n, MISSED, (way * x, way * y, way * z))
        write_vector(lanes, WIDTH, n, MISSED + 3, (blind_for * x, blind_for * y, blind_for * z))


@register_jitable
def _err(lanes: NDArray, count: int, schedule: Schedule, found: Outcome, first: int, k: int) -> None:
    """Let all estimates be late and noisy besides."""
    seen = max(k - schedule.latency // schedule.step, 0)
    for n in range(count):
        for row in range(6):
            late = lanes[row * WIDTH + n] - found.trace[first + n, seen, row]
            lanes[(MISSED + row) * WIDTH + n] += late - (schedule.noise[k, row] if len(schedule.noise) > 0 else 0.0)


@njit(allocates=False, error_model="numpy")
def _control(lanes: NDArray, count: int, gains: Gains, period: float, on_board: bool, levels: bool) -> None:
    """Step all controllers. The modes are constants, so that the compiler leaves out what they do not need."""
    count = min(count, WIDTH)
    if on_board:
        for n in range(count):
            _control_lane(lanes, n, gains, ON_BOARD, period)
    elif levels:
        for n in range(count):
            _control_lane(lanes, n, gains, LEVEL_OUT, period)
    else:
        for n in range(count):
            _control_lane(lanes, n, gains, FULL_STATE, period)


@register_jitable(forceinline=True)
def _control_lane(lanes: NDArray, n: int, gains: Gains, mode: Any, period: float) -> None:
    x, y, z = vector(lanes, WIDTH, n, 0)
    vx, vy, vz = vector(lanes, WIDTH, n, 3)
    missed, missed_speed = vector(lanes, WIDTH, n, MISSED), vector(lanes, WIDTH, n, MISSED + 3)
    place = x - missed[0], y - missed[1], z - missed[2]
    speed = vx - missed_speed[0], vy - missed_speed[1], vz - missed_speed[2]
    belief = place, speed, quadruple(lanes, WIDTH, n, 6), vector(lanes, WIDTH, n, 10)
    ask(lanes, WIDTH, n, mixed(mellinger(lanes, WIDTH, n, gains, mode, belief, period)))


@njit(allocates=False, error_model="numpy")
def _move(lanes: NDArray, count: int, step: float) -> None:
    count = min(count, WIDTH)
    for n in range(count):
        move(lanes, WIDTH, n, step)


@njit(allocates=False, error_model="numpy")
def _count_down(lanes: NDArray, count: int) -> int:
    """Return how many vehicles are on the floor or below."""
    count, down = min(count, WIDTH), 0
    for n in range(count):
        down += lanes[2 * WIDTH + n] <= lanes[FLOOR * WIDTH + n]
    return down


@njit(allocates=False, error_model="numpy")
def _reduce(lanes: NDArray, count: int, aside: float) -> None:
    """Note what each vehicle has come to: `aside`, m, widens its box, unless it stands on the floor."""
    count = min(count, WIDTH)
    for n in range(count):
        low, high = vector(lanes, WIDTH, n, _LOW), vector(lanes, WIDTH, n, _HIGH)
        x, y, z = vector(lanes, WIDTH, n, 0)
        wide = aside if z > lanes[FLOOR * WIDTH + n] else 0.0
        low = _lower(low[0], x - wide), _lower(low[1], y - wide), _lower(low[2], z)
        high = _higher(high[0], x + wide), _higher(high[1], y + wide), _higher(high[2], z)
        write_vector(lanes, WIDTH, n, _LOW, low)
        write_vector(lanes, WIDTH, n, _HIGH, high)
        due = vector(lanes, WIDTH, n, _DUE)
        away = (x - due[0]) ** 2 + (y - due[1]) ** 2 + (z - due[2]) ** 2
        lanes[_FARTHEST * WIDTH + n] = _higher(lanes[_FARTHEST * WIDTH + n], away)
        qx, qy = lanes[6 * WIDTH + n], lanes[7 * WIDTH + n]
        lift = 1.0 - 2.0 * (qx * qx + qy * qy)
        lanes[_LEAST_LIFT * WIDTH + n] = _lower(lanes[_LEAST_LIFT * WIDTH + n], lift)


@register_jitable(forceinline=True)
def _lower(value: float, other: float) -> float:
    """Return the smaller; written so that what is no number is taken over."""
    return value if value <= other else other


@register_jitable(forceinline=True)
def _higher(value: float, other: float) -> float:
    return value if value >= other else other


@register_jitable
def _next_part(lanes: NDArray, n: int, box: NDArray) -> None:
    """Write a box, and begin the next one."""
    _write_box(box, lanes, n)
    write_vector(lanes, WIDTH, n, _LOW, (np.inf, np.inf, np.inf))
    write_vector(lanes, WIDTH, n, _HIGH, (-np.inf, -np.inf, -np.inf))


@register_jitable
def _write_box(box: NDArray, lanes: NDArray, n: int) -> None:
    for k in range(3):
        box[0, k], box[1, k] = lanes[(_LOW + k) * WIDTH + n], lanes[(_HIGH + k) * WIDTH + n]
