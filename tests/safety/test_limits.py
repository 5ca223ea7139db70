"""safety.yaml: what is read, and what is refused where."""

import copy
import math
import re
from pathlib import Path

import pytest
import yaml

from cfplan.errors import InputError
from cfplan.flight.firmware import FLIES_AS_PREDICTED, NEWEST_KNOWN
from cfplan.safety.limits import Ladder
from cfplan.safety.limits_file import DEFAULTS, load_limits
from cfplan.safety.space import SIDES, Box, Cylinder
from cfplan.vehicle.airframes import AIRFRAMES

SAFETY = Path(__file__).parents[2] / "safety.yaml"
CONTENT = yaml.safe_load(SAFETY.read_text())


def keys(content=CONTENT, above=()):
    """The place of every value in the file."""
    for key, value in content.items():
        if isinstance(value, dict):
            yield from keys(value, (*above, key))
        else:
            yield (*above, key)


def changed(tmp_path, changes):
    content = copy.deepcopy(CONTENT)
    for place, value in changes.items():
        section = content
        *above, key = place.split(".")
        for name in above:
            section = section[name]
        section[key] = value
    file = tmp_path / "safety.yaml"
    file.write_text(yaml.safe_dump(content, sort_keys=False))
    return file


def test_the_projects_own_file_says_what_the_design_says():
    limits = load_limits(SAFETY)
    assert limits.airframe is AIRFRAMES["crazyflie-2.1+"]
    plan = limits.plan
    assert (plan.speed, plan.acceleration, plan.angular_velocity) == (2.0, 5.0, 8.0)
    assert plan.tilt == pytest.approx(math.radians(30))
    assert plan.specific_thrust_min == pytest.approx(0.5 * 9.81)
    assert limits.airframe.motor_thrust_min < plan.motor_thrust_min < limits.airframe.hover_thrust
    assert limits.airframe.hover_thrust < plan.motor_thrust_max < limits.airframe.motor_thrust_max
    assert limits.flight.acceleration.brake == limits.flight.angular_velocity.brake == 10.0
    assert limits.flight.deviation == Ladder(0.3, 0.6, 1.0)
    assert [high - low for low, high in zip(limits.space.low, limits.space.high, strict=True)] == [4.5, 8.0, 2.0]
    assert (limits.firmware.oldest, limits.firmware.newest) == (FLIES_AS_PREDICTED, NEWEST_KNOWN)


@pytest.mark.parametrize("vehicle", AIRFRAMES)
def test_every_vehicle_can_fly_within_the_projects_limits(tmp_path, vehicle):
    assert load_limits(changed(tmp_path, {"vehicle": vehicle})).airframe.name == vehicle


def test_a_vehicle_file_lies_beside_the_safety_file(tmp_path):
    (tmp_path / "mine.yaml").write_text(
        "name: mine\nmass: 0.03\ninertia: [1.6e-5, 1.6e-5, 2.9e-5]\narm: 0.03\nthrust_to_torque: 0.006\n"
        "motor_thrust_min: 0.01\nmotor_thrust_max: 0.15\nmotor_time_constant: 0.05\ndrag: [0.01, 0.01]\nsource: me\n"
    )
    assert load_limits(changed(tmp_path, {"vehicle": "mine.yaml"})).airframe.mass == 0.03


NO_POSITIVE_NUMBER = {
    "vehicle", "low", "high", "latency", "controller", "estimator", "watchdog", "outside", "attitude_error_deg",
    "vertical_acceleration_error", "velocity_error",
}  # fmt: skip
NEEDED = ("vehicle", "space", "space.low", "space.high")  # which nobody but the lab knows


def without(tmp_path, place):
    content = copy.deepcopy(CONTENT)
    *above, key = place.split(".")
    section = content
    for name in above:
        section = section[name]
    del section[key]
    file = tmp_path / "safety.yaml"
    file.write_text(yaml.safe_dump(content))
    return file


