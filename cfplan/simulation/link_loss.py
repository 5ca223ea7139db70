"""Link loss: where the vehicle goes by itself when its pilot or its radio dies, or its motors stop at once.

By the firmware's own time-outs it holds the last setpoint, then levels out at that height, then stops its motors. While
it levels out, the controller keeps the body rates of that last setpoint, which is why setpoints carry rates that brake
(see flight/setpoints/rate_trade.py). Where it comes down depends on the moment, so every setpoint is made the last one:
the flight before is simulated once, in steps of 1 ms, and branches off at each setpoint in steps of 4 ms, until the
vehicle has settled in its level-out; from there on its attitude stands still, and only its place is followed.

The motors may also stop at once, because the pilot cuts them, or the supervisor locks. Then the vehicle falls with the
speed that it has, which from 2 m/s and a height of 1.2 m is a metre on: where it brakes late before a wall, farther
than link loss takes it. So the box that it sweeps holds the fall from each setpoint too.

No poses come any more either. The vehicle then flies by gyroscope and accelerometer. An attitude that it has wrong by
a little, and a velocity that it has wrong already, make it drift to a side, by as much wherever it is, so each place
widens the box that the vehicle sweeps by how far that drift has come until then. An accelerometer that says too little
makes it believe that it sinks, and climb: it is simulated so. One that says too much makes it come down sooner, with
less thrust to brake by, which takes it some millimetres farther to the sides; that is simulated as well where the
vehicle comes near a wall.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.firmware import Timeouts, gains_for
from cfplan.flight.setpoints.encoding import RATE
from cfplan.flight.setpoints.packets import PAYLOAD_SIZE, FullStateSetpoints, decode
from cfplan.safety.limits import Limits
from cfplan.safety.space import SIDES, inside
from cfplan.simulation.dynamics.body import pack_body
from cfplan.simulation.dynamics.branching import SNAPSHOT_SIZE, arrival_steps, hovering_snapshot, setpoint_rows
from cfplan.simulation.dynamics.mellinger import SETPOINT_SIZE
from cfplan.simulation.left_alone import LIFT, fly_to_each, leave_alone, leave_alone_in_stops
from cfplan.vehicle.airframe import GRAVITY, Airframe

# s after the last setpoint; the same in every firmware that may fly, see flight/firmware.py
LEVEL_AFTER, OFF_AFTER = Timeouts().level_out_at_latest, Timeouts().motors_off_at_latest
OFF_BY_WATCHDOG = Timeouts().watchdog_at_latest  # if the emergency-stop watchdog is enabled
_PARTS = 9  # boxes of a sweep, if there are obstacles
_WORTH_THREADS = 400  # setpoints, of which each motor lag has a thread
_Body = TypeVar("_Body")
_Found = TypeVar("_Found")
_STEP, _COARSE_STEP = 0.004, 0.008  # s, of the simulation after the last setpoint, and where it only looks for walls
_NEAR = 0.1  # m from a wall, within which it also matters that the accelerometer may say too much
_COARSE_EVERY = 2  # setpoints between those that are looked at coarsely
_FORESEEN_EVERY = 16  # likewise, for an estimate
ALLOWANCE = 0.1  # m, by which what is looked at coarsely may end farther out; 0.07 m at most in 36 flights, to 3 m/s
_SLOW_EVERY, _SLOW_ALLOWANCE = (
    8,
    0.02,
)  # both for motions at 0.9 m/s and 2 m/s²; m, of which 6 mm were seen in 240 motions


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
    """What the vehicle sweeps after each setpoint, were it the last one: the worst of all motor lags."""

    time: NDArray  # (N,) s of each setpoint from the first
    place: NDArray  # (N, 3) m, of each setpoint
    boxes: NDArray  # (N, S, 2, 3) m, low and high corners of what the vehicle sweeps down to the floor, in S parts
    beyond: NDArray  # (N,) m beyond a wall or the ceiling, or into an obstacle; negative inside
    face: NDArray  # (N,) int, the number of that face of the space, or of the nearest one
    distance: NDArray  # (N,) m, horizontally from the setpoint to the far corner of the box
    snapshots: NDArray  # (L, N, 31) as in `branching`, at each setpoint, for each motor lag; (L, 0, 31) within stops

    @property
    def worst(self) -> LinkLoss:
        """Return the setpoint after which the vehicle ends farthest out; what is not a number is farthest."""
        at = int(np.argmax(np.where(np.isnan(self.beyond), np.inf, self.beyond)))
        at_obstacle = bool(self.face[at] >= SIDES)
        return LinkLoss(float(self.time[at]), float(self.distance[at]), float(self.beyond[at]), at_obstacle)

    @property
    def low(self) -> NDArray:
        """Return (N, 3) m, the low corner of all that the vehicle sweeps."""
        return np.asarray(self.boxes[:, :, 0].min(axis=1))

    @property
    def high(self) -> NDArray:
        """Return (N, 3) m, the high corner of all that the vehicle sweeps."""
        return np.asarray(self.boxes[:, :, 1].max(axis=1))


def simulate_link_loss(payloads: NDArray, limits: Limits, rate: float = RATE) -> LinkLoss:
    """Lose the link at every setpoint of a flight, (N, 29) uint8 at `rate`, Hz; return what ends farthest out."""
    return link_loss_at_every_setpoint(payloads, limits, rate).worst


def link_loss_at_every_setpoint(
    payloads: NDArray, limits: Limits, rate: float = RATE, starts: NDArray | None = None
) -> LinkLossMoments:
    """Lose the link after each setpoint of a flight, (N, 29) uint8 at `rate`, Hz.

    The flight begins in hover, or from the snapshots `starts`, (L, 31), of another at the same setpoint.
    """
    state = decode(payloads)
    snapshots = _snapshots(state, limits, rate, _begins(state, limits, starts))
    return _lose_link(state, limits, rate, snapshots, np.ones(len(payloads), dtype=np.bool_))


def link_loss_near_walls(
    payloads: NDArray, limits: Limits, within: float, rate: float = RATE, starts: NDArray | None = None
) -> LinkLossMoments:
    """Lose the link after each setpoint that may leave the vehicle `within` m of a wall, and after the worst of all.

    Of each other one it is only known how far it ends at most: one motor lag, coarse steps and every other setpoint
    tell, with ALLOWANCE. Its box is as seen so. Arguments as for link_loss_at_every_setpoint, whose worst moment this
    finds in a fraction of the time.
    """
    state = decode(payloads)
    snapshots, seen = _flown_and_seen(state, limits, rate, starts)
    forks = ~(seen.beyond + ALLOWANCE < -within)
    forks[seen.beyond.argmax()] = True
    found = _lose_link(state, limits, rate, snapshots, forks, seen)
    others = ~forks & (found.beyond > found.beyond[forks].max())
    if others.any():  # which may be worse
        found = _lose_link(state, limits, rate, snapshots, forks | others, seen)
    return found


def link_loss_at_walls(
    payloads: NDArray, limits: Limits, rate: float = RATE, starts: NDArray | None = None
) -> LinkLossMoments:
    """Lose the link after each setpoint that may leave the vehicle beyond a wall.

    As link_loss_near_walls does, but of a flight that ends inside from everywhere it does not find the worst moment.
    """
    state = decode(payloads)
    snapshots, seen = _flown_and_seen(state, limits, rate, starts)
    return _lose_link(state, limits, rate, snapshots, ~(seen.beyond + ALLOWANCE < 0.0), seen)


def foreseen_link_loss(
    payloads: NDArray, limits: Limits, rate: float = RATE, starts: NDArray | None = None
) -> LinkLossMoments:
    """Return about how each setpoint ends, were it the last one: an estimate, by one motor lag and coarse steps.

    It takes a tenth of what link_loss_at_walls() takes.
    """
    return _foreseen(decode(payloads), limits, rate, starts, _FORESEEN_EVERY)


def _foreseen(
    state: FullStateSetpoints, limits: Limits, rate: float, starts: NDArray | None, every: int
) -> LinkLossMoments:
    """Return about how each setpoint ends, looking at one in `every`."""
    begins, bodies = _begins(state, limits, starts), _bodies(limits)
    middle = len(bodies) // 2
    return _look_coarsely(state, limits, rate, _flown(state, limits, rate, bodies[middle][0], begins[middle]), every)


def _begins(state: FullStateSetpoints, limits: Limits, starts: NDArray | None) -> list[NDArray]:
    """Return the snapshot that a flight begins from, for each motor lag."""
    return [hovering_snapshot(limits.airframe, state)] * len(_lags(limits)) if starts is None else list(starts)


def _snapshots(state: FullStateSetpoints, limits: Limits, rate: float, begins: list[NDArray]) -> NDArray:
    """Return (L, N, 31) vehicle and controller at each setpoint, for each motor lag, where the link is not lost."""
    bodies = [body for body, _ in _bodies(limits)]
    return np.array(
        _of_each_lag(lambda body, begin: _flown(state, limits, rate, body, begin), bodies, begins, len(state.position))
    )


def _flown(state: FullStateSetpoints, limits: Limits, rate: float, body: NDArray, begin: NDArray) -> NDArray:
    """Return (N, 31) vehicle and controller at each setpoint, for one motor lag."""
    rows = setpoint_rows(state)
    snapshots = np.empty((len(rows), SNAPSHOT_SIZE))
    fly_to_each(snapshots, rows, begin, _gains(limits), body, arrival_steps(len(rows), rate))
    return snapshots


def _lose_link(
    state: FullStateSetpoints,
    limits: Limits,
    rate: float,
    snapshots: NDArray,
    forks: NDArray,
    seen: LinkLossMoments | None = None,
) -> LinkLossMoments:
    """Lose the link after the setpoints where `forks`, (N,), says so; the others end as seen coarsely, or farther.

    `snapshots`, (L, N, 31), are at each setpoint, for each motor lag.
    """
    time, wrong = np.arange(len(state.position)) / rate, _wrong(limits)
    boxes = _boxes(state, limits, rate, snapshots, forks, wrong, None if seen is None else seen.boxes)
    found = _judge(time, state.position, boxes, limits, snapshots)
    near = forks & ~(found.beyond < -_NEAR)
    if wrong[LIFT] and near.any():
        sinking = _boxes(state, limits, rate, snapshots, near, wrong * (1.0, 1.0, -1.0, 1.0), boxes[0])
        found = _judge(time, state.position, boxes + sinking, limits, snapshots)
    return found if seen is None else replace(found, beyond=np.where(forks, found.beyond, found.beyond + ALLOWANCE))


def _boxes(
    state: FullStateSetpoints,
    limits: Limits,
    rate: float,
    snapshots: NDArray,
    forks: NDArray,
    wrong: NDArray,
    others: NDArray | None,
) -> list[NDArray]:
    """Return for each motor lag the boxes, (N, S, 2, 3), swept from where `forks` says so; `others` at the others."""
    rows = setpoint_rows(state)[forks]

    def one(body: tuple[NDArray, NDArray], begins: NDArray) -> NDArray:
        swept = np.empty((len(rows), _parts(limits), 2, 3))
        leave_alone(swept, begins[forks], rows, _gains(limits), body[1], *_steps(limits), wrong)
        if others is None and len(rows) == len(forks):
            return swept
        boxes = np.empty((len(forks), *swept.shape[1:])) if others is None else others.copy()
        boxes[forks] = swept
        return boxes

    return _of_each_lag(one, _bodies(limits), snapshots, len(rows))


def _look_coarsely(
    state: FullStateSetpoints, limits: Limits, rate: float, snapshots: NDArray, every: int = _COARSE_EVERY
) -> LinkLossMoments:
    """Return how each setpoint ends, by one motor lag, coarse steps and one in `every` setpoints.

    `snapshots`, (N, 31), are at each setpoint, for the motor lag in the middle.
    """
    count = len(state.position)
    rows = np.unique(np.append(np.arange(0, count, every), count - 1))
    boxes = np.empty((len(rows), _parts(limits), 2, 3))
    leave_alone(
        boxes, snapshots[rows], setpoint_rows(state)[rows], _gains(limits), _coarse_bodies(limits),
        *_steps(limits, _COARSE_STEP), _wrong(limits),
    )  # fmt: skip
    before = np.repeat(np.arange(len(rows)), np.diff(rows, append=count))
    after = np.where(np.isin(np.arange(count), rows), before, np.minimum(before + 1, len(rows) - 1))
    box, no_snapshots = _united([boxes[before], boxes[after]]), np.empty((0, count, SNAPSHOT_SIZE))
    return _judge(np.arange(count) / rate, state.position, [box], limits, no_snapshots)


def _flown_and_seen(
    state: FullStateSetpoints, limits: Limits, rate: float, starts: NDArray | None
) -> tuple[NDArray, LinkLossMoments]:
    """Return the snapshots of a flight for each motor lag, and how each setpoint ends as seen coarsely."""
    snapshots = _snapshots(state, limits, rate, _begins(state, limits, starts))
    return snapshots, _look_coarsely(state, limits, rate, snapshots[len(snapshots) // 2])


def as_believed(snapshots: NDArray, limits: Limits) -> NDArray:
    """Return, of snapshots (L, ...) for each motor lag, those with the lag that the airframe has by safety.yaml."""
    return np.asarray(snapshots[_lags(limits).index(limits.airframe.motor_time_constant)])


def as_most_sluggish(snapshots: NDArray, limits: Limits) -> tuple[Airframe, NDArray]:
    """Return the airframe with the longest motor lag that is simulated, and of snapshots (L, ...) those with it."""
    return replace(limits.airframe, motor_time_constant=_lags(limits)[-1]), np.asarray(snapshots[-1])


def link_loss_within_stops(
    stops: NDArray, starts: NDArray, limits: Limits, forks: NDArray, rate: float = RATE, *, coarsely: bool = False
) -> LinkLossMoments:
    """Lose the link in K stops, (K, M, 29) uint8 at `rate`, Hz, after those of their setpoints where `forks`, (K, M).

    Each stop begins from a snapshot of its flight, `starts`, (L, K, 31) for each motor lag, as the moments of a plan
    hold them. Returns a moment for each fork, one stop after another; times are from the first setpoint of the stop.
    Coarsely, by one motor lag and coarse steps, what ends farther out than it seems does so by less than ALLOWANCE.
    """
    rows = setpoint_rows(decode(stops.reshape(-1, PAYLOAD_SIZE))).reshape(*stops.shape[:2], SETPOINT_SIZE)
    arrivals, wrong, gains = arrival_steps(stops.shape[1], rate), _wrong(limits), _gains(limits)
    steps = _steps(limits, _COARSE_STEP if coarsely else _STEP)

    def one(body: tuple[NDArray, NDArray], begin: NDArray) -> NDArray:
        boxes = np.empty((np.count_nonzero(forks), _parts(limits), 2, 3))
        leave_alone_in_stops(boxes, rows, begin, forks, gains, *body, *steps, arrivals, wrong)
        return boxes

    begins = np.ascontiguousarray(starts)  # compiled for one layout
    middle = len(begins) // 2
    if coarsely:
        boxes = [one((_bodies(limits)[middle][0], _coarse_bodies(limits)), begins[middle])]
    else:
        boxes = _of_each_lag(one, _bodies(limits), begins, len(stops))
    times, places = np.nonzero(forks)[1] / rate, rows[..., 0:3][forks]
    return _judge(times, places, boxes, limits, np.empty((len(boxes), 0, SNAPSHOT_SIZE)))


def link_loss_of_slow_motion(payloads: NDArray, limits: Limits, rate: float = RATE) -> LinkLossMoments:
    """Lose the link at setpoints of take-off, of the way to the start or of landing, (N, 29) uint8 at `rate`, Hz.

    A coarse look at every eighth one tells unless one ends near a wall: then each is simulated with every motor lag.
    """
    seen = _foreseen(decode(payloads), limits, rate, None, _SLOW_EVERY)
    if seen.worst.beyond < -_SLOW_ALLOWANCE:
        return seen
    return link_loss_at_every_setpoint(payloads, limits, rate)


def _wrong(limits: Limits) -> NDArray:
    """Return what the vehicle has wrong, (4,).

    That is m/s² to a side, the damping of that motion by drag in 1/s, m/s² upwards, and m/s to a side.
    """
    wrong, drag = limits.link_loss, limits.airframe.drag[0]
    push, damping = GRAVITY * math.tan(wrong.attitude_error), max(drag / limits.airframe.mass, 1e-6)
    return np.array([push, damping, wrong.vertical_acceleration_error, wrong.velocity_error])


def _judge(time: NDArray, place: NDArray, boxes: list[NDArray], limits: Limits, snapshots: NDArray) -> LinkLossMoments:
    """Return the worst of the boxes, (N, S, 2, 3) m, of each motor lag."""
    swept = _united(boxes)
    beyond, face = limits.space.swept(swept)
    away = np.maximum(place - swept[:, :, 0].min(axis=1), swept[:, :, 1].max(axis=1) - place)[:, :2]
    return LinkLossMoments(time, place, swept, beyond, face, np.hypot(away[:, 0], away[:, 1]), snapshots)


def _united(boxes: list[NDArray]) -> NDArray:
    """Return boxes, (N, S, 2, 3), that enclose the corresponding ones of a list."""
    low, high = np.min([each[:, :, 0] for each in boxes], axis=0), np.max([each[:, :, 1] for each in boxes], axis=0)
    return np.stack([low, high], axis=2)


def _parts(limits: Limits) -> int:
    """Return how many boxes a sweep is cut into; one suffices for walls."""
    return _PARTS if limits.space.obstacles else 1


def _of_each_lag(
    work: Callable[[_Body, NDArray], _Found], bodies: Sequence[_Body], begins: Iterable[NDArray], count: int
) -> list[_Found]:
    """Return what work gives for each motor lag; `count` is of the setpoints, or stops, that it looks at.

    It is done side by side where that takes longer than threads take to begin.
    """
    if count < _WORTH_THREADS:
        return [work(body, begin) for body, begin in zip(bodies, begins, strict=True)]
    with ThreadPoolExecutor() as pool:
        return list(pool.map(work, bodies, begins))


def _bodies(limits: Limits) -> tuple[tuple[NDArray, NDArray], ...]:
    """Return for each motor lag the parameters of the body for steps before the last setpoint, (P,), and after it.

    The latter, (2, P), are of the vehicle that goes on alone, and of the one whose motors stop.
    """
    return _bodies_with(limits.airframe, tuple(_lags(limits)))


@lru_cache(maxsize=8)
def _bodies_with(airframe: Airframe, lags: tuple[float, ...]) -> tuple[tuple[NDArray, NDArray], ...]:
    airframes: list[Airframe] = [replace(airframe, motor_time_constant=lag) for lag in lags]
    return tuple((pack_body(each), np.stack([pack_body(each, step=_STEP)] * 2)) for each in airframes)


def _coarse_bodies(limits: Limits) -> NDArray:
    """Return (3, P): with the motor lag in the middle after the last setpoint, and falling with both extremes."""
    lags = _lags(limits)
    return _coarse_bodies_with(limits.airframe, (lags[len(lags) // 2], lags[0], lags[-1]))


@lru_cache(maxsize=8)
def _coarse_bodies_with(airframe: Airframe, lags: tuple[float, ...]) -> NDArray:
    airframes: list[Airframe] = [replace(airframe, motor_time_constant=lag) for lag in lags]
    return np.stack([pack_body(each, step=_COARSE_STEP) for each in airframes])


def _lags(limits: Limits) -> list[float]:
    return sorted({*limits.link_loss.motor_lags, limits.airframe.motor_time_constant})


def _gains(limits: Limits) -> NDArray:
    return gains_for(limits.airframe).pack()


def _steps(limits: Limits, step: float = _STEP) -> tuple[int, int]:
    """Return after how many steps of a branch the vehicle levels out, and after how many its motors stop."""
    off = OFF_BY_WATCHDOG if limits.firmware.watchdog else OFF_AFTER
    return round(LEVEL_AFTER / step), round(off / step)
