"""Everything that the pilot needs to know, fixed before the vehicle is armed."""

import math
from dataclasses import dataclass

from numpy.typing import NDArray

from cfplan.flight.brake import encode_stops
from cfplan.flight.packets import decode
from cfplan.flight.telemetry import Triple
from cfplan.safety.limits import Limits

RATE = 100.0  # Hz, of setpoints
# How far the vehicle's filter trusts poses: what Crazyswarm2 flies with. The large one cures yaw trouble.
EXTERNAL_POSITION_STD = 1e-3  # m
EXTERNAL_ATTITUDE_STD = 5e-2  # rad
PEAK_TO_MEAN_SPEED = 35 / 16  # of the on-board commander's polynomials
_SHORTEST = 1.5  # s, of any manoeuvre of the on-board commander


@dataclass(frozen=True, slots=True)
class Mission:
    """One certified flight, encoded."""

    payloads: NDArray
    # (N, 29) uint8, the setpoints from rest to rest
    stops: NDArray
    # (N, M, 29) uint8, a way to stop from each setpoint, as brake.encode_stops gives it
    limits: Limits
    rate: float = RATE
    # Hz
    hold_time: float = 1.5
    # s that the vehicle hovers at the end before it is handed back

    @property
    def start(self) -> tuple[Triple, float]:
        """Position, m, and yaw, rad, of the first setpoint as the vehicle decodes it."""
        return _place(self.payloads[:1])

    @property
    def end(self) -> tuple[Triple, float]:
        """Position, m, and yaw, rad, of the last setpoint as the vehicle decodes it."""
        return _place(self.payloads[-1:])

    @property
    def duration(self) -> float:
        """s from the first setpoint to the last."""
        return (len(self.payloads) - 1) / self.rate

    @property
    def take_off_height(self) -> float:
        """m above the origin"""
        return self.limits.ground.take_off_height

    @property
    def parameters(self) -> dict[str, float]:
        """What is set on the vehicle and read back before the feed of poses begins."""
        return {
            "stabilizer.estimator": self.limits.firmware.estimator,
            "stabilizer.controller": self.limits.firmware.controller,
            "ctrlMel.mass": self.limits.airframe.mass,
            "locSrv.extPosStdDev": EXTERNAL_POSITION_STD,
            "locSrv.extQuatStdDev": EXTERNAL_ATTITUDE_STD,
        }


def mission_of(payloads: NDArray, limits: Limits, *, hold_time: float = 1.5) -> Mission:
    """The mission that flies these setpoints, (N, 29) uint8 at 100 Hz; stops are made for each of them."""
    return Mission(payloads, encode_stops(payloads, RATE), limits, hold_time=hold_time)


def manoeuvre_time(distance: float, mean_speed: float) -> float:
    """s that the on-board commander is given for a distance, m."""
    return max(_SHORTEST, distance / mean_speed)


def yaw_of(quaternion: tuple[float, float, float, float]) -> float:
    """rad, the heading of the body's x axis."""
    x, y, z, w = quaternion
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def _place(payload: NDArray) -> tuple[Triple, float]:
    state = decode(payload)
    x, y, z = state.position[0].tolist()
    qx, qy, qz, qw = state.quaternion[0].tolist()
    return (x, y, z), yaw_of((qx, qy, qz, qw))
