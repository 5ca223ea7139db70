"""Downwash by its fit to public flights, and contact."""

import numpy as np
import pytest

from cfplan.planning.fleet.separation import CLEAR
from cfplan.simulation.lab.downwash import contacts, downwash, share_air
from cfplan.simulation.lab.lab import MOTORS, ROW_SIZE, STATE, TIME, Truth
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_crazyflie.vehicle import VirtualCrazyflie
from cfplan.vehicle.airframes import AIRFRAMES

AIRFRAME = AIRFRAMES["crazyflie-2.1+"]
ACROSS = (0.025, 0.075, 0.125, 0.175, 0.25)  # m
MEASURED = {  # by m above: g on a vehicle of 34 g, down, and its standard deviation, at each distance across
    0.25: ((9.2, 2.0), (2.9, 1.8), (0.5, 1.1), (0.2, 0.9), (0.2, 1.2)),
    0.35: ((7.8, 1.9), (3.6, 2.0), (0.6, 1.3), (0.0, 1.0), (0.1, 1.0)),
    0.55: ((5.9, 2.2), (3.4, 2.4), (1.7, 1.9), (0.2, 1.3), (-0.1, 0.6)),
    0.65: ((5.5, 2.6), (3.1, 1.9), (0.7, 1.5), (-0.6, 1.0), (-0.9, 0.9)),
}


@pytest.mark.parametrize("above", MEASURED)
def test_the_fit_is_within_the_spread_of_what_was_measured(above):
    for across, (grams, deviation) in zip(ACROSS, MEASURED[above], strict=True):
        assert 34.0 * downwash(across, above) == pytest.approx(grams, abs=1.1 * deviation)


def test_vehicles_that_are_clear_of_each_other_lose_no_twentieth_of_their_weight_at_any_height():
    assert max(downwash(CLEAR, above) for above in np.arange(0.05, 3.0, 0.05)) < 0.05


def hovering(height: float, x: float = 0.0) -> VirtualCrazyflie:
    """A vehicle whose motors have just carried its weight; its commander has nothing to fly."""
    vehicle = VirtualCrazyflie(AIRFRAME, VehicleSettings(position=(x, 0.0, height)))
    vehicle.truth[13:17] = AIRFRAME.hover_thrust
    return vehicle


def left(vehicle: VirtualCrazyflie) -> np.ndarray:
    """Return the fractions of thrust that its motors give in the next 10 ms."""
    vehicle.advance(10)
    return vehicle.efficiency.copy()


def test_the_lower_vehicle_loses_thrust_and_the_upper_none():
    low, high = hovering(0.5), hovering(0.9)
    share_air([low, high])
    assert left(low) == pytest.approx(1.0 - downwash(0.0, 0.4))
    assert left(high) == pytest.approx(1.0)
    assert 0.2 < downwash(0.0, 0.4) < 0.3


def test_what_two_take_adds_up_and_ends_when_they_have_gone():
    low, high, higher = hovering(0.5), hovering(0.8), hovering(1.1)
    share_air([low, high, higher])
    assert left(low) == pytest.approx(1.0 - downwash(0.0, 0.3) - downwash(0.0, 0.6))
    low, gone = low, hovering(1.0, x=1.0)
    low.truth[13:17] = AIRFRAME.hover_thrust
    share_air([low, gone])
    assert left(low) == pytest.approx(1.0, abs=1e-6)


def test_a_vehicle_with_its_motors_off_disturbs_nobody():
    low, high = hovering(0.5), VirtualCrazyflie(AIRFRAME, VehicleSettings(position=(0.0, 0.0, 0.9)))
    share_air([low, high])
    assert np.array_equal(left(low), np.ones(4))


def truth_along(positions) -> Truth:
    rows = np.zeros((len(positions), ROW_SIZE))
    rows[:, TIME] = 1000.0 + 0.01 * np.arange(len(rows))
    rows[:, STATE][:, :3], rows[:, MOTORS] = positions, 1.0
    return Truth.of(rows, locked=False)


@pytest.mark.parametrize(("beside", "above", "touch"), [
    (0.10, 0.0, True), (0.20, 0.0, False), (0.05, 0.04, True), (0.05, 0.10, False),
])  # fmt: skip
def test_vehicles_touch_where_their_rotors_do(beside, above, touch):
    x = np.linspace(-1.0, 1.0, 201)
    one = truth_along(np.stack([x, np.zeros(201), np.full(201, 0.6)], axis=1))
    other = truth_along(np.stack([-x, np.full(201, beside), np.full(201, 0.6 + above)], axis=1))
    found = contacts({"one": one, "other": other}, AIRFRAME)
    assert bool(found) is touch
    if touch:
        assert found[0].pair == ("one", "other")
        assert found[0].place[0] == pytest.approx(0.0, abs=0.05)
        assert 1000.9 < found[0].time <= 1001.0
