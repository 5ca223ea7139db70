"""Poses that are late, step, stand still or come after a gap, and then stop for good: the vehicle ends inside.

Sizes, times, paths and sensors are drawn; each family draws its own. Without poses the vehicle flies by its estimate
alone, so whatever the last poses made of that decides where it comes down.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cfplan.flight.pilot.outcome import Rung
from cfplan.simulation.lab.lab import Fault
from cfplan.simulation.lab.radio import RadioFault, RadioFaultKind
from cfplan.simulation.virtual_crazyflie.faults import VehicleFault, VehicleFaultKind
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_vicon.faults import FaultKind, ViconFault
from studies.random_faults import prepare_missions, random_scenario
from studies.stepped_flight import FOR_GOOD, FaultFlight, Scenario, fly_scenario

REPOSITORY = Path(__file__).parents[2]
pytestmark = [pytest.mark.integration, pytest.mark.slow]
PATHS = ("line", "loop3d", "random", "slalom")
RANDOM_PATHS = 12
FLIGHTS = 100  # of a family
DIED_OUTSIDE = 12771  # the one of 13,001 random flights; its faults in a new light below

Draw = Callable[[float, float], float]  # a number between two


def none_after(start: float) -> Fault:
    return ViconFault(FaultKind.OCCLUDE, start, FOR_GOOD)


def late(by: float) -> Fault:
    return ViconFault(FaultKind.DELAY, 0.0, FOR_GOOD, by)


def stepped(draw: Draw, largest: float) -> Fault:
    size = draw(-largest, largest)
    return ViconFault(FaultKind.JUMP, 0.0, FOR_GOOD, size)


def tumble(draw: Draw, start: float) -> Fault:
    return VehicleFault(VehicleFaultKind.TUMBLE, start, draw(0.02, 0.06))


def dead_after(start: float) -> Fault:
    return RadioFault(RadioFaultKind.DEAD, start, FOR_GOOD)


def slow_radio(by: float) -> Fault:
    return RadioFault(RadioFaultKind.DELAY, 0.0, FOR_GOOD, by)


def frozen(duration: float) -> Fault:
    return ViconFault(FaultKind.FREEZE, 0.0, duration)


def after_a_gap(draw: Draw) -> tuple[Fault, ...]:
    gap = draw(0.05, 0.4)
    return ViconFault(FaultKind.OCCLUDE, 0.0, gap), late(draw(0.05, 0.2)), none_after(gap + draw(0.02, 0.2))


# Each with how many of its flights may end outside.
FAMILIES: dict[str, tuple[Callable[[Draw], tuple[Fault, ...]], int]] = {
    "late poses": (lambda draw: (late(draw(0.05, 0.2)), none_after(draw(0.01, 0.4))), 0),
    "late poses, radio dead": (lambda draw: (late(draw(0.05, 0.2)), dead_after(draw(0.05, 0.6))), 0),
    "late poses after a gap": (after_a_gap, 0),
    "late poses for good": (lambda draw: (late(draw(0.05, 0.2)),), 0),
    "late poses and a tumble": (
        lambda draw: (late(draw(0.05, 0.2)), tumble(draw, draw(0.0, 0.2)), none_after(draw(0.0, 0.4))), 0,
    ),
    "poses that step": (lambda draw: (stepped(draw, 0.3), none_after(draw(0.01, 0.3))), 0),
    "poses that step, radio dead": (lambda draw: (stepped(draw, 0.2), dead_after(draw(0.0, 0.3))), 0),
    "frozen poses": (lambda draw: (frozen(0.3), none_after(draw(0.3, 0.4))), 0),
    "a tumble": (lambda draw: (tumble(draw, draw(0.0, 0.2)), none_after(draw(0.0, 0.4))), 3),
    "a slow radio": (lambda draw: (slow_radio(draw(0.01, 0.05)), none_after(draw(0.0, 0.3))), 8),
}  # fmt: skip


@pytest.fixture(scope="module")
def missions():
    files = [REPOSITORY / "flights" / f"{name}.yaml" for name in PATHS]
    return prepare_missions(files, RANDOM_PATHS)


def flown(number: int, faults: Callable[[Draw], tuple[Fault, ...]], missions) -> FaultFlight:
    names, chance = sorted(missions), np.random.default_rng(number)
    mission = missions[names[number % len(names)]]

    def draw(least: float, most: float) -> float:
        return float(chance.uniform(least, most))

    x, y, _ = mission.start[0]
    vehicle = VehicleSettings(auto_arming=False, seed=number, position=(x, y, 0.0))
    scenario = Scenario(
        str(number), Rung.NONE, moment=draw(0.0, mission.duration), faults=faults(draw), vehicle=vehicle
    )
    return fly_scenario(scenario, mission, number)


@pytest.mark.parametrize("family", FAMILIES)
def test_a_vehicle_whose_poses_are_lost_ends_inside(family, missions):
    faults, allowed = FAMILIES[family]
    flights = [flown(number, faults, missions) for number in range(FLIGHTS)]
    outside = [(each.name, round(each.to_wall, 2), each.reason) for each in flights if each.to_wall <= 0.0]
    assert len(outside) <= allowed, outside
    assert all(each.landed and each.disarmed and each.readable for each in flights)


def test_neighbours_of_the_flight_that_left_the_walls_end_inside(missions):
    slalom = missions["slalom"]
    base = random_scenario(DIED_OUTSIDE, slalom)
    for number in range(2 * FLIGHTS):
        chance = np.random.default_rng(number)
        faults = (
            ViconFault(FaultKind.DELAY, 0.0, float(chance.uniform(0.3, 1.3)), float(chance.uniform(0.05, 0.2))),
            VehicleFault(VehicleFaultKind.TUMBLE, float(chance.uniform(0.0, 0.3)), float(chance.uniform(0.02, 0.06))),
            none_after(float(chance.uniform(0.0, 0.4))),
        )
        moment = base.moment + float(chance.uniform(-0.3, 0.3))
        flight = fly_scenario(
            Scenario(str(number), Rung.LAND, faults, base.phase, moment, vehicle=base.vehicle), slalom, DIED_OUTSIDE
        )
        assert flight.to_wall > 0.0, (number, flight.reason)
        assert (flight.landed, flight.disarmed, flight.readable) == (True, True, True)