@pytest.mark.parametrize("place", NEEDED)
def test_vehicle_and_room_may_not_be_left_out(tmp_path, place):
    with pytest.raises(InputError, match=f"{place.split('.')[-1]}' is missing"):
        load_limits(without(tmp_path, place))


@pytest.mark.parametrize("place", sorted({".".join(place[:n]) for place in keys() for n in (1, 2, 3)} - {*NEEDED}))
def test_whatever_else_is_left_out_is_as_in_the_projects_file(tmp_path, place):
    assert load_limits(without(tmp_path, place)) == load_limits(SAFETY)


def test_two_lines_are_a_safety_file(tmp_path):
    file = tmp_path / "safety.yaml"
    file.write_text("vehicle: crazyflie-2.1+\nspace: {low: [-1, -1, 0], high: [1, 1, 2.2]}\nplan: {speed: 1.0}\n")
    limits, whole = load_limits(file), load_limits(SAFETY)
    assert (limits.space.high, limits.space.margin, limits.plan.speed) == ((1, 1, 2.2), whole.space.margin, 1.0)
    assert limits.flight == whole.flight


def test_the_defaults_are_the_projects_own_file():
    assert DEFAULTS.read_text() == SAFETY.read_text()


NUMBERS = [".".join(p) for p in keys() if p[-1] not in NO_POSITIVE_NUMBER]


@pytest.mark.parametrize("place", [place for place in NUMBERS if not place.startswith("firmware.")])
@pytest.mark.parametrize("value", [0, -1.0, "fast", True, None, float("nan"), float("inf"), [1.0], 1e9])
def test_no_number_may_be_zero_negative_or_no_number(tmp_path, place, value):
    with pytest.raises(InputError) as error:
        load_limits(changed(tmp_path, {place: value}))
    assert re.match(r".*safety\.yaml:\d+:\d+$", error.value.where)


