"""Limits, as safety.yaml gives them: `plan` binds planned motion, `flight` binds measured motion."""

import math
from dataclasses import dataclass

from cfplan.safety.space import Space
from cfplan.vehicle.airframe import Airframe

STOP_TILT = math.radians(
    35.0
)  # of plans made before safety.yaml had it; the Mellinger controller was seen to fail beyond some 40°


@dataclass(frozen=True, slots=True)
class PlanLimits:
    """Limits of planned motion, everywhere on the path; all positive. quantities.py defines how each is computed."""

    speed: float  # m/s, norm
    acceleration: float  # m/s², norm, gravity not counted
    angular_velocity: float  # rad/s, norm of the body rates
    tilt: float  # rad, between the thrust axis and the vertical
    motor_thrust_min: float  # N, each motor
    motor_thrust_max: float  # N, each motor, less the reserve for feedback
    specific_thrust_min: float  # m/s², collective thrust over mass
    angular_acceleration: float = math.inf  # rad/s², norm: motors take a tenth of a second to follow


def within_reserve(airframe: Airframe, reserve: float) -> dict[str, float]:
    """Return limits of motor thrust that leave `reserve`, a fraction of the motors' range, to feedback at both ends."""
    least, most = airframe.thrust_range
    room = reserve * (most - least)
    return {"motor_thrust_min": least + room, "motor_thrust_max": most - room}


@dataclass(frozen=True, slots=True)
class Ladder:
    """Measured values above which the pilot brakes to a hover, lands, or cuts the motors."""

    brake: float
    land: float
    cut: float


@dataclass(frozen=True, slots=True)
class FlightLimits:
    """Limits of measured motion."""

    deviation: Ladder  # m, from the setpoint
    fence: Ladder  # m, beyond the space less its margin; the floor does not count
    speed: Ladder  # m/s
    acceleration: Ladder  # m/s², gravity not counted
    angular_velocity: Ladder  # rad/s
    patience: float  # s that an excess of speed, acceleration or angular velocity must last to count
    stop_tilt: float = STOP_TILT  # rad, in stops, where braking adds to a turn at the plan's limit


@dataclass(frozen=True, slots=True)
class BatteryLimits:
    """Limits of the battery."""

    at_rest: float  # V, at least, before take-off
    under_load: float  # V; below it the vehicle lands
    under_load_seconds: float  # s, averaging time of the loaded voltage
    endurance: float  # s in the air


@dataclass(frozen=True, slots=True)
class PoseLimits:
    """Requirements on motion capture."""

    rate: float  # Hz, expected
    rate_min: float  # Hz, least before take-off
    latency: float  # s, from the camera to this computer
    age_warning: float  # s
    age_brake: float  # s
    age_land: float  # s
    jump: float  # m, largest distance of a pose from the extrapolated position
    agreement: float  # m, largest distance between pose and the vehicle's own estimate
    yaw_agreement: float  # rad
    position_noise: float = 0.001  # m, standard deviation along each axis
    attitude_noise: float = math.radians(0.2)  # rad, standard deviation about each axis


@dataclass(frozen=True, slots=True)
class LinkLossLimits:
    """Assumptions about link loss: where the vehicle comes down by itself after its last setpoint."""

    motor_lags: tuple[float, ...] = (0.07, 0.105, 0.13)  # s, with which this is simulated besides the airframe's own
    attitude_error: float = math.radians(1.0)  # error of the estimated attitude, in any direction
    vertical_acceleration_error: float = 0.08  # m/s², error of the accelerometer, either sign
    velocity_error: float = 0.1  # m/s, error of the estimated velocity at link loss, in any direction
    only_warn: bool = (
        False  # of a flight after which that is outside the walls, for rooms with nets; else it is refused
    )


@dataclass(frozen=True, slots=True)
class FirmwareSettings:
    """Settings that the pilot writes to the vehicle and reads back."""

    controller: int  # stabilizer.controller
    estimator: int  # stabilizer.estimator
    oldest: tuple[int, ...]  # oldest permitted firmware
    newest: tuple[int, ...] = ()  # newest permitted firmware; older plan files have none
    watchdog: bool = True
    """Whether the watchdog is used: motors stop 1 s after the last keep-alive packet, and the vehicle locks, also after
    landing, where the pilot restarts it."""


@dataclass(frozen=True, slots=True)
class GroundManoeuvres:
    """Heights and speeds of take-off, the way to the start, and landing."""

    take_off_height: float  # m
    take_off_speed: float  # m/s, mean
    go_to_speed: float  # m/s, mean
    land_speed: float  # m/s, mean


@dataclass(frozen=True, slots=True)
class Limits:
    """All of safety.yaml."""

    vehicle: str
    airframe: Airframe
    plan: PlanLimits
    flight: FlightLimits
    space: Space
    battery: BatteryLimits
    pose: PoseLimits
    firmware: FirmwareSettings
    ground: GroundManoeuvres
    link_loss: LinkLossLimits = LinkLossLimits()
    lateness: float = 0.005  # s, 99th percentile of this computer's lateness before take-off
