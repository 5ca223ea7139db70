"""`cfplan fly --after`: the second flight of a plan, on a vehicle that is not what its airframe says."""

import shlex
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import pages
import pytest
from stepped_flight import fly_stepped

from cfplan.identification.airframe_yaml import write_airframe
from cfplan.recording.header import FLOWN
from cfplan.recording.reader import read_record
from cfplan.simulation.lab.stepped_lab import SteppedLab
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_vicon.cameras import ViconSettings
from cfplan.vehicle.airframes import AIRFRAMES

REPOSITORY = Path(__file__).parents[2]
SHIPPED = AIRFRAMES["crazyflie-2.1+"]
CHANCE = 0.01  # m rms by which flights of the virtual vehicle differ, as the errors of its sensors are drawn anew


class SteppedVehicle:
    """In place of the processes of pilot and lab."""

    def __init__(self, uri, mocap_uri, limits):
        self.uri, self.pilot = uri, None

    def poses(self, steps):
        return None

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass


@pytest.fixture(scope="module")
def patched():
    """Fly a vehicle with 30 % more moment, less drag and less thrust than the shipped one, each time with new noise."""
    seeds = count(1)

    def fly(mission, *, on_telemetry, more_orders, **_):
        said, seed = mission.limits.airframe, next(seeds)
        vehicle = replace(
            said, thrust_scale=0.94 * said.thrust_scale, drag=tuple(0.7 * drag for drag in said.drag),
            velocity_moment=tuple(1.3 * moment for moment in SHIPPED.velocity_moment),
        )  # fmt: skip
        cameras = ViconSettings(seed=seed)
        lab = SteppedLab(vehicle, vehicle=VehicleSettings(seed=seed), cameras=cameras, seed=seed)
        return fly_stepped(mission, on_telemetry, lab=lab, more_orders=more_orders).outcome

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("cfplan.steering.starting_vehicle.StartingVehicle", SteppedVehicle)
        patch.setattr("cfplan.cli.recorded_flight.fly", fly)
        yield


def fly(cfplan, records, *words):
    """Fly, and return the record's folder and the figures."""
    ended = cfplan("fly", *words, "--records", records, "--json")
    assert ended.code == 0, ended.err
    return Path(ended.json["record"]), ended.json


@pytest.fixture
def without_moment(safety_file, tmp_path):
    """A safety.yaml with an airframe file that states no moment, as one that holds mass, thrust and drag alone."""
    write_airframe(replace(SHIPPED, velocity_moment=(0.0, 0.0)), tmp_path / "no-moment.yaml")
    return safety_file(("^vehicle: .*", f"vehicle: {tmp_path / 'no-moment.yaml'}"))


@pytest.fixture
def first(patched, cfplan, kept):
    """The record of a first flight of flights/line.yaml."""
    if "first" not in kept:
        kept["first"] = fly(cfplan, kept["records"], REPOSITORY / "flights" / "line.yaml")
    return kept["first"]


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    return {"records": tmp_path_factory.mktemp("records")}


def fly_three_times(cfplan, records, *words):
    """Fly, and again after that, and again after both; return the figures and the records."""
    flights: list[Path] = []
    figures = []
    for _ in range(3):
        after = [word for flight in flights for word in ("--after", flight)]
        folder, flown = fly(cfplan, records, *words, *after)
        flights.append(folder)
        figures.append(flown)
    return figures, flights


def require_improvement(figures, first, fraction):
    """Require a deviation of the first flight above `first`, m, and below `fraction` of it from then on."""
    largest = [flown["max_deviation"] for flown in figures]
    assert largest[0] > first
    assert largest[1] < fraction * largest[0]
    assert largest[2] < largest[1] + CHANCE
    assert all(flown["travel_time_flown"] is not None for flown in figures)  # each arrived at the plan's end


@pytest.mark.slow
def test_the_second_flight_stays_nearer_to_the_plan_and_the_third_no_farther(patched, cfplan, tmp_path, without_moment):
    words = REPOSITORY / "flights" / "figure8.yaml", "--safety", without_moment
    figures, (first, second, third) = fly_three_times(cfplan, tmp_path / "records", *words)
    require_improvement(figures, 0.05, 0.5)
    assert not (first / "uncorrected.parquet").exists()
    for folder in (second, third):
        assert (folder / "uncorrected.parquet").read_bytes()
        assert cfplan("check", folder).code == 0  # what was sent is what the record's plan says
    header = read_record(third).header
    assert np.abs(header.shift).max() == pytest.approx(0.07, abs=0.03)
    assert header.name == "figure eight"