@pytest.mark.parametrize("place", ["", "plan.", "flight.speed.", "space.", "pose."])
def test_unknown_keys_are_errors(tmp_path, place):
    with pytest.raises(InputError, match="unknown key") as error:
        load_limits(changed(tmp_path, {f"{place}sped": 1.0}))
    assert "known" in error.value.hint


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"vehicle": "crazyfly"}, "unknown vehicle 'crazyfly'"),
        ({"vehicle": "nowhere.yaml"}, "no such file"),
        ({"plan.motor_reserve": 0.45}, "cannot hover"),
        ({"plan.specific_thrust": 9.9}, "cannot hover"),
        ({"plan.motor_reserve": 0.1, "plan.tilt_deg": 50}, "cannot hold its height beyond a tilt of 44"),
        ({"plan.motor_reserve": 0.1, "plan.acceleration": 9.8}, "cannot accelerate at more than 9.6"),
        ({"plan.speed": 20.0, "flight.speed": {"brake": 25, "land": 28, "cut": 32}}, r"cannot fly faster than 1\d\.\d"),
        ({"plan.angular_acceleration": 900.0}, r"cannot turn faster by more than \d+ rad"),
        ({"plan.tilt_deg": 36}, r"plan.tilt_deg \(36°\) is above flight.stop_tilt_deg \(35°\)"),
        ({"plan.tilt_deg": 34, "flight.stop_tilt_deg": 33}, r"is above flight.stop_tilt_deg \(33°\)"),
        ({"plan.speed": 0.001}, "noise would hide"),
        ({"plan.acceleration": 0.001}, "noise would hide"),
        ({"plan.angular_velocity": 0.01}, "noise would hide"),
        ({"plan.angular_acceleration": 0.001}, "noise would hide"),
        ({"plan.tilt_deg": 0.52}, "looks like radians"),
        ({"plan.speed": 3.5}, "not below flight.speed.brake"),
        ({"plan.acceleration": 10.0}, "not below flight.acceleration.brake"),
        ({"plan.angular_velocity": 12.0}, "not below flight.angular_velocity.brake"),
        ({"flight.deviation.land": 0.2}, "must rise from brake over land to cut"),
        ({"flight.fence.cut": 0.1}, "must rise from brake over land to cut"),
        ({"ground.go_to_speed": 2.0}, "a mean of 2 m/s exceeds"),
        ({"plan.acceleration": 1.5}, "a mean of 0.5 m/s exceeds"),
        ({"plan.speed": 0.3}, "a mean of 0.3 m/s exceeds"),
        ({"ground.land_speed": 0.9, "plan.speed": 1.3}, "a mean of 0.9 m/s exceeds"),
        ({"firmware.controller": 5}, "controller"),
        ({"space.margin": 1.0}, "leaves no room"),
        ({"space.high": [-3.0, 4.0, 2.0]}, "leaves no room"),
        ({"space.high": [3.0, 4.0]}, "space.high"),
        ({"battery.under_load": 4.0}, "under_load must be below"),
        ({"pose.age_brake": 0.04}, "pose ages must rise"),
        ({"pose.rate_min": 120}, "rate_min is above"),
        ({"pose.rate": 15, "pose.rate_min": 10}, "every pose grows older"),
        ({"ground.take_off_height": 0.1}, "ends outside the space"),
        ({"firmware.oldest": "new"}, "oldest"),
        ({"firmware.newest": 2026.08}, "newest"),
        ({"firmware.newest": "2025.02"}, "older than firmware.oldest"),
        ({"firmware.controller": 9}, "controller"),
        ({"link_loss.outside": "ignore"}, r"link_loss.outside.*refuse.*warn"),
        ({"link_loss.outside": True}, r"link_loss.outside.*refuse.*warn"),
        ({"link_loss": "warn"}, "link_loss"),
        ({"link_loss.motor_lags": []}, r"link_loss.motor_lags"),
        ({"link_loss.motor_lags": [0.1, 0.9]}, r"link_loss.motor_lags"),
        ({"link_loss.attitude_error_deg": 11}, r"link_loss.attitude_error_deg"),
        ({"link_loss.attitude_error_deg": -1}, r"link_loss.attitude_error_deg"),
        ({"link_loss.velocity_error": 1.1}, r"link_loss.velocity_error"),
        ({"link_loss.velocity_error": -0.1}, r"link_loss.velocity_error"),
        ({"link_loss.vertical_acceleration_error": 3}, r"link_loss.vertical_acceleration_error"),
        ({"link_loss.vertical_acceleration_error": -0.1}, r"link_loss.vertical_acceleration_error"),
    ],
)
def test_limits_that_contradict_each_other_or_the_vehicle_are_refused(tmp_path, changes, message):
    with pytest.raises(InputError, match=message) as error:
        load_limits(changed(tmp_path, changes))
    assert "\n" not in str(error.value)
    assert error.value.where
    assert error.value.hint


def test_the_tilt_of_stops_is_read(tmp_path):
    assert load_limits(SAFETY).flight.stop_tilt == pytest.approx(math.radians(35))
    older = tmp_path / "older.yaml"  # from before this limit
    older.write_text("".join(line for line in SAFETY.read_text().splitlines(True) if "stop_tilt_deg" not in line))
    assert load_limits(older).flight.stop_tilt == pytest.approx(math.radians(35))
    looser = load_limits(changed(tmp_path, {"flight.stop_tilt_deg": 38}))
    assert looser.flight.stop_tilt == pytest.approx(math.radians(38))


def test_a_flight_that_link_loss_takes_outside_is_refused_unless_the_file_says_to_warn(tmp_path):
    assert not load_limits(SAFETY).link_loss.only_warn
    assert load_limits(changed(tmp_path, {"link_loss.outside": "warn"})).link_loss.only_warn
    content = {key: value for key, value in CONTENT.items() if key != "link_loss"}
    older = tmp_path / "older.yaml"
    older.write_text(yaml.safe_dump(content))
    assert not load_limits(older).link_loss.only_warn


