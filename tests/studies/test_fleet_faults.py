"""The study of fleets with faults: the counts of its tables, and flights that it records and judges."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from septic_flight import septic_payloads

from cfplan.flight.fleet.conductor import ConductedFlight
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.setpoints.packets import decode, encode
from cfplan.flight.setpoints.stops import encode_stops
from cfplan.flight.telemetry import Phase
from cfplan.safety.limits import GroundManoeuvres
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.lab.lab import ROW_SIZE, Truth
from cfplan.version import REPOSITORY
from studies.fleet_faults import (
    STUDY,
    FaultyFleetFlight,
    FleetMissions,
    Kind,
    Settings,
    fly_with_fault,
    nearest_in_air,
    random_fault,
)

QUICK = GroundManoeuvres(take_off_height=0.5, take_off_speed=0.6, go_to_speed=0.6, land_speed=0.6)
LIMITS = replace(load_limits(REPOSITORY / "safety.yaml"), ground=QUICK)
WELL = FaultyFleetFlight(
    1, "two", 2, str(Kind.LINK), "covered by the certificate", "link lost: left, 0.50 s", str(Phase.STREAM), 0.4, 0, "",
    0.6, landed=True, disarmed=True, readable=True, brakes="left: the link is lost", ends="left 8, right 7",
)  # fmt: skip
FLIGHTS = [
    WELL,
    replace(
        WELL, seed=2, kind=str(Kind.ORDER), coverage="left out: an order", nearest=0.1, contacts=1, contact="touch"
    ),
    replace(WELL, seed=3, phase=str(Phase.LAND), to_wall=-0.1, brakes=""),
    replace(WELL, seed=4, fleet="four", vehicles=4, disarmed=False),
    replace(WELL, seed=5, fleet="four", vehicles=4, landed=False, readable=False, nearest=np.inf),
]


@pytest.fixture(scope="module")
def tables():
    return {each.name: each for each in STUDY.tables(Settings((Path("two.yaml"),)), FLIGHTS)}


def figures(table):
    first = table.columns[0].key
    keys = ("flights", "contacts", "outside", "armed", "unreadable", "braked")
    return {row[first]: [row[key] for key in keys] for row in table.rows}


def test_flights_that_the_certificate_leaves_out_are_counted_apart(tables):
    assert figures(tables["all"]) == {
        "covered by the certificate": [4, 0, 1, 2, 1, 3],
        "left out: an order": [1, 1, 0, 0, 0, 1],
        "all": [5, 1, 1, 2, 1, 4],
    }


def test_flights_are_counted_by_fault_fleet_and_phase(tables):
    assert figures(tables["kinds"])[str(Kind.LINK)] == [4, 0, 1, 2, 1, 3]
    assert figures(tables["fleets"])["4: four"] == [2, 0, 0, 2, 1, 2]
    assert figures(tables["phases"])[str(Phase.LAND)] == [1, 0, 1, 0, 0, 0]


def test_the_nearest_flight_is_first_and_every_one_that_went_wrong_is_shown(tables):
    assert tables["worst"].rows[0]["seed"] == 2
    assert [row["seed"] for row in tables["bad"].rows] == [2, 3, 4, 5]


def truth(x, z):
    rows = np.zeros((len(x), ROW_SIZE))
    rows[:, 0], rows[:, 1], rows[:, 3] = np.arange(len(x)) / 100, x, z
    return Truth.of(rows, locked=False)


def test_only_vehicles_in_the_air_count_as_near():
    passes, stands = np.linspace(-1.0, 1.0, 201), np.zeros(201)
    assert nearest_in_air((truth(passes, stands + 1.0), truth(stands, stands))) == np.inf
    hovers = np.where(passes > 0.305, 0.5, 0.0)  # takes off after the other has passed
    assert nearest_in_air((truth(passes, stands + 1.0), truth(stands, hovers))) == pytest.approx(0.31)


def mission(y):
    """Return a mission of 0.8 m along x at this y, in 2 s."""
    setpoints = decode(septic_payloads(0.8, 2.0, 0.6))
    moved = encode(replace(setpoints, position=setpoints.position + np.array((0.0, y, 0.0))))
    payloads = np.concatenate([moved, np.repeat(moved[-1:], 30, axis=0)])
    return Mission(payloads, encode_stops(decode(payloads), 100.0), LIMITS, hold_time=0.3)


@pytest.fixture(scope="module")
def fleet():
    missions = {"left": mission(0.0), "right": mission(0.5)}
    flights = tuple(ConductedFlight(name, each.start[0], 0.0) for name, each in missions.items())
    return FleetMissions(0.3, 0.03, flights, missions, keeps_lost=True)


def first_seed(fleet, kind):
    drawn = ((seed, random_fault(seed, fleet.missions)) for seed in itertools.count())
    return next(seed for seed, fault in drawn if fault.kind is kind and fault.phase is Phase.STREAM)


@pytest.mark.integration
@pytest.mark.parametrize("kind", [Kind.LOCK, Kind.ORDER])
def test_a_fault_lets_all_brake_and_the_flight_is_recorded_and_judged(fleet, kind):
    flown = fly_with_fault(first_seed(fleet, kind), {"pair": fleet})
    assert (flown.fleet, flown.vehicles, flown.kind, flown.phase) == ("pair", 2, kind, Phase.STREAM)
    assert (flown.coverage == "covered by the certificate") == (kind is Kind.LOCK)
    assert flown.brakes
    assert 0.3 < flown.nearest < 0.6
    assert not flown.bad, flown
