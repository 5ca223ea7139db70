"""The paper's hardware tables in the stepped lab: plans, limits and crashes."""

import numpy as np
import pytest
import torch

from cfplan.safety.limits_file import DEFAULTS, load_limits
from cfplan.safety.space import check_space
from studies.paper.hardware import (
    CERTIFIED,
    LIMITS,
    LONG,
    RAW,
    SHIPPED,
    STUDY,
    HardwareFlight,
    Settings,
    hardware_paths,
    long_path,
    measure,
    paper_limits,
    plans_of,
    tables,
)
from studies.paper.networks import Kind, build_network
from studies.paper.sequences import Inputs
from studies.paper.trained import TrainedNetwork
from studies.paper.training import SequenceOptions, Training
from studies.paper.trials import TOPPQUAD, failed
from studies.runner.cases import run_study

USUAL = load_limits(DEFAULTS)


@pytest.fixture(scope="module")
def quick():
    return run_study("hardware", "studies.paper.hardware", STUDY, Settings(paths=1, quick=True))


@pytest.mark.slow
def test_every_planner_flies_certified_and_all_but_the_one_that_ships_as_planned(quick):
    rows = quick.table("hardware").rows
    assert [(row["way"], row["planner"]) for row in rows] == [
        (RAW, TOPPQUAD), (RAW, "LSTM-0.001"), (CERTIFIED, TOPPQUAD), (CERTIFIED, "LSTM-0.001"), (CERTIFIED, SHIPPED),
    ]  # fmt: skip
    assert [row["paper_deviation"] for row in rows] == [0.347, 0.355, 0.347, 0.355, None]
    assert [(row["limits"], row["network"]) for row in quick.table("training").rows] == [("appendix", "LSTM-0.001")]


def test_what_is_certified_lands_near_its_place(quick):
    flights = [flight for flight in quick.rows if flight.way == CERTIFIED]
    assert all(not flight.reason for flight in flights)
    assert max(flight.deviation for flight in flights) < 0.06
    assert max(flight.settled for flight in flights) < 1.0
    times = {flight.planner: flight.travel_time for flight in flights}
    assert times["LSTM-0.001"] == pytest.approx(times[SHIPPED], rel=0.01)  # repair leads to the same optimum


def test_tracks_are_kept_of_all_but_what_ships_and_go_along_the_path(quick):
    tracks = {(flight.way, flight.planner): np.array(flight.points) for flight in quick.rows if flight.points}
    assert set(tracks) == {(way, planner) for way in (RAW, CERTIFIED) for planner in (TOPPQUAD, "LSTM-0.001")}
    path = hardware_paths(USUAL, 1)["1"]
    places = 1000.0 * path(np.linspace(0.0, path.end, 121))
    away = np.linalg.norm(tracks[CERTIFIED, TOPPQUAD][:, None] - places, axis=2)
    assert away.min(axis=1).max() < 60  # mm
    assert away.min(axis=0).max() < 250  # all of the path: 2 m/s, ten poses a second


def test_failures_are_counted_and_left_out_of_the_means():
    def flight(trial, **changes):
        return HardwareFlight("text", RAW, "LSTM-0.1", str(trial), trial, **changes)

    flights = [
        flight(1, deviation=0.2, travel_time=5.0, settled=0.1), flight(2, deviation=1.4, travel_time=7.0, settled=9.0),
        flight(3, reason="no plan"), flight(4, deviation=0.4, travel_time=6.0, settled=0.3),
    ]  # fmt: skip
    table, line, long, _ = tables(Settings(), flights)
    (row,) = table.rows
    assert (row["flights"], row["failed"]) == (4, 2)
    assert (row["deviation"], row["deviation_most"]) == (pytest.approx(0.3), 0.4)
    assert (row["travel_time"], row["settled"]) == (pytest.approx(5.5), pytest.approx(0.2))
    assert row["paper_time"] == 8.288
    assert [each["flights"] for each in line.rows] == [1]  # the first path alone
    assert not long.rows
    assert all("paper_time" not in row for row in line.rows)  # the paper's times are means over all paths


@pytest.mark.parametrize("name", LIMITS)
def test_the_pilot_brakes_above_what_is_planned_and_no_sooner_than_usual(name):
    limits = paper_limits(USUAL, name)
    assert (limits.plan.acceleration, limits.plan.angular_velocity) == LIMITS[name]
    for quantity in ("acceleration", "angular_velocity"):
        ladder, usual = getattr(limits.flight, quantity), getattr(USUAL.flight, quantity)
        assert ladder.brake > getattr(limits.plan, quantity)
        assert usual.brake <= ladder.brake < ladder.land < ladder.cut


def test_the_paths_stay_in_the_room_and_the_first_is_straight():
    paths = hardware_paths(USUAL, 8)
    assert list(paths) == [str(number) for number in range(1, 9)]
    for path in paths.values():
        check_space(path, USUAL.space)
    straight = paths["1"](np.linspace(0.0, paths["1"].end, 50))
    along = straight[-1] - straight[0]
    assert np.abs(np.cross(straight - straight[0], along)).max() < 1e-9
    longest = max(path.length for path in paths.values())
    assert long_path(USUAL).length > 2.0 * longest


def test_a_network_without_an_answer_fails_every_flight_of_that_path():
    network = build_network(Kind.MLP, Inputs.ALL.width)
    for tensor in network.parameters():
        torch.nn.init.constant_(tensor, np.nan)
    options = SequenceOptions(kind=Kind.MLP)
    trained = Training(epochs=1, best=1, loss=1.0, unseen_loss=1.0, seconds=0.0, flat=True)
    networks = {
        "text": {"MLP": TrainedNetwork("MLP", options, network, learned_from=0, labels="expert", trained=trained)}
    }
    paths = {LONG: long_path(USUAL), **hardware_paths(USUAL, 1)}
    plans = [plan for plan in plans_of(networks, paths).values() if plan.planner == "MLP"]
    flights = [flight for plan in plans for flight in measure(networks, paths, 3, plan)]
    assert [(flight.path, flight.way) for flight in flights] == 3 * [("1", RAW)] + 3 * [("1", CERTIFIED)]
    assert all("not a number" in flight.reason and failed(flight) for flight in flights)
