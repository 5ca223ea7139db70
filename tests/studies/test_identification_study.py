"""The study of identification: the count of drawn vehicles, and the errors of identification."""

import math
from dataclasses import replace
from pathlib import Path

import pytest

from cfplan.vehicle.airframes import AIRFRAMES
from studies.identification import STUDY, Settings, StudiedVehicle, draw_vehicle

QUANTITIES = ("thrust", "thrust over mass", "mass", "motor lag", "drag", "axial drag", "pose latency")
SETTINGS = Settings(Path("identify.yaml"), Path("figure8.yaml"))
NOMINAL = AIRFRAMES["crazyflie-2.1+"]


def vehicle(seed, error, identified, known):
    errors = dict.fromkeys(QUANTITIES, error)
    return StudiedVehicle(seed, "landed", "", errors, errors, {"identified": identified, "known": known})


def test_a_vehicle_that_was_not_identified_counts_in_the_title_alone():
    lost = StudiedVehicle(2, "link lost", "too short a record")
    errors, next_flight = STUDY.tables(SETTINGS, [vehicle(0, -2.0, 0.04, 0.03), vehicle(1, 1.0, 0.06, 0.02), lost])
    assert "2 of 3 vehicles" in errors.title
    assert [row["quantity"] for row in errors.rows] == list(QUANTITIES)
    drag = errors.rows[QUANTITIES.index("drag")]
    assert (drag["median"], drag["worst"], drag["bias"]) == ("1.50 %", "2.00 %", "-0.50 %")
    assert errors.rows[QUANTITIES.index("motor lag")]["worst"] == "2.00 ms"
    identified, known = next_flight.rows
    assert (identified["flights"], identified["landed"]) == (2, 2)
    assert identified["over_median"] == pytest.approx(0.025)
    assert identified["over_worst"] == pytest.approx(0.04)
    assert known["over_worst"] == 0.0


def test_a_flight_that_did_not_land_is_no_deviation():
    _, next_flight = STUDY.tables(SETTINGS, [vehicle(0, 0.0, math.nan, 0.03), vehicle(1, 0.0, 0.05, 0.03)])
    identified, known = next_flight.rows
    assert (identified["flights"], identified["landed"], known["landed"]) == (2, 1, 2)
    assert identified["median"] == identified["worst"] == 0.05


def test_a_seed_draws_one_vehicle_near_the_nominal_one():
    first, again, other = (draw_vehicle(seed, NOMINAL) for seed in (4, 4, 5))
    assert first == again
    assert first.airframe != other.airframe
    assert abs(first.airframe.mass / NOMINAL.mass - 1.0) <= 0.1
    drawn = ("mass", "motor_time_constant", "drag", "thrust_scale", "velocity_moment")
    same = replace(first.airframe, **{name: getattr(NOMINAL, name) for name in drawn})
    assert same == NOMINAL
