"""A fleet that flies on board, in the stepped lab: two paths that cross, stops off the paths, and a lost vehicle."""

from pathlib import Path

import numpy as np
import pytest
from fleets_down import assert_all_down

from cfplan.errors import ExitCode
from cfplan.flight.fleet.conductor import ConductedFlight, Conductor
from cfplan.flight.on_board.fall import fall_tubes
from cfplan.flight.pilot.keys import Order
from cfplan.flight.telemetry import Phase, PhaseEntered
from cfplan.planning.fleet.lost import BACK, NOTICED
from cfplan.planning.fleet.separation import allowed_deviation
from cfplan.preparation.on_board_fleet import prepare_fleet_on_board
from cfplan.preparation.plan_fleet import lost_clearance
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.lab.radio import RadioFault, RadioFaultKind
from cfplan.simulation.lab.stepped_fleet import SteppedFleet
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings

pytestmark = pytest.mark.integration

REPOSITORY = Path(__file__).parents[3]
FOR_GOOD = float("inf")  # s
FLEET = """
vehicles:
  east: {path: line.yaml}
  north: {path: line.yaml, place: {yaw_deg: 90}}
"""


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    """The fleet's plan, and the mission of each vehicle."""
    folder = tmp_path_factory.mktemp("fleet")
    (folder / "line.yaml").write_text("waypoints: [[-1.2, 0, 1], [1.2, 0, 1]]\nshape: min-snap\n")
    (folder / "fleet.yaml").write_text(FLEET)
    planned, flights = prepare_fleet_on_board(folder / "fleet.yaml", load_limits(REPOSITORY / "safety.yaml"))
    return planned, {member.name: each.mission for member, each in zip(planned.members, flights, strict=True)}


@pytest.fixture
def fleet(prepared):
    planned, missions = prepared
    flights = [ConductedFlight(each.name, missions[each.name].start[0], each.delay) for each in planned.members]
    standing = {
        name: VehicleSettings(position=(*each.start[0][:2], 0.0), yaw=each.start[1], auto_arming=False)
        for name, each in missions.items()
    }
    return SteppedFleet(missions, Conductor(flights, planned.apart, planned.skew), settings=standing)


def fly(fleet, name, moment, act):
    """Fly, and act a moment, s, after the plan of a vehicle has begun, in the turn of its pilot."""

    def react(whose, message):
        if whose == name and isinstance(message, PhaseEntered) and message.phase is Phase.STREAM:
            clock = fleet.labs[name].clock
            clock.at(clock.now() + moment, act)

    return fleet.fly(react)


def columns_apart(flight):
    """The least distance of the two columns while one of them flies, m."""
    a, b = flight.truths.values()
    other = np.column_stack([np.interp(a.time, b.time, along) for along in b.position.T])
    flies = np.maximum(a.position[:, 2], other[:, 2]) > 0.05
    return float(np.linalg.norm((other - a.position)[flies, :2], axis=1).min())


@pytest.mark.slow
def test_paths_that_cross_are_flown_apart(fleet, prepared):
    planned, _ = prepared
    flight = fleet.fly()
    assert set(flight.exit_codes.values()) == {ExitCode.OK}
    assert_all_down(flight)
    begins = {name: outcome.first_setpoint for name, outcome in flight.outcomes.items()}
    delays = {member.name: member.delay for member in planned.members}
    assert begins["north"] - begins["east"] == pytest.approx(delays["north"] - delays["east"], abs=planned.skew)
    allowed = allowed_deviation(planned.apart)
    assert columns_apart(flight) > planned.apart - 2.0 * allowed
    for outcome in flight.outcomes.values():
        assert outcome.deviation.max < allowed


@pytest.mark.parametrize("moment", [0.5, pytest.param(1.2, marks=pytest.mark.slow)])
def test_all_stop_off_their_paths_no_nearer_than_certified(fleet, prepared, moment):
    planned, _ = prepared
    first = min(planned.members, key=lambda each: each.delay).name
    flight = fly(fleet, first, moment, lambda: fleet.labs[first].orders.give(Order.LAND))
    assert flight.brakes.startswith(first)
    assert_all_down(flight)
    assert columns_apart(flight) > planned.separations[0].distance - 2.0 * allowed_deviation(planned.apart)


@pytest.mark.parametrize(
    ("moment", "lasts"),
    [
        (1.3, FOR_GOOD),
        *(pytest.param(*each, marks=pytest.mark.slow) for each in ((0.6, FOR_GOOD), (0.8, 0.7), (1.3, 0.9))),
    ],
)
def test_a_lost_vehicle_stays_in_its_tube_and_the_other_stops_clear_of_it(fleet, prepared, moment, lasts):
    """Its link dies for good, or is back before the watchdog stops its motors."""
    planned, missions = prepared
    lost = max(planned.members, key=lambda each: each.delay)
    lab = fleet.labs[lost.name]
    flight = fly(fleet, lost.name, moment, lambda: lab.disturb(RadioFault(RadioFaultKind.DEAD, 0.0, lasts)))
    assert flight.brakes.startswith(f"{lost.name}: the vehicle has acknowledged nothing")
    assert_all_down(flight)
    assert columns_apart(flight) > lost_clearance(planned.apart)
    truth, limits = flight.truths[lost.name], missions[lost.name].limits
    since = truth.time - (flight.outcomes[lost.name].first_setpoint + moment)
    part, once, stops = 0.04, np.array([moment]), (BACK, NOTICED[1])
    tubes = fall_tubes(lost.plan.trajectory, once, limits, deviation=0.06, part=part, stops=stops)[1:, 0]
    flown = (since > 0.0) & (truth.position[:, 2] > 0.05)
    parts = np.minimum(since[flown] / part, tubes.shape[1] - 1).astype(int)
    before = np.maximum(parts - 1, 0)
    low, high = (side(tubes[:, parts], tubes[:, before]) for side in (np.minimum, np.maximum))
    places = truth.position[flown, :2]
    assert ((low[:, :, 0, :2] <= places) & (places <= high[:, :, 1, :2])).all(axis=2).any(axis=0).all()
