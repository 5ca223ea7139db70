"""In the second after take-off the vehicle shows whether it is the one that the plan was certified for."""

import math
from dataclasses import replace

import numpy as np
import pytest

from cfplan.errors import ExitCode
from cfplan.flight.pilot.hover_check import certified_scales, measure_hover
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.telemetry import Estimate, Phase, VehicleStatus
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.airframes import AIRFRAMES
from cfplan.vehicle.motor_commands import compensated_pwm

LEVEL, NO = (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0)


def seen(airframe, scale, voltage=3.7, climbs=0.0):
    """What the log holds of a second in which a vehicle of another thrust scale climbs ever faster, by m/s²."""
    share = airframe.mass * (GRAVITY + climbs) / 4 / scale / airframe.motor_thrust_max
    motor = 4 * (round(compensated_pwm(share, voltage, airframe)),)
    statuses = [VehicleStatus(t, NO, motor, voltage, 0) for t in np.arange(0.0, 1.0, 0.02)]
    estimates = tuple(Estimate(t, NO, (0.0, 0.0, climbs * t), NO, LEVEL) for t in (0.0, 1.0))
    return measure_hover(statuses, estimates, airframe)


@pytest.mark.parametrize("name", AIRFRAMES)
@pytest.mark.parametrize("climbs", [0.0, 0.2])
def test_the_thrust_scale_is_found_from_the_motors_logged_commands(name, climbs):
    measured = seen(AIRFRAMES[name], 0.93, climbs=climbs)
    assert measured.thrust_scale == pytest.approx(0.93, rel=2e-3)
    assert measured.battery_voltage == pytest.approx(3.7)


def test_a_battery_shows_what_it_can_give():
    airframe = AIRFRAMES["crazyflie-2.1+"]
    full, empty = (seen(airframe, 1.0, voltage).full_thrust for voltage in (3.9, 2.9))
    assert full > airframe.motor_thrust_max > empty > airframe.hover_thrust


def test_the_plan_holds_for_the_airframes_spread():
    airframe = AIRFRAMES["crazyflie-2.1+"]
    least, most = certified_scales(airframe)
    assert least < 0.94 * airframe.thrust_scale < 1.06 * airframe.thrust_scale < most
    narrow = replace(airframe, spread=replace(airframe.spread, thrust_scale=0.01, mass=0.0))
    assert certified_scales(narrow) == pytest.approx((0.99 * airframe.thrust_scale, 1.01 * airframe.thrust_scale))


@pytest.mark.parametrize("factor", [0.94, 1.06])
def test_within_the_spread_the_flight_goes_on_as_planned(world, fly, factor):
    world.hover_command *= factor
    assert fly().reason == "landed"
    assert "hover: thrust scale" in world.said


@pytest.mark.parametrize(("factor", "mass", "scale"), [(1.2, "0.0360", "0.83"), (0.8, "0.0240", "1.25")])
def test_outside_it_lands_before_the_path_and_names_the_line_to_change(world, fly, factor, mass, scale):
    world.hover_command *= factor
    outcome = fly()
    assert outcome.exit_code is ExitCode.ENDED_BY_SAFETY
    assert outcome.rung is Rung.LAND
    assert f"`mass: {mass}`" in outcome.reason
    assert f"`thrust_scale: {scale}`" in outcome.reason
    assert outcome.hint
    assert Phase.LAND in world.phases
    assert not {Phase.GO_TO_START, Phase.STREAM} & set(world.phases)


@pytest.mark.parametrize(
    "silence",
    [lambda world: setattr(world, "status_every", 20), lambda world: setattr(world, "voltage", math.nan)],
    ids=["a sparse log", "a voltage that is no number"],
)
def test_a_log_that_says_nothing_is_reported_and_blocks_nothing(world, fly, silence):
    world.when(Phase.TAKE_OFF, 0.5, lambda: silence(world))
    assert fly().reason == "landed"
    assert "thrust scale is not known" in world.said


def test_a_battery_that_cannot_give_the_plans_thrust_lands(world, fly):
    airframe = AIRFRAMES["crazyflie-2.0"]
    weak = replace(airframe, motor_thrust_max=0.1)
    world.hover_command *= airframe.motor_thrust_max / weak.motor_thrust_max
    outcome = fly(airframe=weak)  # whose full command gives less than the plan's 0.11 N
    assert "the battery is down to" in outcome.reason
    assert Phase.STREAM not in world.phases
