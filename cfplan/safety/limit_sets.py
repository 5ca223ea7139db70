"""The two sets of limits that datasets, benchmarks and the paper's tables are made with, each with its vehicle."""

import math
from dataclasses import dataclass
from types import MappingProxyType

from cfplan.safety.limits import PlanLimits, within_reserve
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.airframes import AIRFRAMES


@dataclass(frozen=True, slots=True)
class LimitSet:
    """A vehicle and limits of its planned motion."""

    name: str
    airframe: Airframe
    limits: PlanLimits


MOTOR_RESERVE = 0.2  # fraction of a motor's range that plans for hardware leave to feedback at either end
_FLOWN, _SIMULATED = AIRFRAMES["crazyflie-2.1+"], AIRFRAMES["crazyflie-2.0"]


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
                specific_thrust_min=0.5 * GRAVITY,
                angular_acceleration=35.0,
                **within_reserve(_FLOWN, MOTOR_RESERVE),
            ),
        ),
        # The paper's simulation data: 5 m/s, and the motors bind. The paper leaves feedback no reserve; where motors
        # follow with the lag of real ones most of such plans are lost. With this much of it, and no more turned or
        # tilted than motors can follow, none was (docs/learning.md).
        "simulation": LimitSet(
            "simulation",
            _SIMULATED,
            PlanLimits(
                speed=5.0,
                acceleration=25.0,
                angular_velocity=30.0,
                tilt=math.radians(60.0),
                specific_thrust_min=0.5 * GRAVITY,
                angular_acceleration=40.0,
                **within_reserve(_SIMULATED, 0.15),
            ),
        ),
    }
)
# The paper's simulation data as the paper has it: a speed limit and the whole range of the motors, nothing else. The
# other limits are where no plan gets. Not among those above: with the lag of real motors most of its plans are lost.
PAPER = LimitSet(
    "paper",
    _SIMULATED,
    PlanLimits(
        speed=5.0,
        acceleration=40.0,
        angular_velocity=50.0,
        tilt=math.radians(170.0),
        specific_thrust_min=0.01,
        motor_thrust_min=_SIMULATED.motor_thrust_min,
        motor_thrust_max=_SIMULATED.motor_thrust_max,
    ),
)
DATA_SETS = MappingProxyType({**LIMIT_SETS, PAPER.name: PAPER})  # available for datasets
# m, boxes for random waypoints: the paper's motion capture room and its training box.
BOXES = MappingProxyType({"4.5x8x2": (4.5, 8.0, 2.0), "10x10x10": (10.0, 10.0, 10.0)})
