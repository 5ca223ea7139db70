"""The mission: everything that the pilot needs to know, fixed before the vehicle is armed."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.on_board.program import OnBoardProgram
from cfplan.flight.setpoints.encoding import LEAD, RATE, EncodedFlight
from cfplan.flight.setpoints.packets import decode
from cfplan.flight.setpoints.stops import encode_stops
from cfplan.flight.telemetry import Triple
from cfplan.safety.limits import SHORTEST_MANOEUVRE, Limits
from cfplan.vehicle.rotations import yaw_of

_PEAK_RATE, _PEAK_CHANGE = 35 / 16, 7.52  # of a polynomial of degree 7 from rest to rest, one unit in one second


@dataclass(frozen=True, slots=True)
class Mission:
    """One certified flight, encoded."""

    payloads: NDArray  # (N, 29) uint8, the setpoints from rest to rest
    stops: NDArray  # (N, M, 29) uint8, a stop from each setpoint, see stops.encode_stops
    limits: Limits
    lead: float = 0.0  # s by which setpoints lead the trajectory
    hold_time: float = 1.0  # s that the vehicle hovers after the last setpoint before it is handed back
    rate: float = RATE  # Hz
    on_board: OnBoardProgram | None = None
    """The vehicle's own commander flies this; setpoints and stops then describe its motion and are not sent."""

    @property
    def start(self) -> tuple[Triple, float]:
        """Return the position, m, and yaw, rad, of the first setpoint as the vehicle decodes it."""
        return _place(self.payloads[:1])

    @property
    def end(self) -> tuple[Triple, float]:
        """Return the position, m, and yaw, rad, of the last setpoint as the vehicle decodes it."""
        return _place(self.payloads[-1:])

    @property
    def motion_ends(self) -> float:
        """Time, s, from the first setpoint to the first of those that only hover at the end."""
        moving = np.flatnonzero(np.any(decode(self.payloads).velocity != 0.0, axis=1))
        return float(moving[-1] + 1) / self.rate if len(moving) else 0.0

    @property
    def duration(self) -> float:
        """Time, s, from the first setpoint to the last."""
        return (len(self.payloads) - 1) / self.rate

    @property
    def take_off_height(self) -> float:
        """Return the height of the hover after take-off, m above the origin."""
        return self.limits.ground.take_off_height


def mission_of(encoded: EncodedFlight, limits: Limits, *, hold_time: float = 1.0) -> Mission:
    """Return the mission that flies these setpoints, with a stop from each of them."""
    stops = encode_stops(encoded.motion, RATE, gains=encoded.gains, space=encoded.space)
    return Mission(encoded.payloads, stops, limits, LEAD, hold_time)


def manoeuvre_time(distance: float, mean_speed: float) -> float:
    """Return the time, s, for a distance, m, from hover to hover."""
    return max(SHORTEST_MANOEUVRE, distance / mean_speed)


def go_to_time(distance: float, turn: float, limits: Limits) -> float:
    """Return the time, s, for the way to a start, m, with a `turn` of yaw, rad, that keeps the limits of plans.

    Both the commander's polynomials of degree 7 and the setpoints', of degree 5, do.
    """
    turn, plan = abs(math.remainder(turn, math.tau)), limits.plan
    return max(
        manoeuvre_time(distance, limits.ground.go_to_speed),
        _PEAK_RATE * turn / plan.angular_velocity,
        math.sqrt(_PEAK_CHANGE * turn / plan.angular_acceleration),
    )


def _place(payload: NDArray) -> tuple[Triple, float]:
    state = decode(payload)
    x, y, z = state.position[0].tolist()
    qx, qy, qz, qw = state.quaternion[0].tolist()
    return (x, y, z), yaw_of((qx, qy, qz, qw))
