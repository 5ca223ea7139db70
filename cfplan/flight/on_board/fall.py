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

_LONGEST, _MOMENTS = 1.6, 81  # s of a fall, from 8 m; number of moments computed
_PARTS = tuple(slice(begin, begin + 9) for begin in range(0, _MOMENTS - 1, 8))
"""Moments of each part of a fall; with obstacles each part has its own box. Neighbouring parts share a moment."""
_G = np.array([0.0, 0.0, GRAVITY])


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
        aside, up = _astray(limits, time)
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


def _astray(limits: Limits, time: NDArray) -> tuple[NDArray, float]:
    """Return the displacement, m, after a blind second and a fall of `time`, s: sideways, and upwards."""
    (attitude_error, velocity_error), blind = estimate_errors(limits), Timeouts().watchdog_at_latest
    push = GRAVITY * math.tan(attitude_error)
    aside = velocity_error * blind + 0.5 * push * blind**2
    speed = velocity_error + push * blind
    return aside + speed * time, 0.5 * limits.link_loss.vertical_acceleration_error * blind**2
