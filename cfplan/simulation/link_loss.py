"""Simulate link loss: where the vehicle goes if the pilot or the radio dies, or if its motors stop at once.

By the firmware's time-outs the vehicle holds the last setpoint, then levels out at that height, then stops its motors.
While it levels out, the controller keeps the body rates of the last setpoint, so setpoints carry rates that brake (see
flight/setpoints/rate_trade.py). Where it comes down depends on the moment, so every setpoint is tried as the last one:
the flight is simulated once, in steps of 1 ms, and a simulation in steps of 4 ms branches off at each setpoint.

The motors may also stop at once, because the pilot cuts them or the supervisor locks. Then the vehicle falls at its
present velocity, which from 2 m/s and a height of 1.2 m takes it a metre on. If it was to brake late before a wall,
that is farther than link loss takes it, so the box that the vehicle sweeps includes the fall from each setpoint.

Poses end as well. The vehicle then flies by gyroscope and accelerometer. Small errors of the estimated attitude and
velocity make it drift to a side, independently of where it is, so the swept box is widened by the drift up to each
moment. An accelerometer that reads too little makes the vehicle believe that it sinks, and climb; this is simulated.
One that reads too much makes it come down sooner, with less thrust to brake, which takes it some millimetres farther to
the sides; this is simulated as well if the vehicle comes near a wall.
"""

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.firmware import Timeouts, estimate_errors, gains_for
from cfplan.flight.setpoints.encoding import RATE
from cfplan.flight.setpoints.packets import PAYLOAD_SIZE, FullStateSetpoints, decode
from cfplan.safety.limits import Limits
from cfplan.safety.space import SIDES, inside
from cfplan.simulation.engine.layout import (
    SETPOINT_SIZE,
    SNAPSHOT_SIZE,
    hovering_snapshot,
    pack_airframe,
    setpoint_rows,
)
from cfplan.simulation.engine.run import NEVER, PART, Schedule, Vehicles, arrival_times, simulate
from cfplan.vehicle.airframe import GRAVITY, Airframe

# s after the last setpoint; the same in all permitted firmware, see flight/firmware.py
LEVEL_AFTER = Timeouts().level_out_at_latest
_PARTS = 9  # boxes of a sweep, if there are obstacles
TUBE_PART = 40  # ms of motion per box of a tube, a multiple of the step
_STEP, _FIRST_STEP = 4, 8  # ms, step after the last setpoint; the same in the coarse simulation
_LONGEST = 4000  # ms simulated after the last setpoint, unless the vehicle lies on the floor earlier
_NEAR = 0.1  # m from a wall, within which an accelerometer that reads too much is simulated too
ALLOWANCE = 0.1  # m, margin of the coarse simulation, which was off by at most 0.05 m in 51 flights up to 3 m/s
_SLOW_ALLOWANCE = 0.07  # m, the same for slow motion; at most 0.068 m in 765 motions, far from the walls
_FIRST_EVERY, _SLOW_EVERY, _FORESEEN_EVERY = 2, 8, 16  # setpoints between samples of the coarse simulation


@dataclass(frozen=True, slots=True)
class LinkLoss:
    """The worst moment to lose the link, and where the vehicle goes from there."""

    moment: float  # s from the first setpoint
    distance: float  # m, horizontally from the last setpoint to the far corner of the box that the vehicle sweeps
    beyond: float  # m beyond a wall or the ceiling, or into an obstacle; negative inside
    at_obstacle: bool = False  # whether that is an obstacle

    def __str__(self) -> str:
        walls = (
            "inside the walls"
            if inside(self.beyond)
            else f"{self.beyond:.1f} m {'into an obstacle' if self.at_obstacle else 'beyond the walls'}"
        )
        comes_down = f"the vehicle comes down {self.distance:.1f} m farther on, {walls}"
        return f"lost at the worst moment, {self.moment:.1f} s, {comes_down}"


