"""Fall after link loss in an on-board flight: where the vehicle lands once its watchdog stops the motors.

Before that its commander flies on blind for a second. Errors of attitude, velocity and vertical acceleration as large
as safety.yaml allows displace it in any direction. Then the motors stop with a lag τ, during which the specific thrust
f = a + g decays; so from the state p, v, a

    p(t) = p + v t + ½ g t² + f τ (t - τ (1 - exp(-t/τ)))

down to the floor, for no lag and for the longest one. Drag, which would slow the vehicle, is neglected.
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.firmware import Timeouts, estimate_errors
from cfplan.flight.on_board.go_to import stop_targets
from cfplan.safety.limits import Limits
from cfplan.safety.space import SIDES
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.trajectory import FullState, Trajectory

_LONGEST, _MOMENTS = 1.6, 81  # s of a fall, from 8 m; number of moments computed
_PARTS = tuple(slice(begin, begin + 9) for begin in range(0, _MOMENTS - 1, 8))
"""Moments of each part of a fall; with obstacles each part has its own box. Neighbouring parts share a moment."""
_G = np.array([0.0, 0.0, GRAVITY])
_KEEP_ALIVE_AGE = 0.12  # s; the last keep-alive packet may be this old when the link dies: 0.1 s and two ticks
_WATCHDOG_SAMPLES = 4  # of the times at which the watchdog may stop the motors, in a tube
_TUBE_STEP = 0.02  # s between the moments of a tube


@dataclass(frozen=True, slots=True)
class Falls:
    """Where the vehicle falls from each of N states, motors off."""

    beyond: NDArray  # (N,) m beyond a wall or the ceiling, or into an obstacle; negative inside
    face: NDArray  # (N,) int, the number of that face of the space, or of the nearest one
    reach: NDArray  # (N,) m, how far it moves towards that wall; horizontally if it is an obstacle
    distance: NDArray  # (N,) m, horizontally, to the far corner of the box that it sweeps

    @property
    def worst(self) -> int:
        """Return the number of the state that ends farthest out; NaN counts as farthest."""
        return int(np.argmax(np.where(np.isnan(self.beyond), np.inf, self.beyond)))


def falls_from(states: NDArray, limits: Limits, deviation: float) -> Falls:
    """Stop the motors in each of N states, (N, 3 or more, 3 or more): position, velocity and acceleration, SI units.

    The vehicle is within `deviation`, m, of these before its link dies.
    """
    position, velocity, acceleration = (states[:, order, :3] for order in range(3))
    time, floor = np.linspace(0.0, _LONGEST, _MOMENTS), limits.space.low[2]
    boxes = np.empty((len(states), len(_PARTS) if limits.space.obstacles else 1, 2, 3))
    boxes[:, :, 0], boxes[:, :, 1] = np.inf, -np.inf
    for lag in (0.0, _longest_lag(limits)):
        place = _fallen(position, velocity, acceleration, time, lag)
        in_air = np.concatenate([np.ones((len(states), 1), bool), place[:, :-1, 2] > floor], axis=1)[..., None]
        aside, up = _astray(limits, time, Timeouts().watchdog_at_latest)
        spread = np.stack([aside + deviation, aside + deviation, up + deviation + 0.0 * time], axis=1)
        low, high = np.where(in_air, place - spread, np.inf), np.where(in_air, place + spread, -np.inf)
        for part, some in enumerate(_PARTS if limits.space.obstacles else (slice(None),)):
            boxes[:, part, 0] = np.minimum(boxes[:, part, 0], low[:, some].min(axis=1))
            boxes[:, part, 1] = np.maximum(boxes[:, part, 1], high[:, some].max(axis=1))
    for part in range(1, boxes.shape[1]):  # the rest of the fall, if it is on the floor already
        boxes[:, part] = np.where(
            boxes[:, part] == (np.array([np.inf, -np.inf])[:, None]), boxes[:, part - 1], boxes[:, part]
        )
    beyond, face = limits.space.swept(boxes)
    low, high = boxes[:, :, 0].min(axis=1), boxes[:, :, 1].max(axis=1)
    away = np.maximum(position - low, high - position)[:, :2]
    distance = np.hypot(away[:, 0], away[:, 1])
    to_walls = np.concatenate([position - low, high - position], axis=1)
    reach = np.where(face < SIDES, to_walls[np.arange(len(face)), np.minimum(face, SIDES - 1)], distance)
    return Falls(beyond, face, reach, distance)


def fall_tubes(
    trajectory: Trajectory, times: NDArray, limits: Limits, *, deviation: float, part: float, stops: tuple[float, float]
) -> NDArray:
    """Lose a vehicle at each time, (R,) s, of a trajectory that it flies on board.

    Returns boxes, (4, R, S, 2, 3) m: low and high corners of the space that the vehicle is in during each `part`, s,
    from that time on, with heights above the floor, in four ways: its motors stop at once, and in the last part it lies
    on the floor; its link dies, and the link is back before the watchdog stops the motors, sooner or later, and the
    vehicle flies to where the stop leads that the pilot has ordered meanwhile, and hovers there; the watchdog stops the
    motors. `stops` are when, s after the loss, the pilot orders a stop at the earliest and at the latest. The boxes
    enclose falls without lag and with the longest one, and a vehicle within `deviation`, m, of the trajectory before.
    """
    timeouts = Timeouts()
    watchdog = np.linspace(timeouts.keep_alive - _KEEP_ALIVE_AGE, timeouts.watchdog_at_latest, _WATCHDOG_SAMPLES)
    stride = round(part / _TUBE_STEP)
    parts = math.ceil((watchdog[-1] + _LONGEST) / part)
    moments = _TUBE_STEP * np.arange(parts * stride + 1)
    flies = times[:, None] + moments[moments <= watchdog[-1]]
    flown = trajectory.path(trajectory.s_at(flies.ravel())).reshape(*flies.shape, 3)
    tubes = np.empty((4, len(times), parts, 2, 3))
    for way, cuts in ((0, np.zeros(1)), (3, watchdog)):
        low, high = np.full((len(times), len(moments), 3), np.inf), np.full((len(times), len(moments), 3), -np.inf)
        for cut, lag, rises in itertools.product(cuts, (0.0, _longest_lag(limits)), (-1.0, 1.0)):
            place, aside = _falling(
                trajectory, times, flown, moments, cut=cut, lag=lag, rises=rises, deviation=deviation, limits=limits
            )
            aside = np.stack([aside, aside, np.zeros_like(aside)], axis=2)
            low, high = np.minimum(low, place - aside), np.maximum(high, place + aside)
        for number in range(parts):
            within = slice(number * stride, (number + 1) * stride + 1)
            tubes[way, :, number, 0], tubes[way, :, number, 1] = low[:, within].min(axis=1), high[:, within].max(axis=1)
    halves = np.array_split(np.arange(stops[0], watchdog[-1] + _TUBE_STEP, _TUBE_STEP), 2)
    ordered = np.arange(stops[0], stops[1] + _TUBE_STEP, _TUBE_STEP)
    tubes[1:3] = tubes[3]
    for way, back in enumerate(halves, start=1):
        places = [trajectory.at(times + later).position for later in back]
        if way == 2:
            places += [_stop_from(trajectory.at(times + later)) for later in ordered]
        _enclose(tubes[way, :, int(stops[0] / part) :], np.stack(places), limits, deviation)
    tubes[..., 2] -= limits.space.low[2]
    return tubes


def _stop_from(state: FullState) -> NDArray:
    """Return where stops by go-to from states lead, (R, 3) m."""
    begin = np.zeros((len(state.position), 3, 4))
    begin[:, :, :3] = np.stack([state.position, state.velocity, state.acceleration], axis=1)
    return stop_targets(begin)[:, :3]


def _enclose(boxes: NDArray, places: NDArray, limits: Limits, deviation: float) -> None:
    """Replace boxes, (R, P, 2, 3) m, by one that encloses a vehicle near all of its places, (K, R, 3) m, in the air."""
    aside = float(_astray(limits, np.zeros(1), Timeouts().watchdog_at_latest)[0][0]) + deviation
    spread = np.array([aside, aside, 0.0])
    boxes[:, :, 0], boxes[:, :, 1] = places.min(axis=0)[:, None] - spread, places.max(axis=0)[:, None] + spread


def _longest_lag(limits: Limits) -> float:
    return max(*limits.link_loss.motor_lags, limits.airframe.motor_time_constant)


def _falling(
    trajectory: Trajectory, times: NDArray, flown: NDArray, moments: NDArray, *, cut: float, lag: float, rises: float,
    deviation: float, limits: Limits,
) -> tuple[NDArray, NDArray]:  # fmt: skip
    """Return where a vehicle is whose motors stop `cut`, s, after each time, (R, M, 3) m; and how far astray, (R, M) m.

    `flown`, (R, F, 3) m, is the trajectory at the first F of the moments, (M,) s. The vehicle is higher by `rises`, -1
    to 1, times the deviation, m, and what the error of its vertical acceleration makes. On the floor it stays.
    """
    after, blind = np.maximum(moments - cut, 0.0), np.minimum(moments, cut)
    state = trajectory.at(times + cut)
    place = _fallen(state.position, state.velocity, state.acceleration, after, lag)
    flies = moments <= cut
    place[:, flies] = flown[:, : np.count_nonzero(flies)]
    climb = limits.link_loss.vertical_acceleration_error * (0.5 * blind**2 + blind * after)
    place[..., 2] += rises * (deviation + climb)
    aside = np.broadcast_to(deviation + _astray(limits, after, blind)[0], place.shape[:2])
    lies = (place[..., 2] <= limits.space.low[2]) & ~flies
    touches = np.where(lies.any(axis=1), lies.argmax(axis=1), len(moments) - 1)
    rows, there = np.arange(len(times))[:, None], np.minimum(np.arange(len(moments)), touches[:, None])
    place = place[rows, there]
    place[np.arange(len(moments)) >= touches[:, None], 2] = limits.space.low[2]
    return place, aside[rows, there]


def _fallen(position: NDArray, velocity: NDArray, acceleration: NDArray, time: NDArray, lag: float) -> NDArray:
    """Return the places, (R, M, 3) m, of vehicles in states, (R, 3) each, a `time`, (M,) s, after their motors stop."""
    pushed = lag * (time - lag * -np.expm1(-time / lag)) if lag else np.zeros_like(time)
    return np.asarray(
        position[:, None]
        + time[:, None] * velocity[:, None]
        - (0.5 * time**2)[:, None] * _G
        + pushed[:, None] * (acceleration + _G)[:, None]
    )


def _astray(limits: Limits, time: NDArray, blind: NDArray | float) -> tuple[NDArray, NDArray | float]:
    """Return the displacement, m, after flying blind for `blind`, s, and a fall of `time`, s: sideways, and upwards."""
    attitude_error, velocity_error = estimate_errors(limits)
    push = GRAVITY * math.tan(attitude_error)
    aside = velocity_error * blind + 0.5 * push * blind**2
    speed = velocity_error + push * blind
    return aside + speed * time, 0.5 * limits.link_loss.vertical_acceleration_error * blind**2
