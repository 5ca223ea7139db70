"""Limits, as safety.yaml gives them: `plan` binds planned motion, `flight` binds measured motion."""

import math
from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge, Gt, Le, Len, Lt

from cfplan.files.schema import InDegrees
from cfplan.safety.space import Space
from cfplan.vehicle.airframe import Airframe

# Of plans made before safety.yaml had it; the Mellinger controller was seen to fail beyond some 40°
STOP_TILT = math.radians(35.0)

LARGEST_IN_PACKET = 32.767  # m, m/s, m/s², rad/s: range of a setpoint's 16 bits, in thousandths

# What safety.yaml may state; times in s.
Encodable = Annotated[float, Gt(0.0), Le(LARGEST_IN_PACKET)]
Positive = Annotated[float, Gt(0.0), Le(1000.0)]
Tilt = Annotated[float, InDegrees(Gt(0.0), Lt(90.0))]
_MotorLag = Annotated[float, Ge(0.005), Le(0.5)]
_Voltage = Annotated[float, Ge(2.5), Le(4.35)]
_UpToOne = Annotated[float, Gt(0.0), Le(1.0)]


@dataclass(frozen=True, slots=True)
class PlanLimits:
    """Limits of planned motion, everywhere on the path; all positive. quantities.py defines how each is computed."""

    speed: float  # m/s, norm
    acceleration: float  # m/s², norm, gravity not counted
    angular_velocity: float  # rad/s, norm of the body rates
    tilt: Tilt  # rad, between the thrust axis and the vertical
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

    brake: Positive
    land: Positive
    cut: Positive


@dataclass(frozen=True, slots=True)
class FlightLimits:
    """Limits of measured motion."""

    deviation: Ladder  # m, from the setpoint
    fence: Ladder  # m, beyond the space less its margin; the floor does not count
    speed: Ladder  # m/s
    acceleration: Ladder  # m/s², gravity not counted
    angular_velocity: Ladder  # rad/s
    patience: _UpToOne  # s that an excess of speed, acceleration or angular velocity must last to count
    stop_tilt: Tilt = STOP_TILT  # rad, in stops, where braking adds to a turn at the plan's limit


@dataclass(frozen=True, slots=True)
class BatteryLimits:
    """Limits of the battery."""

    at_rest: _Voltage  # V, at least, before take-off
    under_load: _Voltage  # V; below it the vehicle lands
    under_load_seconds: Annotated[float, Gt(0.0), Le(10.0)]  # s, averaging time of the loaded voltage
    endurance: Annotated[float, Gt(0.0), Le(3600.0)]  # s in the air


@dataclass(frozen=True, slots=True)
class PoseLimits:
    """Requirements on motion capture."""

    rate: Positive  # Hz, expected
    rate_min: Positive  # Hz, least before take-off
    latency: Annotated[float, Ge(0.0), Le(0.2)]  # s, from the camera to this computer
    age_warning: _UpToOne  # s
    age_brake: _UpToOne  # s
    age_land: Annotated[float, Gt(0.0), Le(2.0)]  # s
    jump: _UpToOne  # m, largest distance of a pose from the extrapolated position
    agreement: _UpToOne  # m, largest distance between pose and the vehicle's own estimate
    yaw_agreement: Annotated[float, InDegrees(Gt(0.0), Le(90.0))]  # rad
    position_noise: Annotated[float, Gt(0.0), Le(0.1)] = 0.001  # m, standard deviation along each axis
    attitude_noise: Annotated[float, InDegrees(Gt(0.0), Le(10.0))] = math.radians(0.2)  # rad, about each axis


@dataclass(frozen=True, slots=True)
class LinkLossLimits:
    """Assumptions about link loss: where the vehicle comes down by itself after its last setpoint."""

    motor_lags: Annotated[tuple[_MotorLag, ...], Len(1, 5)] = (0.07, 0.105, 0.13)
    """s, with which this is simulated besides the airframe's own."""
    attitude_error: Annotated[float, InDegrees(Ge(0.0), Le(10.0))] = math.radians(1.0)
    """rad, error of the estimated attitude, in any direction."""
    vertical_acceleration_error: Annotated[float, Ge(0.0), Le(2.0)] = 0.08
    """m/s², error of the accelerometer, either sign."""
    velocity_error: Annotated[float, Ge(0.0), Le(1.0)] = 0.1
    """m/s, error of the estimated velocity at link loss, in any direction."""
    only_warn: bool = False
    """Of a flight after which that is outside the walls, for rooms with nets; else it is refused."""


@dataclass(frozen=True, slots=True)
class FirmwareSettings:
    """Settings that the pilot writes to the vehicle and reads back."""

    controller: Annotated[int, Ge(2), Le(2)]  # stabilizer.controller: Mellinger, which every certificate assumes
    estimator: Annotated[int, Ge(2), Le(2)]  # stabilizer.estimator: Kalman, likewise
    oldest: tuple[int, ...]  # oldest permitted firmware
    newest: tuple[int, ...] = ()  # newest permitted firmware; older plan files have none
    watchdog: bool = True
    """Whether the watchdog is used: motors stop 1 s after the last keep-alive packet, and the vehicle locks, also after
    landing, where the pilot restarts it."""


SHORTEST_MANOEUVRE = 1.5  # s, however short the way is


@dataclass(frozen=True, slots=True)
class GroundManoeuvres:
    """Heights and speeds of take-off, the way to the start, and landing."""

    take_off_height: Annotated[float, Gt(0.0), Le(5.0)]  # m
    take_off_speed: _UpToOne  # m/s, mean
    go_to_speed: Annotated[float, Gt(0.0), Le(2.0)]  # m/s, mean
    land_speed: _UpToOne  # m/s, mean


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
    lateness: Annotated[float, Gt(0.0), Le(0.1)] = 0.005
    """s, 99th percentile of this computer's lateness before take-off."""