@dataclass(frozen=True, slots=True)
class LinkLossMoments:
    """The space that the vehicle sweeps if each setpoint is the last one: the worst of all motor lags."""

    time: NDArray  # (N,) s of each setpoint from the first
    place: NDArray  # (N, 3) m, of each setpoint
    boxes: NDArray  # (N, S, 2, 3) m, low and high corners of the space swept down to the floor, in S parts
    beyond: NDArray  # (N,) m beyond a wall or the ceiling, or into an obstacle; negative inside
    face: NDArray  # (N,) int, number of that face of the space, or of the nearest one
    distance: NDArray  # (N,) m, horizontally from the setpoint to the far corner of the box
    snapshots: NDArray  # (L, N, 31) at each setpoint, see `engine.layout`, for each motor lag; (L, 0, 31) within stops

    @property
    def worst(self) -> LinkLoss:
        """Return the setpoint after which the vehicle ends farthest out; NaN counts as farthest."""
        at = int(np.argmax(np.where(np.isnan(self.beyond), np.inf, self.beyond)))
        at_obstacle = bool(self.face[at] >= SIDES)
        return LinkLoss(float(self.time[at]), float(self.distance[at]), float(self.beyond[at]), at_obstacle)

    @property
    def low(self) -> NDArray:
        """Return the low corner of the space that the vehicle sweeps, (N, 3) m."""
        return np.asarray(self.boxes[:, :, 0].min(axis=1))

    @property
    def high(self) -> NDArray:
        """Return the high corner of the space that the vehicle sweeps, (N, 3) m."""
        return np.asarray(self.boxes[:, :, 1].max(axis=1))


def simulate_link_loss(payloads: NDArray, limits: Limits, rate: float = RATE) -> LinkLoss:
    """Lose the link at every setpoint of a flight, (N, 29) uint8 at `rate`, Hz; return the worst case."""
    return link_loss_at_every_setpoint(payloads, limits, rate).worst


def link_loss_at_every_setpoint(
    payloads: NDArray, limits: Limits, rate: float = RATE, starts: NDArray | None = None
) -> LinkLossMoments:
    """Lose the link after each setpoint of a flight, (N, 29) uint8 at `rate`, Hz.

    The flight begins in hover, or from the snapshots `starts`, (L, 31), of another at the same setpoint.
    """
    state = decode(payloads)
    rows = setpoint_rows(state)
    snapshots = _flown(rows, limits, _airframes(limits), rate, _begins(state, limits, starts))
    boxes = _swept(_Forks(rows, np.arange(len(rows)), snapshots, _airframes(limits)), limits)
    return _judge(np.arange(len(rows)) / rate, state.position, boxes, limits, snapshots)


def link_loss_near_walls(
    payloads: NDArray, limits: Limits, within: float, rate: float = RATE, starts: NDArray | None = None
) -> LinkLossMoments:
    """Lose the link after each setpoint that may leave the vehicle `within` m of a wall, and after the worst one.

    Setpoints that end farther inside than `within` and ALLOWANCE in a coarse simulation are not simulated finely: they
    count as ending ALLOWANCE farther out. Arguments as for link_loss_at_every_setpoint, whose worst moment this finds
    in half the time.
    """
    return _simulate_sample(payloads, limits, rate, starts, within)


def link_loss_at_walls(
    payloads: NDArray, limits: Limits, rate: float = RATE, starts: NDArray | None = None
) -> LinkLossMoments:
    """Lose the link after each setpoint that may leave the vehicle beyond a wall.

    Like link_loss_near_walls(), but if every setpoint ends inside, the worst moment is not found.
    """
    return _simulate_sample(payloads, limits, rate, starts, None)


def foreseen_link_loss(
    payloads: NDArray, limits: Limits, rate: float = RATE, starts: NDArray | None = None
) -> LinkLossMoments:
    """Return an estimate of where the vehicle ends after each setpoint, by a coarse simulation."""
    return _foreseen(payloads, limits, rate, starts, _FORESEEN_EVERY)


