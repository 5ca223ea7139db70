"""`cfplan init`: what it writes can be flown in that room, and what was there stays."""

from pathlib import Path

import pytest

from cfplan.geometry.path_file import load_path_file
from cfplan.preparation.plan_flight import FlightOptions, plan_flight
from cfplan.safety.limits_file import load_limits
from cfplan.safety.space import check_space


@pytest.mark.parametrize("room", [(4.5, 8, 2), (2, 2, 2), (1.5, 1.5, 1.2), (60, 10, 5), (3, 60, 30)])
def test_the_first_path_lies_in_the_room(cfplan, tmp_path, room):
    ended = cfplan("init", tmp_path / "lab", "--room", "x".join(map(str, room)))
    assert ended.code == 0, ended.err
    limits = load_limits(tmp_path / "lab" / "safety.yaml")
    x, y, z = room
    assert (limits.space.low, limits.space.high) == ((-x / 2, -y / 2, 0.0), (x / 2, y / 2, z))
    first = load_path_file(tmp_path / "lab" / "first.yaml")
    check_space(first.path, limits.space, waypoints=first.waypoints)
    assert first.speed == 0.5
    assert "obstacles: []" in (text := (tmp_path / "lab" / "safety.yaml").read_text())
    assert all(example in text for example in ("# ", "box: {low: [", "cylinder: {x: "))


def test_the_first_path_of_a_small_room_is_planned_and_certified(cfplan, tmp_path):
    cfplan("init", tmp_path, "--room", "2x2x2")
    planned = plan_flight(tmp_path / "first.yaml", load_limits(tmp_path / "safety.yaml"), FlightOptions("convex"))
    assert planned.plan.certificate.passed


def test_a_weighed_vehicle_gets_an_airframe_file_of_its_own(cfplan, tmp_path):
    assert cfplan("init", tmp_path, "--mass", 0.0334).code == 0
    airframe = load_limits(tmp_path / "safety.yaml").airframe
    assert airframe.mass == 0.0334
    assert "33.4 g" in airframe.name


def test_its_room_counts_for_its_path_also_from_a_folder_with_another_room(cfplan, tmp_path, monkeypatch):
    cfplan("init", tmp_path)
    cfplan("init", tmp_path / "lab", "--room", "2x2x2")
    monkeypatch.chdir(tmp_path)
    words = "plan", "--planner", "convex"
    assert str(Path("lab", "safety.yaml")) in cfplan(*words, "lab/first.yaml").out
    monkeypatch.chdir(tmp_path / "lab")
    assert "lab" not in cfplan(*words, "../first.yaml").out.splitlines()[0].replace(str(tmp_path), "")


@pytest.mark.parametrize("there", ["safety.yaml", "first.yaml", "airframe.yaml"])
def test_nothing_is_overwritten(cfplan, tmp_path, there):
    (tmp_path / there).write_text("mine")
    ended = cfplan("init", tmp_path, "--mass", 0.0334)
    assert (ended.code, there in ended.err) == (2, True)
    assert [file.read_text() for file in tmp_path.iterdir()] == ["mine"]


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["--room", "big"], "4.5x8x2"),
        (["--room", "4500x8000x2000"], "write metres"),
        (["--room", "4x0.5x2"], "write metres"),
        (["--mass", "33.4"], "kilograms"),
        (["--vehicle", "crazyfly"], "crazyflie"),
    ],
)
def test_a_room_or_a_vehicle_that_is_none_is_refused(cfplan, tmp_path, words, part):
    ended = cfplan("init", tmp_path / "lab", *words)
    assert (ended.code, part in ended.err) == (2, True)
    assert not (tmp_path / "lab").exists()
