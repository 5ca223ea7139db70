"""The fault table: each row at full speed in the stepped lab, judged by the simulated truth."""

from pathlib import Path

import pytest

from cfplan.preparation.prepare_flight import prepare_mission
from cfplan.safety.limits_file import load_limits
from cfplan.studies.fault_scenarios import SCENARIOS
from cfplan.studies.faults import fly_scenario, fly_stepped
from cfplan.studies.random_faults import fly_random

REPOSITORY = Path(__file__).parents[2]
pytestmark = pytest.mark.integration

# One of each kind; the others are as many as take some minutes.
QUICK = (
    "poses stop for 5 s",
    "poses 200 ms late for good",
    "radio loses 50 %",
    "radio dead for 1 s",
    "stream stalled for 0.6 s",
    "take-off refused",
    "two bodies swapped",
    "disk full",
)
SEEDS, PATHS = range(200), ("helix", "line", "loop3d", "random", "slalom")


@pytest.fixture(scope="module")
def line():
    return prepare_mission(REPOSITORY / "flights" / "line.yaml", load_limits(REPOSITORY / "safety.yaml"))


@pytest.mark.parametrize(
    "scenario",
    [pytest.param(row, id=row.name, marks=[] if row.name in QUICK else pytest.mark.slow) for row in SCENARIOS],
)
def test_a_fault_comes_to_its_rung_and_the_vehicle_to_the_ground(scenario, line):
    flown = fly_scenario(scenario, line)
    assert flown.rung == flown.expected, flown.reason
    assert flown.to_wall > 0.0
    assert flown.landed
    assert flown.disarmed
    assert flown.readable
    if not scenario.falls and flown.rung != "cut":
        assert flown.motors_off == 0
        assert flown.off_plan < 0.4


def test_a_vehicle_that_is_late_on_its_path_is_off_its_setpoint_and_that_ends_the_flight(line):
    (stalled,) = (row for row in SCENARIOS if row.name == "stream stalled for 0.6 s")
    flown = fly_scenario(stalled, line)
    assert flown.off_plan < 0.1
    assert flown.off_setpoint > line.limits.flight.deviation.brake
    assert "from the setpoint" in flown.reason


def test_two_swapped_bodies_never_let_the_vehicle_climb_away(line):
    (swapped,) = (row for row in SCENARIOS if row.name == "two bodies swapped")
    truth = fly_stepped(swapped, line).truth
    assert truth.position[:, 2].max() < 0.35
    assert not truth.locked


def test_the_quick_rows_are_rows_of_the_table():
    assert set(QUICK) <= {row.name for row in SCENARIOS}


def test_a_flight_in_the_stepped_lab_repeats_to_the_last_bit(line):
    assert fly_random(11, {"line": line}) == fly_random(11, {"line": line})


@pytest.mark.parametrize("seed", [8, 23])
def test_a_random_fault_stays_inside_the_walls(seed, line):
    _, flown = fly_random(seed, {"line": line})
    assert flown.to_wall > 0.0
    assert flown.landed


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_no_random_fault_of_two_hundred_leaves_the_walls():
    limits = load_limits(REPOSITORY / "safety.yaml")
    missions = {name: prepare_mission(REPOSITORY / "flights" / f"{name}.yaml", limits) for name in PATHS}
    outside = [flown.name for _, flown in (fly_random(seed, missions) for seed in SEEDS) if flown.to_wall <= 0.0]
    assert not outside