def link_loss_of_slow_motion(payloads: NDArray, limits: Limits, rate: float = RATE) -> LinkLossMoments:
    """Lose the link at setpoints of take-off, of the way to the start or of landing, (N, 29) uint8 at `rate`, Hz.

    A coarse simulation of every eighth one suffices unless it ends near a wall.
    """
    found, state = _foreseen(payloads, limits, rate, None, _SLOW_EVERY), decode(payloads)
    if found.worst.beyond < -_SLOW_ALLOWANCE:
        return found
    rows, boxes = setpoint_rows(state), found.boxes
    snapshots = _flown(rows, limits, _airframes(limits), rate, _begins(state, limits, None))
    _simulate_again(boxes, rows, snapshots, limits, ~(found.beyond < -_SLOW_ALLOWANCE))
    return _judge(found.time, state.position, boxes, limits, snapshots)


def link_loss_within_stops(
    stops: NDArray, starts: NDArray, limits: Limits, forks: NDArray, rate: float = RATE, *, coarsely: bool = False
) -> LinkLossMoments:
    """Lose the link in K stops, (K, M, 29) uint8 at `rate`, Hz, after the setpoints selected by `forks`, (K, M).

    Each stop begins from a snapshot of its flight, `starts`, (L, K, 31) for each motor lag, as the moments of a plan
    hold them. Returns a moment for each fork, one stop after another; times are from the first setpoint of the stop.
    If `coarsely`, the vehicle ends at most ALLOWANCE farther out than returned.
    """  # six, and what it is about
    rows = setpoint_rows(decode(stops.reshape(-1, PAYLOAD_SIZE))).reshape(*stops.shape[:2], SETPOINT_SIZE)
    some = slice(_middle(limits), _middle(limits) + 1) if coarsely else slice(None)
    airframes, step = _airframes(limits)[some], _FIRST_STEP if coarsely else _STEP
    snapshots = _flown_each(rows, limits, airframes, rate, starts[some])[:, forks]
    lost = _Forks(rows.reshape(-1, SETPOINT_SIZE), np.flatnonzero(forks), snapshots, airframes, step)
    boxes = _swept(lost, limits)
    times, places = np.nonzero(forks)[1] / rate, rows[..., 0:3][forks]
    return _judge(times, places, boxes, limits, np.empty((len(starts), 0, SNAPSHOT_SIZE)))


