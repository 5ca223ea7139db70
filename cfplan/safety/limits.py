"""What safety.yaml allows."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class PlanLimits:
    """What binds planned motion, everywhere on the path. All positive."""

    speed: float
    # m/s, norm
    acceleration: float
    # m/s², norm, gravity not counted
    angular_velocity: float
    # rad/s, norm of the body rates
    tilt: float
    # rad, between the thrust axis and the vertical
    motor_thrust_min: float
    # N, each motor
    motor_thrust_max: float
    # N, each motor, the reserve for feedback taken off
    specific_thrust_min: float
    # m/s², collective thrust over mass
