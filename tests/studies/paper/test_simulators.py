"""The paper's tables with bodies of other simulators: the same controller, and lost flights."""

import numpy as np
import pytest
from one_body import stepped

from cfplan.geometry.min_snap import min_snap
from cfplan.planners.expert.expert import plan_expert
from cfplan.simulation.engine.layout import pack_airframe
from cfplan.simulation.geometric_flight import fly_geometric, positions_by_both
from studies.paper.simulators import (
    HARDWARE,
    PLANNED,
    SHIPPED,
    SHIPPED_PLANNER,
    Asked,
    BodyFlight,
    Settings,
    bodies_for,
    measure,
    tables,
)
from studies.paper.trials import EXPERT, FLOWN, PAPER_LAG, TOPPQUAD, profile_by, trajectory_by

LAGS = [f"RotorPy, {lag:g} s" for lag in (0.072, 0.005)]


@pytest.fixture(scope="module")
def trajectory():
    return trajectory_by(profile_by(plan_expert))(min_snap([[0, 0, 1], [0.5, 0.3, 1.2], [0.9, 0.0, 1.1]]))


def own_step(state, asked, seconds):
    return stepped(state, asked, pack_airframe(FLOWN, floor=-np.inf), seconds)


def test_with_cfplans_own_body_it_is_the_flight_of_the_tables(trajectory):
    wanted, theirs, own = positions_by_both(own_step, trajectory, FLOWN)
    np.testing.assert_array_equal(theirs, own)
    assert np.linalg.norm(own - wanted, axis=1).max() == fly_geometric(trajectory, FLOWN).deviation


def test_rotorpy_with_the_papers_motor_lag_follows_as_cfplan_does(trajectory):
    pytest.importorskip("rotorpy")
    (body,) = (each for each in bodies_for(FLOWN) if each.motor_lag == PAPER_LAG)
    wanted, theirs, own = positions_by_both(body.make(FLOWN), trajectory, body.beside(FLOWN))
    assert np.linalg.norm(theirs - own, axis=1).max() < 0.03
    assert np.linalg.norm(theirs - wanted, axis=1).max() < 0.05


def test_bytes_of_the_planner_that_ships_are_followed_by_every_body():
    pytest.importorskip("rotorpy")
    path = min_snap([[0, 0, 1], [1.5, 0.8, 1.6], [2.9, 0.0, 1.1]])
    flights = measure({}, Asked(SHIPPED, SHIPPED_PLANNER, "1", path))
    assert {flight.body for flight in flights} >= set(LAGS)
    assert all(not flight.reason and flight.both_flown for flight in flights)
    assert max(flight.own_deviation for flight in flights) < 0.1
    assert all(0.0 < flight.apart < 0.2 for flight in flights)


def test_beyond_the_sample_tables_1_to_3_are_flown_with_the_papers_lag_alone():
    pytest.importorskip("rotorpy")
    path = min_snap([[0, 0, 1], [0.5, 0.3, 1.2], [0.9, 0.0, 1.1]])
    (flight,) = measure({}, Asked(PLANNED, EXPERT, "7", path, all_bodies=False))
    assert flight.body == LAGS[1]
    assert flight.both_flown


def test_the_lost_count_as_a_metre_and_are_left_out_of_how_far_bodies_are_apart():
    def flight(path, **given):
        return BodyFlight(PLANNED, TOPPQUAD, path, **{"body": LAGS[1], **given})

    flights = [
        flight("1", deviation=0.2, own_deviation=0.1, apart=0.15),
        flight("2", deviation=9.0, own_deviation=0.3, apart=9.1),
        flight("3", deviation=float("nan"), own_deviation=float("nan"), apart=float("nan")),
        flight("4", reason="no plan"),
        BodyFlight(HARDWARE, TOPPQUAD, "1", LAGS[0], "", 0.02, 0.01, 0.015),
    ]
    (table,) = tables(Settings(), flights)
    planned, hardware = table.rows
    assert (planned["paths"], planned["failed"], planned["own_failed"]) == (4, 3, 2)
    assert planned["deviation"] == pytest.approx((0.2 + 3.0) / 4)
    assert planned["own_deviation"] == pytest.approx((0.1 + 0.3 + 2.0) / 4)
    assert planned["apart"] == planned["apart_most"] == 0.15
    assert (hardware["body"], hardware["apart"]) == (LAGS[0], 0.015)