def link_loss_tubes(payloads: NDArray, limits: Limits, rows: NDArray, rate: float = RATE) -> NDArray:
    """Lose the link after the setpoints `rows`, (F,) int, of a flight, (N, 29) uint8 at `rate`, Hz.

    Returns boxes, (2, F, S, 2, 3) m: low and high corners of the space that the vehicle is in during each TUBE_PART
    from the setpoint on, with heights above the floor, first if its motors stop at once, then if it flies on with that
    setpoint. They enclose the vehicles with all motor lags and errors of the estimate. In the last part the vehicle
    lies on the floor.
    """
    state, airframes, error = decode(payloads), _airframes(limits), limits.link_loss.vertical_acceleration_error
    setpoints = setpoint_rows(state)
    snapshots = _flown(setpoints, limits, airframes, rate, _begins(state, limits, None))[:, rows]
    forks = _Forks(setpoints, rows, snapshots, airframes, parts=_LONGEST // TUBE_PART, part=TUBE_PART)
    alone = _united([_go_on(forks, limits, error), _go_on(forks, limits, -error)])
    tubes = np.stack([_fall(forks, limits), alone])
    tubes[..., 2] -= limits.space.low[2]
    flies = np.flatnonzero((tubes[..., 1, 2] > 0.0).any(axis=(0, 1)))
    return tubes[:, :, : flies.max(initial=0) + 2]


def as_believed(snapshots: NDArray, limits: Limits) -> NDArray:
    """Return those of the snapshots, (L, ...) for each motor lag, that have the airframe's lag in safety.yaml."""
    return np.asarray(snapshots[_lags(limits).index(limits.airframe.motor_time_constant)])


def as_most_sluggish(snapshots: NDArray, limits: Limits) -> tuple[Airframe, NDArray]:
    """Return the airframe with the longest simulated motor lag, and those of the snapshots, (L, ...), that have it."""
    return replace(limits.airframe, motor_time_constant=_lags(limits)[-1]), np.asarray(snapshots[-1])


def _begins(state: FullStateSetpoints, limits: Limits, starts: NDArray | None) -> NDArray:
    """Return the snapshots, (L, 31), at the beginning of a flight, for each motor lag."""
    return np.stack([hovering_snapshot(limits.airframe, state)] * len(_lags(limits))) if starts is None else starts


def _flown(rows: NDArray, limits: Limits, airframes: NDArray, rate: float, begins: NDArray) -> NDArray:
    """Return (L, N, 31): a flight of setpoints, (N, 20), from snapshots (L, 31), at each of them."""
    return _flown_each(rows[None], limits, airframes, rate, begins[:, None])[:, 0]


def _flown_each(rows: NDArray, limits: Limits, airframes: NDArray, rate: float, begins: NDArray) -> NDArray:
    """Return (L, K, M, 31): K flights, (K, M, 20), from snapshots (L, K, 31), at each of their setpoints."""
    flights, length = rows.shape[:2]
    arrivals, first = arrival_times(length, rate), np.tile(rows.shape[1] * np.arange(flights), len(airframes))
    batch = Vehicles(
        begins.reshape(-1, SNAPSHOT_SIZE), np.repeat(airframes, flights, axis=0), first, first + length - 1,
        np.zeros_like(first), np.zeros((len(first), 3)),
    )  # fmt: skip
    schedule = Schedule(
        rows.reshape(-1, SETPOINT_SIZE), np.tile(arrivals, flights), gains_for(limits.airframe).pack(),
        steps=int(arrivals[-1]) + 1,
    )  # fmt: skip
    return simulate(batch, schedule, arrived=length).arrived.reshape(len(airframes), flights, length, SNAPSHOT_SIZE)


def _foreseen(payloads: NDArray, limits: Limits, rate: float, starts: NDArray | None, every: int) -> LinkLossMoments:
    """Return an estimate of where each setpoint ends, from a coarse simulation of one in `every`."""
    state, middle = decode(payloads), _middle(limits)
    rows, airframe = setpoint_rows(state), _airframes(limits)[middle : middle + 1]
    snapshots = _flown(rows, limits, airframe, rate, _begins(state, limits, starts)[middle : middle + 1])
    boxes = _simulate_coarsely(rows, snapshots[0], limits, every)
    return _judge(np.arange(len(rows)) / rate, state.position, boxes, limits, snapshots)


def _simulate_coarsely(rows: NDArray, snapshots: NDArray, limits: Limits, every: int) -> NDArray:
    """Return boxes, (N, S, 2, 3), by one motor lag, coarse steps and one in `every` setpoints.

    `snapshots`, (N, 31), are those of that lag. A setpoint between two simulated ones gets the boxes of both.
    """
    number, middle = np.arange(len(rows)), _middle(limits)
    some = (number % every == 0) | (number == len(rows) - 1)
    airframe = _airframes(limits)[middle : middle + 1]
    boxes = _swept(_Forks(rows, number[some], snapshots[None, some], airframe, _FIRST_STEP), limits)
    after = np.searchsorted(number[some], number)
    return _united([boxes[np.where(some, after, after - 1)], boxes[after]])


def _simulate_sample(
    payloads: NDArray, limits: Limits, rate: float, starts: NDArray | None, within: float | None
) -> LinkLossMoments:
    """Simulate finely the setpoints that may end `within` m of a wall, and the worst; None: that may end outside."""
    state = decode(payloads)
    rows, number = setpoint_rows(state), np.arange(len(payloads))
    snapshots = _flown(rows, limits, _airframes(limits), rate, _begins(state, limits, starts))
    boxes = _simulate_coarsely(rows, snapshots[_middle(limits)], limits, _FIRST_EVERY)
    most = limits.space.swept(boxes)[0] + ALLOWANCE
    near = ~(most < -(within or 0.0))
    if within is not None:
        near |= number == most.argmax()
    _simulate_again(boxes, rows, snapshots, limits, near)
    found = _judge(number / rate, state.position, boxes, limits, snapshots)
    others = ~near & (most > found.beyond[near].max(initial=-np.inf))
    if within is not None and others.any():  # these may be worse
        _simulate_again(boxes, rows, snapshots, limits, others)
        found, near = _judge(number / rate, state.position, boxes, limits, snapshots), near | others
    return replace(found, beyond=np.where(near, found.beyond, most))


def _simulate_again(boxes: NDArray, rows: NDArray, snapshots: NDArray, limits: Limits, some: NDArray) -> None:
    """Replace `some`, (N,) bool, of the boxes, (N, S, 2, 3), of a coarse simulation; `snapshots` are (L, N, 31)."""
    boxes[some] = _swept(_Forks(rows, np.flatnonzero(some), snapshots[:, some], _airframes(limits)), limits)


class _Forks(NamedTuple):
    """Where the link is lost, the time step of the simulation from there, and the boxes that it returns."""

    setpoints: NDArray  # (N, 20)
    rows: NDArray  # (F,) int, the last setpoints
    snapshots: NDArray  # (L, F, 31) when they arrive
    airframes: NDArray  # (L, 26)
    step: int = _STEP  # ms; _FIRST_STEP in the coarse simulation
    parts: int = 0  # boxes of each sweep; 0: one, or _PARTS if there are obstacles
    part: int = PART  # ms of each box, if there are several


def _swept(forks: _Forks, limits: Limits) -> NDArray:
    """Return the boxes swept from the forks, (F, S, 2, 3) m."""
    error = limits.link_loss.vertical_acceleration_error
    swept = _united([_fall(forks, limits), _go_on(forks, limits, error)])
    beyond, _ = limits.space.swept(swept)
    near = ~(beyond < -_NEAR)
    if error and forks.step == _STEP and near.any():
        some = forks._replace(rows=forks.rows[near], snapshots=forks.snapshots[:, near])
        swept[near] = _united([swept[near], _go_on(some, limits, -error)])
    return swept


def _go_on(forks: _Forks, limits: Limits, error: float) -> NDArray:
    """Fly on with the last setpoints; the accelerometer reads `error`, m/s², too little."""
    off, step = Timeouts().motors_off_at_latest(limits.firmware.watchdog), forks.step
    level, off = (step * round(1000 * each / step) for each in (LEVEL_AFTER, off))
    return _lose_link(forks, limits, error, _without_setpoints(forks, limits)._replace(
        level_after=level, off_after=off, spread=_drift(limits, off, step)
    ))  # fmt: skip


def _fall(forks: _Forks, limits: Limits) -> NDArray:
    """Stop the motors at once; the coarse simulation uses both extremes of motor lag, the flight before only one."""
    airframes = forks.airframes if forks.step == _STEP else _airframes(limits)[[0, -1]]
    snapshots = np.broadcast_to(forks.snapshots, (len(airframes), *forks.snapshots.shape[1:]))
    forks = forks._replace(snapshots=snapshots, airframes=airframes)
    return _lose_link(forks, limits, 0.0, _without_setpoints(forks, limits)._replace(off_after=0))


def _without_setpoints(forks: _Forks, limits: Limits) -> Schedule:
    arrivals, gains = np.zeros(len(forks.setpoints), dtype=np.int64), gains_for(limits.airframe).pack()
    step = forks.step
    return Schedule(
        forks.setpoints, arrivals, gains, steps=_LONGEST // step, step=step, control=step, part=forks.part
    )  # fmt: skip


def _lose_link(forks: _Forks, limits: Limits, error: float, schedule: Schedule) -> NDArray:
    """Return the boxes, (F, S, 2, 3) m, of all airframes together."""
    lags, count = len(forks.airframes), len(forks.rows)
    last = np.tile(forks.rows, lags)
    batch = Vehicles(
        forks.snapshots.reshape(-1, SNAPSHOT_SIZE), np.repeat(forks.airframes, count, axis=0), last, last,
        np.full(len(last), NEVER), np.tile([0.0, 0.0, error], (len(last), 1)),
    )  # fmt: skip
    parts = forks.parts or (_PARTS if limits.space.obstacles else 1)
    boxes = simulate(batch, schedule, parts=parts).boxes
    if forks.parts:
        _keep_drift(boxes, schedule, limits.space.low[2])
    return _united(list(boxes.reshape(lags, count, parts, 2, 3)))


def _keep_drift(boxes: NDArray, schedule: Schedule, floor: float) -> None:
    """Widen the boxes, (F, S, 2, 3) m, of vehicles that lie on the `floor`, m, by the drift at touchdown.

    Boxes after the end of the simulation repeat the one in which the vehicle came down; their tops become the floor.
    """
    lies = boxes[:, :, 1, 2] <= floor
    steps = lies.argmax(axis=1) * schedule.part // schedule.step
    aside = np.where(lies, schedule.spread[np.minimum(steps, len(schedule.spread) - 1)][:, None], 0.0)[..., None]
    boxes[:, :, 0, :2] -= aside
    boxes[:, :, 1, :2] += aside
    ended = (boxes[:, 1:] == boxes[:, :-1]).all(axis=(2, 3)) & (boxes[:, 1:, 0, 2] <= floor)
    boxes[:, 1:, 1, 2][ended] = floor


def _drift(limits: Limits, off: int, step: int) -> NDArray:
    """Return the drift to a side through errors of attitude and velocity, after each step, m."""
    attitude_error, velocity_error = estimate_errors(limits)
    airframe = limits.airframe
    push, damping = GRAVITY * math.tan(attitude_error), max(airframe.drag[0] / airframe.mass, 1e-6)
    time = 0.001 * step * np.arange(_LONGEST // step + 1)
    powered, alone = np.minimum(time, 0.001 * off), np.maximum(time - 0.001 * off, 0.0)
    speed = velocity_error * np.exp(-damping * powered) - push * np.expm1(-damping * powered) / damping
    speed *= np.exp(-damping * alone)
    return np.asarray(np.cumsum(0.5 * (speed[:-1] + speed[1:])) * 0.001 * step)


def _judge(time: NDArray, place: NDArray, swept: NDArray, limits: Limits, snapshots: NDArray) -> LinkLossMoments:
    """Compare swept boxes, (N, S, 2, 3) m, with the space."""
    beyond, face = limits.space.swept(swept)
    away = np.maximum(place - swept[:, :, 0].min(axis=1), swept[:, :, 1].max(axis=1) - place)[:, :2]
    return LinkLossMoments(time, place, swept, beyond, face, np.hypot(away[:, 0], away[:, 1]), snapshots)


def _united(boxes: list[NDArray]) -> NDArray:
    """Return boxes, (N, S, 2, 3), that enclose the corresponding ones of a list."""
    low, high = np.min([each[:, :, 0] for each in boxes], axis=0), np.max([each[:, :, 1] for each in boxes], axis=0)
    return np.stack([low, high], axis=2)


def _airframes(limits: Limits) -> NDArray:
    """Return (L, 26): the airframe with each motor lag."""
    return _packed(limits.airframe, tuple(_lags(limits)), limits.space.low[2])


@lru_cache(maxsize=8)
def _packed(airframe: Airframe, lags: tuple[float, ...], floor: float) -> NDArray:
    each: list[Airframe] = [replace(airframe, motor_time_constant=lag) for lag in lags]
    return np.stack([pack_airframe(one, floor=floor) for one in each])


def _lags(limits: Limits) -> list[float]:
    return sorted({*limits.link_loss.motor_lags, limits.airframe.motor_time_constant})


def _middle(limits: Limits) -> int:
    """Return the index of the coarse simulation's motor lag."""
    return len(_lags(limits)) // 2
