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


MOTOR_RESERVE = 0.95
# share of a motor's thrust that a plan for hardware may use; the rest is feedback's

LIMIT_SETS = MappingProxyType(
    {
        # The paper's hardware data (appendix, "Hardware Experiment Dataset"), with the tilt and the thrust floor that
        # real flight adds.
        "hardware": LimitSet(
            "hardware",
            AIRFRAMES["crazyflie-2.1+"],
            PlanLimits(
                speed=2.0,
                acceleration=5.0,
                angular_velocity=8.0,
                tilt=math.radians(30.0),
                motor_thrust_min=AIRFRAMES["crazyflie-2.1+"].motor_thrust_min,
                motor_thrust_max=MOTOR_RESERVE * AIRFRAMES["crazyflie-2.1+"].motor_thrust_max,
                specific_thrust_min=0.5 * GRAVITY,
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
