"""Fall after link loss in an on-board flight: where the vehicle lands once its watchdog stops the motors.

Before that its commander flies on blind for a second. Errors of attitude, velocity and vertical acceleration as large
as safety.yaml allows displace it in any direction. Then the motors stop with a lag τ, during which the specific thrust
f = a + g decays; so from the state p, v, a

    p(t) = p + v t + ½ g t² + f τ (t - τ (1 - exp(-t/τ)))

down to the floor, for no lag and for the longest one. Drag, which would slow the vehicle, is neglected.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.firmware import Timeouts, estimate_errors
from cfplan.safety.limits import Limits
from cfplan.safety.space import SIDES
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.trajectory import Trajectory

_LONGEST, _MOMENTS = 1.6, 81  # s of a fall, from 8 m; number of moments computed
_PARTS = tuple(slice(begin, begin + 9) for begin in range(0, _MOMENTS - 1, 8))
"""Moments of each part of a fall; with obstacles each part has its own box. Neighbouring parts share a moment."""
_G = np.array([0.0, 0.0, GRAVITY])
_KEEP_ALIVE_PERIOD = 0.1  # s: so long before its link died the last keep-alive packet may have arrived
_CUTS = 4  # moments within what that leaves open at which the watchdog stops the motors, in tubes
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
    for lag in (0.0, max(*limits.link_loss.motor_lags, limits.airframe.motor_time_constant)):
        pushed = lag * (time - lag * -np.expm1(-time / lag)) if lag else np.zeros_like(time)
        place = (
            position[:, None]
            + time[:, None] * velocity[:, None]
            - (0.5 * time**2)[:, None] * _G
            + pushed[:, None] * (acceleration + _G)[:, None]
        )  # (N, moments, 3)
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


def fall_tubes(trajectory: Trajectory, times: NDArray, limits: Limits, deviation: float, part: float) -> NDArray:
    """Lose a vehicle at each time, (R,) s, of a trajectory that it flies on board.

    Returns boxes, (2, R, S, 2, 3) m: low and high corners of the space that the vehicle is in during each `part`, s,
    from that time on, first if its motors stop at once, then if its link dies and the watchdog stops them. They enclose
    falls without lag and with the longest one, and a vehicle within `deviation`, m, of the trajectory before. In the
    last part it lies on the floor.
    """
    timeouts = Timeouts()
    watchdog = np.linspace(timeouts.keep_alive - _KEEP_ALIVE_PERIOD, timeouts.watchdog_at_latest, _CUTS)
    stride = round(part / _TUBE_STEP)
    parts = math.ceil((watchdog[-1] + _LONGEST) / part)
    moments = _TUBE_STEP * np.arange(parts * stride + 1)
    flies = times[:, None] + moments[moments <= watchdog[-1]]
    flown = trajectory.path(trajectory.s_at(flies.ravel())).reshape(*flies.shape, 3)
    tubes = np.empty((2, len(times), parts, 2, 3))
    for way, cuts in enumerate((np.zeros(1), watchdog)):
        low, high = np.full((len(times), len(moments), 3), np.inf), np.full((len(times), len(moments), 3), -np.inf)
        for cut in cuts:
            for lag in (0.0, max(*limits.link_loss.motor_lags, limits.airframe.motor_time_constant)):
                place, spread = _falling(trajectory, times, flown, moments, cut=float(cut), lag=lag, limits=limits)
                spread[..., :2] += deviation
                low, high = np.minimum(low, place - spread), np.maximum(high, place + spread)
        for number in range(parts):
            within = slice(number * stride, (number + 1) * stride + 1)
            tubes[way, :, number, 0], tubes[way, :, number, 1] = low[:, within].min(axis=1), high[:, within].max(axis=1)
    return tubes


def _falling(
    trajectory: Trajectory, times: NDArray, flown: NDArray, moments: NDArray, *, cut: float, lag: float, limits: Limits
) -> tuple[NDArray, NDArray]:
    """Return where a vehicle is whose motors stop `cut`, s, after each time, and how far astray: both (R, M, 3) m.

    `flown`, (R, F, 3) m, is the trajectory at the first F of the moments, (M,) s. On the floor it stays where it is.
    """
    state, after = trajectory.at(times + cut), np.maximum(moments - cut, 0.0)
    pushed = lag * (after - lag * -np.expm1(-after / lag)) if lag else np.zeros_like(after)
    place = (
        state.position[:, None]
        + after[:, None] * state.velocity[:, None]
        - (0.5 * after**2)[:, None] * _G
        + pushed[:, None] * (state.acceleration + _G)[:, None]
    )
    flies = moments <= cut
    place[:, flies] = flown[:, : np.count_nonzero(flies)]
    aside, up = _astray(limits, after, np.minimum(moments, cut))
    spread = np.broadcast_to(np.stack([aside, aside, up], axis=1), place.shape)
    lies = (place[..., 2] <= limits.space.low[2]) & ~flies
    touches = np.where(lies.any(axis=1), lies.argmax(axis=1), len(moments) - 1)
    rows = np.arange(len(times))[:, None]
    there = np.minimum(np.arange(len(moments)), touches[:, None])
    place, spread = place[rows, there], spread[rows, there].copy()
    down = np.arange(len(moments)) >= touches[:, None]
    place[down, 2], spread[down, 2] = limits.space.low[2], 0.0
    return place, spread


def _astray(limits: Limits, time: NDArray, blind: NDArray | float) -> tuple[NDArray, NDArray | float]:
    """Return the displacement, m, after flying blind for `blind`, s, and a fall of `time`, s: sideways, and upwards."""
    attitude_error, velocity_error = estimate_errors(limits)
    push = GRAVITY * math.tan(attitude_error)
    aside = velocity_error * blind + 0.5 * push * blind**2
    speed = velocity_error + push * blind
    return aside + speed * time, 0.5 * limits.link_loss.vertical_acceleration_error * blind**2
