"""The two sets of limits that datasets, benchmarks and the paper's tables are made with, each with its vehicle."""

import math
from dataclasses import dataclass
from types import MappingProxyType

from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.airframes import AIRFRAMES


@dataclass(frozen=True, slots=True)
class LimitSet:
    """A vehicle and what its planned motion may reach."""

    name: str
    airframe: Airframe
    limits: PlanLimits


MOTOR_RESERVE = 0.2
# share of a motor's range that a plan for hardware leaves to feedback at either end
_FLOWN = AIRFRAMES["crazyflie-2.1+"]
_RESERVE = MOTOR_RESERVE * (_FLOWN.motor_thrust_max - _FLOWN.motor_thrust_min)

LIMIT_SETS = MappingProxyType(
    {
        # The paper's hardware data (appendix, "Hardware Experiment Dataset"), with what real flight adds: tilt, thrust
        # floor, reserve, and how fast motors follow. These are the plan limits of the project's own safety.yaml.
        "hardware": LimitSet(
            "hardware",
            _FLOWN,
            PlanLimits(
                speed=2.0,
                acceleration=5.0,
                angular_velocity=8.0,
                tilt=math.radians(30.0),
                motor_thrust_min=_FLOWN.motor_thrust_min + _RESERVE,
                motor_thrust_max=_FLOWN.motor_thrust_max - _RESERVE,
                specific_thrust_min=0.5 * GRAVITY,
                angular_acceleration=35.0,
            ),
        ),
        # The paper's simulation data: 5 m/s and the motors bind, nothing else is meant to. The rest keeps plans away
        # from where the flatness map is singular (no thrust, upside down) and from what gyroscopes cannot measure.
        "simulation": LimitSet(
            "simulation",
            AIRFRAMES["crazyflie-2.0"],
            PlanLimits(
                speed=5.0,
                acceleration=25.0,
                angular_velocity=30.0,
                tilt=math.radians(85.0),
                motor_thrust_min=AIRFRAMES["crazyflie-2.0"].motor_thrust_min,
                motor_thrust_max=AIRFRAMES["crazyflie-2.0"].motor_thrust_max,
                specific_thrust_min=0.05 * GRAVITY,
            ),
        ),
    }
)
BOXES = MappingProxyType({"4.5x8x2": (4.5, 8.0, 2.0), "10x10x10": (10.0, 10.0, 10.0)})
# m, where random waypoints are drawn: the paper's motion capture room and its training box
