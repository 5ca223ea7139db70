"""What proves the stops: their bytes, as the vehicle decodes them, held against the limits.

A stop may exceed the limits of the plan: where a turn is flown at its limit, braking adds to it. Longer stops gain
little (5.7 m/s² instead of 5.8 for twice the way), so all are short, and must keep the limits of the flight, a tilt at
which the controller is stable, and the thrust that the motors have.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import NotCertifiedError
from cfplan.flight.setpoints.packets import decode
from cfplan.safety.limits import Limits
from cfplan.vehicle.airframe import GRAVITY

LARGEST_TILT = np.radians(35.0)  # beyond some 40° the firmware's Mellinger controller was seen to fail
_CHUNK = 1000  # stops at a time
_ROUNDING = 1e-3  # of what fits a packet


@dataclass(frozen=True, slots=True)
class StopCertificate:
    """Worst values over every moment of every stop."""

    count: int
    as_planned: int
    # stops that keep the limits of the plan too
    speed: float
    # m/s
    acceleration: float
    # m/s², without what makes up for drag
    angular_velocity: float
    # rad/s
    tilt: float
    # rad
    specific_thrust: float
    # m/s², least
    motor_thrust: float
    # N, most of one motor, torque counted

    def require(self, limits: Limits) -> None:
        """Raise NotCertifiedError where a stop breaks a limit of the flight."""
        flight, airframe = limits.flight, limits.airframe
        for name, value, most in (
            ("speed", self.speed, flight.speed.brake),
            ("acceleration", self.acceleration, flight.acceleration.brake),
            ("angular velocity", self.angular_velocity, flight.angular_velocity.brake),
            ("tilt", self.tilt, LARGEST_TILT),
            ("specific thrust", -self.specific_thrust, -limits.plan.specific_thrust_min + _ROUNDING),
            ("motor thrust", self.motor_thrust, airframe.motor_thrust_max),
        ):
            if not value <= most:
                raise NotCertifiedError(
                    f"a stop's {name} comes to {abs(value):.3g}, which {abs(most):.3g} bounds",
                    where="stops",
                    hint="plan with a lower speed or acceleration",
                )


def certify_stops(stops: NDArray, limits: Limits, rate: float) -> StopCertificate:
    """Of stops (N, M, 29) uint8 at `rate`, Hz."""
    parts = [_worst(stops[first : first + _CHUNK], limits, rate) for first in range(0, len(stops), _CHUNK)]
    as_planned = sum(part[0] for part in parts)
    most = np.max([part[1] for part in parts], axis=0)
    speed, acceleration, turning, tilt, thrust, motor = most.tolist()
    return StopCertificate(len(stops), as_planned, speed, acceleration, turning, tilt, -thrust, motor)


def _worst(stops: NDArray, limits: Limits, rate: float) -> tuple[int, NDArray]:
    told = decode(stops)
    shape = (*stops.shape[:2], 3)
    velocity, acceleration = told.velocity.reshape(shape), told.acceleration.reshape(shape)
    turning = told.body_rate.reshape(shape)
    force = acceleration + np.array([0.0, 0.0, GRAVITY])
    thrust = np.linalg.norm(force, axis=2)
    drag = limits.airframe.drag[0] / limits.airframe.mass
    moved = np.linalg.norm(acceleration - drag * velocity, axis=2)
    tilt = np.arccos(np.clip(force[..., 2] / thrust, -1.0, 1.0))
    motor = _motors(limits, thrust, turning, rate)
    speed, rates = np.linalg.norm(velocity, axis=2), np.linalg.norm(turning, axis=2)
    plan = limits.plan
    good = (
        (speed <= plan.speed + _ROUNDING)
        & (moved <= plan.acceleration * (1 + _ROUNDING) + _ROUNDING)
        & (rates <= plan.angular_velocity + _ROUNDING)
        & (tilt <= plan.tilt + _ROUNDING)
        & (thrust >= plan.specific_thrust_min - _ROUNDING)
        & (motor <= plan.motor_thrust_max + _ROUNDING)
    )
    return int(good.all(axis=1).sum()), np.array(
        [values.max() for values in (speed, moved, rates, tilt, -thrust, motor)]
    )


def _motors(limits: Limits, specific_thrust: NDArray, turning: NDArray, rate: float) -> NDArray:
    """(N, M) N, the largest of the four motors: thrust, and the torque of the change of the body rates."""
    airframe = limits.airframe
    inertia = np.array(airframe.inertia)
    # Over 40 ms, as the bytes round rates to a millirad/s.
    ahead, behind = np.minimum(np.arange(turning.shape[1]) + 2, turning.shape[1] - 1), np.arange(turning.shape[1]) - 2
    behind = np.maximum(behind, 0)
    change = (turning[:, ahead] - turning[:, behind]) * (rate / np.maximum(ahead - behind, 1))[:, None]
    torque = inertia * change + np.cross(turning, inertia * turning)
    wrench = np.concatenate([airframe.mass * specific_thrust[..., None], torque], axis=2)
    return (wrench @ np.linalg.inv(airframe.mixing).T).max(axis=2)