@pytest.mark.slow
@pytest.mark.parametrize("path", ["slalom", "random", "trefoil", "line"])
def test_second_flights_of_fast_paths_stay_nearer(patched, cfplan, tmp_path, without_moment, path):
    words = REPOSITORY / "flights" / f"{path}.yaml", "--safety", without_moment
    figures, _ = fly_three_times(cfplan, tmp_path / "records", *words)
    require_improvement(figures, 0.05, 0.5)


@pytest.mark.slow
@pytest.mark.parametrize("path", ["slalom", "figure8", "random", "trefoil"])
def test_with_the_shipped_airframe_first_flights_are_near_and_second_ones_nearer(patched, cfplan, tmp_path, path):
    figures, _ = fly_three_times(cfplan, tmp_path, REPOSITORY / "flights" / f"{path}.yaml")
    require_improvement(figures, 0.02, 0.7)
    assert figures[0]["max_deviation"] < 0.05


@pytest.mark.slow
def test_a_flight_on_board_is_corrected_by_the_one_before(patched, cfplan, tmp_path, without_moment):
    words = REPOSITORY / "flights" / "line.yaml", "--on-board", "--safety", without_moment
    first, before = fly(cfplan, tmp_path, *words)
    second, after = fly(cfplan, tmp_path, *words, "--after", first)
    assert read_record(second).header.provenance[FLOWN] == "on board"
    assert after["rms_deviation"] < 0.7 * before["rms_deviation"]
    assert after["travel_time_flown"] is not None
    assert (second / "uncorrected.parquet").is_file()
    streamed = cfplan("fly", *words[:1], *words[2:], "--after", first)
    assert streamed.code == 2
    assert "add --on-board" in streamed.err


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("^  speed: 2.0", "  speed: 1.9"), "limits of plans"),
        (("^  margin: 0.2", "  margin: 0.21"), "room"),
        (("^vehicle: .*", "vehicle: crazyflie-2.0"), "airframe"),
    ],
    ids=["limits", "room", "airframe"],
)
def test_what_changed_since_the_record_is_refused(first, cfplan, safety_file, change, said):
    folder, _ = first
    ended = cfplan("fly", REPOSITORY / "flights" / "line.yaml", "--after", folder, "--safety", safety_file(change))
    assert ended.code == 2
    assert said in ended.err
    assert str(folder) in ended.err
    assert "hint:" in ended.err


def test_another_path_is_refused_and_the_plan_named(first, cfplan, path_file):
    folder, _ = first
    text = (REPOSITORY / "flights" / "line.yaml").read_text()
    ended = cfplan("fly", path_file(text + "speed: 0.9\n"), "--after", folder)
    assert ended.code == 2
    assert "does not match the plan flown" in ended.err
    assert str(folder / "plan.parquet") in ended.err


@pytest.mark.parametrize("option", [("--speed", "0.5"), ("--planner", "expert"), ("--nodes", "40"), ("--on-board",)])
def test_an_option_that_asks_for_another_flight_is_refused(first, cfplan, option):
    ended = cfplan("fly", REPOSITORY / "flights" / "line.yaml", "--after", first[0], *option)
    assert ended.code == 2
    assert "hint:" in ended.err
    assert option == ("--on-board",) or f"{option[0]}: " in ended.err


def test_waypoints_in_the_air_are_no_second_flight(cfplan, tmp_path):
    ended = cfplan("fly", "--waypoints", "-", "--after", tmp_path)
    assert ended.code == 2
    assert "new plan" in ended.err


def test_waypoints_in_the_air_refuse_a_speed_that_would_not_hold(cfplan, tmp_path):
    ended = cfplan("fly", "--waypoints", "-", "--speed", "0.3", "--records", tmp_path)
    assert ended.code == 2
    assert "--speed: " in ended.err
    assert "safety.yaml" in ended.err


def test_a_folder_that_is_no_record_is_refused(patched, cfplan, tmp_path):
    ended = cfplan("fly", REPOSITORY / "flights" / "line.yaml", "--after", tmp_path)
    assert ended.code == 2
    assert "flight.mcap" in ended.err


@pytest.mark.parametrize("line", pages.lines_for(pages.AGAIN))
def test_a_second_flight_goes_as_it_is_shown(first, cfplan, tmp_path, line):
    """But for the path, and for the records, each of which is that of the first flight here."""
    words = shlex.split(line)[3:]
    after = [first[0] if word.startswith("records/") else word for word in words]
    assert after != words
    fly(cfplan, tmp_path, REPOSITORY / "flights" / "line.yaml", *after)
