"""The fall that ends an on-board flight whose link dies: where the vehicle meets the floor once its watchdog acts.

Until then its commander flies on, for a second and blind: an attitude, a velocity and a vertical acceleration that it
has wrong by as much as safety.yaml says carry it off its way, to any side. Then the motors stop. They do so with a lag
τ, in which the specific thrust f = a + g fades; so from the state p, v, a

    p(t) = p + v t + ½ g t² + f τ (t - τ (1 - exp(-t/τ)))

to the floor, for no lag and for the longest. Drag, which would hold the vehicle back, is left out.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.firmware import Timeouts
from cfplan.numbers import shown
from cfplan.safety.limits import Limits
from cfplan.vehicle.airframe import GRAVITY

WALLS = ((0, 0), (0, 1), (1, 0), (1, 1), (2, 1))
"""(axis, low or high side) of the walls and the ceiling; on the floor is where it ends."""
_LONGEST, _MOMENTS = 1.6, 81  # s of a fall, from 8 m; moments that are looked at
_G = np.array([0.0, 0.0, GRAVITY])


@dataclass(frozen=True, slots=True)
class Falls:
    """Where the vehicle falls from each of N states, motors off."""

    beyond: NDArray  # (N,) m beyond the walls or the ceiling; negative inside
    wall: NDArray  # (N,) int, the wall that it comes nearest to or goes farthest beyond, as in WALLS
    reach: NDArray  # (N,) m, towards that wall, from where it is
    distance: NDArray  # (N,) m, horizontally, to the far corner of the box that it sweeps

    @property
    def worst(self) -> int:
        """Return the number of the state that ends farthest out; what is not a number is farthest."""
        return int(np.argmax(np.where(np.isnan(self.beyond), np.inf, self.beyond)))

    def name_of_wall(self, number: int, limits: Limits) -> str:
        """Return what people call the wall of a state: "the wall x = 2.25 m"."""
        axis, side = WALLS[self.wall[number]]
        place = (limits.space.low, limits.space.high)[side][axis]
        return f"the {'ceiling' if axis == 2 else 'wall'} {'xyz'[axis]} = {shown(place, 'g')} m"


def falls_from(states: NDArray, limits: Limits, deviation: float) -> Falls:
    """Stop the motors in each of N states, (N, 3 or more, 3 or more): position, velocity and acceleration, SI units.

    The vehicle is within `deviation`, m, of these before its link dies.
    """
    position, velocity, acceleration = (states[:, order, :3] for order in range(3))
    time, floor = np.linspace(0.0, _LONGEST, _MOMENTS), limits.space.low[2]
    low, high = np.full((len(states), 3), np.inf), np.full((len(states), 3), -np.inf)
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
        low = np.minimum(low, np.where(in_air, place - spread, np.inf).min(axis=1))
        high = np.maximum(high, np.where(in_air, place + spread, -np.inf).max(axis=1))
    space = (np.array(limits.space.low), np.array(limits.space.high))
    out = np.stack([high[:, a] - space[1][a] if side else space[0][a] - low[:, a] for a, side in WALLS], axis=1)
    wall = np.argmax(out, axis=1)
    number, (axis, side) = np.arange(len(states)), np.array(WALLS)[wall].T
    reach = np.where(side[:, None], high - position, position - low)[number, axis]
    away = np.maximum(position - low, high - position)[:, :2]
    return Falls(out.max(axis=1), wall, reach, np.hypot(away[:, 0], away[:, 1]))


def _astray(limits: Limits, time: NDArray) -> tuple[NDArray, float]:
    """Return how far, m, it is off its way after a blind second and a fall of `time`, s: aside, and upwards."""
    wrong, blind = limits.link_loss, Timeouts().watchdog_at_latest
    push = GRAVITY * math.tan(wrong.attitude_error)
    aside = wrong.velocity_error * blind + 0.5 * push * blind**2
    speed = wrong.velocity_error + push * blind
    return aside + speed * time, 0.5 * wrong.vertical_acceleration_error * blind**2
