"""Simulate a batch of vehicles, each with its own airframe and errors, through a schedule.

Each step, in this order:

1. setpoints that are due arrive, unless the link is lost;
2. snapshots are recorded, of this step or of arriving setpoints, if requested;
3. without poses, the error of the estimate grows;
4. the supervisor levels out, or stops the motors, by its time-outs;
5. the controller commands the motors;
6. the body moves;
7. the results are updated: the box that the vehicle sweeps, its worst deviation and tilt.

Lanes are independent: the other vehicles of a batch have no effect.
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
    AIRFRAME_SIZE,
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
from cfplan.simulation.engine.mellinger import (
    FULL_STATE,
    LEVEL_OUT,
    ON_BOARD,
    YAW_RATE,
    Gains,
    mellinger,
    mixed,
    store_commands,
)

NEVER = 2**40  # ms
PART = 150  # ms of motion per box, unless a schedule says otherwise
_WORTH_THREADS = 2_000_000  # lanes times ms, above which a second thread saves time
# Rows after those of the vehicle: swept box, setpoint that is due, squared deviation, cosine of tilt, and the
# acceleration error of the estimate without poses, m/s².
_LOW, _HIGH, _DUE, _FARTHEST, _LEAST_LIFT, _BLIND = (VEHICLE_SIZE + k for k in (0, 3, 6, 9, 10, 11))
_ROWS = VEHICLE_SIZE + 14


class Vehicles(NamedTuple):
    """Vehicles, and the state of their links."""

    snapshots: NDArray  # (L, 31) at the beginning, as in `layout`
    airframes: NDArray  # (L, 26) as `pack_airframe` makes them
    first: NDArray  # (L,) int, row of the setpoint that arrives at the beginning
    last: NDArray  # (L,) int, row of the last one, which then stays due
    deaf_until: NDArray  # (L,) int, ms until which no other setpoint arrives
    blind: NDArray  # (L, 3) m/s², acceleration error of the estimate without poses: it misses ½ a t² of the motion


class Schedule(NamedTuple):
    """The events of a simulation and their times, ms from its beginning."""

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
    spread: NDArray = np.zeros(1)  # (steps or 1,) m by which boxes are widened to the sides, after each step
    latency: int = 0  # ms, a multiple of the step, lateness of estimated position and velocity
    noise: NDArray = np.zeros((0, 6))  # (steps or 0, 6) m and m/s, of the estimate
    part: int = PART  # ms of motion per box, if there are several


class Outcome(NamedTuple):
    """The results; arrays that were not requested have no rows. After all vehicles have landed, snapshots are NaN."""

    boxes: NDArray  # (L, S, 2, 3) m, low and high corners swept, in S parts of the time
    deviation: NDArray  # (L,) m, worst distance from the setpoint that is due
    tilt: NDArray  # (L,) rad, worst
    arrived: NDArray  # (L or 0, M, 31) snapshot at which each setpoint of a lane arrives
    trace: NDArray  # (L or 0, steps, 31) snapshot at the beginning of each step


def arrival_times(count: int, rate: float) -> NDArray:
    """Return the arrival times of `count` setpoints at `rate`, Hz, (count,) ms."""
    return np.round(np.arange(count) * (1000 / rate)).astype(np.int64)


def simulate(batch: Vehicles, schedule: Schedule, *, parts: int = 1, arrived: int = 0, trace: bool = False) -> Outcome:
    """Simulate a batch; return boxes in `parts` parts, snapshots at the first `arrived` setpoints, and a trace."""
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
    """Split a batch into halves if two threads save time."""
    count = len(batch.snapshots)
    middle = count // (2 * WIDTH) * WIDTH if work > _WORTH_THREADS else 0
    for some in (slice(0, middle), slice(middle, count)) if middle else (slice(0, count),):
        yield Vehicles(*(each[some] for each in batch)), Outcome(*(each[some] for each in found))


class _Lanes(NamedTuple):
    """The vehicles of a batch that are simulated at once."""

    values: NDArray  # (_ROWS * WIDTH,) as in `layout`
    newest: NDArray  # (WIDTH,) int, row of the setpoint that is due
    past: NDArray  # (K, 6 * WIDTH) position and velocity in the last K steps, by which the estimate is late; a ring
    first: int  # number of the vehicle in the first lane
    size: int  # how many of the lanes are used


@njit(nogil=True, error_model="numpy")
def _run(batch: Vehicles, schedule: Schedule, found: Outcome) -> None:
    values, newest = np.zeros(_ROWS * WIDTH), np.zeros(WIDTH, dtype=np.int64)
    past = np.zeros((schedule.latency // schedule.step, 6 * WIDTH))
    for first in range(0, len(batch.snapshots), WIDTH):
        _fly(_Lanes(values, newest, past, first, min(WIDTH, len(batch.snapshots) - first)), batch, schedule, found)


@njit(allocates=False, error_model="numpy")
def _fly(lanes: _Lanes, batch: Vehicles, schedule: Schedule, found: Outcome) -> None:
    """Fly the vehicles of all lanes."""
    values, used, step, part = lanes.values, padded(lanes.size), 0.001 * schedule.step, 0
    _begin(lanes, batch, schedule)
    due_at = 0
    for k in range(schedule.steps):
        now = k * schedule.step
        if now >= due_at:
            due_at = _receive(lanes, batch, schedule, found, now)
        if len(found.trace) > 0:
            _note_step(lanes, found, k)
        _drop_poses(values, used, 0.001 * now if now < schedule.blind_until else 0.0)
        if len(lanes.past) > 0:
            _add_lateness(values, used, lanes.past[k % len(lanes.past)])
        if len(schedule.noise) > 0:
            _add_noise(values, used, schedule.noise[k])
        _supervise(values, schedule, now)
        if now < schedule.off_after and now % schedule.control == 0:
            levels, period = now >= schedule.level_after, 0.001 * schedule.control
            _control(values, used, schedule.gains, period, schedule.on_board, levels)
        _move(values, used, step)
        down = _count_down(values, lanes.size)
        if down > 0:
            for n in range(lanes.size):
                stay_above_floor(values, WIDTH, n, step)
        part = _reduce(lanes, used, schedule, found, k, part)
        if now >= schedule.off_after and down == lanes.size:
            break
    _end(lanes, found, part)


@register_jitable
def _begin(lanes: _Lanes, batch: Vehicles, schedule: Schedule) -> None:
    """Load vehicles into lanes."""
    values = lanes.values
    for n in range(lanes.size):
        number = lanes.first + n
        for row in range(SNAPSHOT_SIZE):
            values[row * WIDTH + n] = batch.snapshots[number, row]
        for row in range(AIRFRAME_SIZE):
            values[(AIRFRAME + row) * WIDTH + n] = batch.airframes[number, row]
        for k in range(3):
            values[(_LOW + k) * WIDTH + n] = values[(_HIGH + k) * WIDTH + n] = batch.snapshots[number, k]
            values[(_BLIND + k) * WIDTH + n] = batch.blind[number, k]
            for age in range(len(lanes.past)):  # before the beginning, as if its velocity had been constant
                slot, speed = lanes.past[-1 - age], batch.snapshots[number, 3 + k]
                slot[k * WIDTH + n] = batch.snapshots[number, k] - 0.001 * schedule.step * (age + 1) * speed
                slot[(3 + k) * WIDTH + n] = speed
        values[_FARTHEST * WIDTH + n], values[_LEAST_LIFT * WIDTH + n] = 0.0, 1.0
        lanes.newest[n] = batch.first[number]
        _take_setpoint(values, n, schedule.setpoints[lanes.newest[n]])


@register_jitable
def _receive(lanes: _Lanes, batch: Vehicles, schedule: Schedule, found: Outcome, now: int) -> int:
    """Deliver the setpoints that are due, and record snapshots; return when to call this again, ms."""
    again = NEVER
    for n in range(lanes.size):
        number, newest = lanes.first + n, lanes.newest[n]
        first, last, deaf_until = batch.first[number], batch.last[number], batch.deaf_until[number]
        begun = schedule.arrivals[first]
        while newest < last and schedule.arrivals[newest + 1] - begun <= now:
            newest += 1
        if newest > lanes.newest[n] or now == 0:
            for k in range(3):
                lanes.values[(_DUE + k) * WIDTH + n] = schedule.setpoints[newest, k]
            if newest - first < found.arrived.shape[1]:
                _read_snapshot(found.arrived[number, newest - first], lanes.values, n)
        if now == deaf_until or (newest > lanes.newest[n] and now > deaf_until):
            _take_setpoint(lanes.values, n, schedule.setpoints[newest])
        lanes.newest[n] = newest
        if newest < last:
            again = min(again, schedule.arrivals[newest + 1] - begun)
        if now < deaf_until:
            again = min(again, deaf_until)
    return again


@register_jitable
def _note_step(lanes: _Lanes, found: Outcome, k: int) -> None:
    for n in range(lanes.size):
        _read_snapshot(found.trace[lanes.first + n, k], lanes.values, n)


@register_jitable
def _supervise(values: NDArray, schedule: Schedule, now: int) -> None:
    """Level out, or stop the motors."""
    if now == schedule.level_after:
        for n in range(WIDTH):
            values[(SETPOINT + YAW_RATE) * WIDTH + n] = 0.0
    if now == schedule.off_after:
        for row in range(ASKED, ASKED + 4):
            for n in range(WIDTH):
                values[row * WIDTH + n] = 0.0


@register_jitable
def _reduce(lanes: _Lanes, used: int, schedule: Schedule, found: Outcome, k: int, part: int) -> int:
    """Update the results after step k; return the number of the current box."""
    aside = schedule.spread[min(k, len(schedule.spread) - 1)]
    _widen(lanes.values, used, aside)
    after = min((k + 1) * schedule.step // schedule.part, found.boxes.shape[1] - 1)
    if after != part:
        for n in range(lanes.size):
            _write_box(found.boxes[lanes.first + n, part], lanes.values, n)
            write_vector(lanes.values, WIDTH, n, _LOW, (np.inf, np.inf, np.inf))
            write_vector(lanes.values, WIDTH, n, _HIGH, (-np.inf, -np.inf, -np.inf))
        _widen(lanes.values, used, aside)
    return after


@register_jitable
def _end(lanes: _Lanes, found: Outcome, part: int) -> None:
    """Write the results; for the remaining time the boxes enclose the landed vehicle."""
    for n in range(lanes.size):
        number = lanes.first + n
        for each in range(part, found.boxes.shape[1]):
            _write_box(found.boxes[number, each], lanes.values, n)
        found.deviation[number] = np.sqrt(lanes.values[_FARTHEST * WIDTH + n])
        found.tilt[number] = np.arccos(min(max(lanes.values[_LEAST_LIFT * WIDTH + n], -1.0), 1.0))


@register_jitable
def _take_setpoint(values: NDArray, n: int, setpoint: NDArray) -> None:
    for k in range(SETPOINT_SIZE):
        values[(SETPOINT + k) * WIDTH + n] = setpoint[k]


@register_jitable
def _read_snapshot(snapshot: NDArray, lanes: NDArray, n: int) -> None:
    for row in range(SNAPSHOT_SIZE):
        snapshot[row] = lanes[row * WIDTH + n]


@njit(allocates=False, error_model="numpy")
def _drop_poses(lanes: NDArray, count: int, blind_for: float) -> None:
    """Set the errors of all estimates from an error of acceleration over `blind_for`, s without poses."""
    count = min(count, WIDTH)  # the compiler must see that no index overflows
    for n in range(count):
        x, y, z = vector(lanes, WIDTH, n, _BLIND)
        way = 0.5 * blind_for * blind_for
        write_vector(lanes, WIDTH, n, MISSED, (way * x, way * y, way * z))
        write_vector(lanes, WIDTH, n, MISSED + 3, (blind_for * x, blind_for * y, blind_for * z))


@njit(allocates=False, error_model="numpy")
def _add_lateness(lanes: NDArray, count: int, seen: NDArray) -> None:
    """Let all estimates be what was true as many steps ago as the ring has rows; `seen`, its oldest, gets the truth."""
    count = min(count, WIDTH)
    for row in range(6):
        for n in range(count):
            true = lanes[row * WIDTH + n]
            lanes[(MISSED + row) * WIDTH + n] += true - seen[row * WIDTH + n]
            seen[row * WIDTH + n] = true


@njit(allocates=False, error_model="numpy")
def _add_noise(lanes: NDArray, count: int, noise: NDArray) -> None:
    count = min(count, WIDTH)
    for row in range(6):
        for n in range(count):
            lanes[(MISSED + row) * WIDTH + n] -= noise[row]


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
    store_commands(lanes, WIDTH, n, mixed(mellinger(lanes, WIDTH, n, gains, mode, belief, period)))


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
def _widen(lanes: NDArray, count: int, aside: float) -> None:
    """Update each vehicle's results: `aside`, m, widens its box, unless it stands on the floor."""
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
    """Return the smaller; written so that NaN propagates."""
    return value if value <= other else other


@register_jitable(forceinline=True)
def _higher(value: float, other: float) -> float:
    return value if value >= other else other


@register_jitable
def _write_box(box: NDArray, lanes: NDArray, n: int) -> None:
    for k in range(3):
        box[0, k], box[1, k] = lanes[(_LOW + k) * WIDTH + n], lanes[(_HIGH + k) * WIDTH + n]