def test_the_place_of_a_wrong_value_is_its_line_and_column(tmp_path):
    file = tmp_path / "safety.yaml"
    file.write_text(SAFETY.read_text().replace("tilt_deg: 30 ", "tilt_deg: 60 "))
    line = next(n for n, text in enumerate(file.read_text().splitlines(), start=1) if "tilt_deg" in text)
    with pytest.raises(InputError) as error:
        load_limits(file)
    assert error.value.where == f"{file}:{line}:13"


TABLE = {"name": "table", "box": {"low": [0.5, 1.0, 0.0], "high": [1.5, 2.0, 0.8], "yaw_deg": 30}}
POLE = {"cylinder": {"x": -1, "y": 2, "radius": 0.1, "height": 1.5}}


def test_obstacles_are_boxes_that_may_be_turned_and_cylinders_on_the_floor(tmp_path):
    space = load_limits(changed(tmp_path, {"space.obstacles": [TABLE, POLE], "space.low": [-2.25, -4, -0.1]})).space
    table, pole = space.obstacles
    assert table == Box((0.5, 1.0, 0.0), (1.5, 2.0, 0.8), math.radians(30), "table")
    assert pole == Cylinder(-1.0, 2.0, 0.1, -0.1, 1.4)
    assert space.faces[SIDES:] == ("the obstacle 'table'", "obstacle 2")
    assert load_limits(SAFETY).space.obstacles == ()


@pytest.mark.parametrize(
    ("obstacles", "line", "message"),
    [
        ([{"box": {"low": [0, 0, 0], "high": [1, 0, 1]}}], "- 0", r"the box from 0 to 0 m in y has no inside"),
        ([{"box": {"low": [0, 0, 1], "high": [1, 1, 0.5]}}], "- 0.5", r"from 1 to 0\.5 m in z.*its low corner"),
        ([TABLE | POLE], "- name", r"either a box or a cylinder.*hint: write"),
        ([{"name": "nothing"}], "- name", r"either a box or a cylinder"),
        ([{"cylinder": POLE["cylinder"] | {"radius": 0}}], "radius", r"radius should be greater than 0"),
        ([{"cylinder": POLE["cylinder"] | {"height": -1}}], "height", r"height should be greater than 0"),
        ([{"cylinder": POLE["cylinder"] | {"x": math.nan}}], "x:", r"finite number"),
        ([{"cylinder": POLE["cylinder"] | {"hight": 1}}], "hight", r"did you mean 'height'\?"),
        ([POLE, TABLE | {"box": {"low": [500, 0, 0], "high": [900, 9, 9]}}], "- 500", r"less than or equal to 32"),
        ([POLE, {"cylinder": {"x": 3, "y": 0, "radius": 0.5, "height": 1}}], "- cylinder", r"obstacle 2 is not in the"),
        ([{"cylinder": {"x": 0, "y": 0, "radius": 9, "height": 1}}], "- cylinder", r"leave no place to take off to"),
        ([copy.deepcopy(POLE) for _ in range(1001)], "- cylinder", r"at most 1000"),
    ],
)
def test_an_obstacle_that_cannot_be_is_refused_with_its_place(tmp_path, obstacles, line, message):
    file = changed(tmp_path, {"space.obstacles": obstacles})
    with pytest.raises(InputError, match=message) as error:
        load_limits(file)
    number = int(error.value.where.split(":")[-2])
    assert line in file.read_text().splitlines()[number - 1]


def test_an_obstacle_partly_in_the_room_counts_and_so_does_one_that_hangs(tmp_path):
    wardrobe = {"box": {"low": [2.2, -1, 0], "high": [3, 1, 2]}}
    lamp = {"name": "lamp", "cylinder": POLE["cylinder"]}
    assert len(load_limits(changed(tmp_path, {"space.obstacles": [wardrobe, lamp]})).space.obstacles) == 2
