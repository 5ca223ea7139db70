"""Each line of the preflight table can fail, alone, with its value and a hint."""

import math
from dataclasses import replace

import pytest

from cfplan.flight.mocap.poses import Pose
from cfplan.flight.pilot.deadlines import Lateness
from cfplan.flight.pilot.preflight import PreflightSnapshot, run_checks
from cfplan.flight.radio.supervisor_bits import CAN_FLY, FLYING, LOCKED, TUMBLED
from cfplan.flight.telemetry import Estimate, VehicleStatus

LEVEL = (0.0, 0.0, 0.0, 1.0)
STILL = (0.0, 0.0, 0.0)
PLACE = (0.0, 0.0, 0.02)


def status(voltage=4.1, bits=CAN_FLY):
    return VehicleStatus(1.0, STILL, (0, 0, 0, 0), voltage, bits)


def poses(rate=100.0, place=PLACE, quaternion=LEVEL):
    return tuple(Pose(step / rate, step / rate, place, quaternion) for step in range(round(rate) + 1))


@pytest.fixture
def ground(mission):
    return PreflightSnapshot(
        mission=mission,
        protocol=12,
        firmware="2026.08 (abcdef)",
        round_trip=0.003,
        could_fly=True,
        status=status(),
        wanted=mission.parameters,
        read_back=mission.parameters,
        poses=poses(),
        pose_age=0.01,
        estimate=Estimate(1.0, PLACE, STILL, STILL, LEVEL),
        variance=(1e-5, 1e-5, 1e-5),
        waking=Lateness(1e-4, 3e-4, 1e-3, 100, 0),
    )


def failures(ground):
    return [check.name for check in run_checks(ground) if not check.passed]


def test_a_vehicle_in_order_passes_every_line(ground):
    assert failures(ground) == []


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("radio protocol", {"protocol": 7}),
        ("firmware", {"firmware": "2025.02"}),
        ("firmware", {"firmware": "2025.09"}),
        ("firmware", {"firmware": ""}),
        ("link round trip", {"round_trip": 0.2}),
        ("link round trip", {"round_trip": 0.0}),
        ("supervisor", {"could_fly": False}),
        ("supervisor", {"status": status(bits=CAN_FLY | LOCKED)}),
        ("supervisor", {"status": status(bits=CAN_FLY | TUMBLED)}),
        ("supervisor", {"status": status(bits=CAN_FLY | FLYING)}),
        ("battery at rest", {"status": status(voltage=3.8)}),
        ("battery at rest", {"status": status(voltage=math.nan)}),
        ("parameters read back", {"read_back": {}}),
        ("pose rate", {"poses": poses(rate=30.0)}),
        ("pose rate", {"poses": poses()[:1]}),
        ("pose age", {"pose_age": 0.3}),
        ("estimate against pose", {"estimate": Estimate(1.0, (0.1, 0.0, 0.02), STILL, STILL, LEVEL)}),
        ("yaw against pose", {"estimate": Estimate(1.0, PLACE, STILL, STILL, (0.0, 0.0, 0.7071, 0.7071))}),
        ("estimator deviation", {"variance": (1.0, 0.0, 0.0)}),
        ("estimator deviation", {"variance": (math.inf,)}),
        ("this computer's lateness", {"waking": Lateness(0.001, 0.02, 0.03, 100, 0)}),
    ],
)
def test_each_line_fails_alone(ground, name, change):
    assert failures(replace(ground, **change)) == [name]


def test_a_vehicle_near_the_wall_may_not_take_off(ground):
    place = (2.9, 0.0, 0.02)
    away = replace(ground, poses=poses(place=place), estimate=replace(ground.estimate, position=place))
    assert failures(away) == ["place of take-off"]


def test_a_plan_outside_the_space_is_refused(ground, mission):
    limits = mission.limits
    narrow = replace(limits, space=replace(limits.space, high=(1.0, 3.0, 2.0)))
    assert failures(replace(ground, mission=replace(mission, limits=narrow))) == ["plan and stops in the space"]


def test_a_plan_longer_than_the_battery_is_refused(ground, mission):
    short = replace(mission.limits, battery=replace(mission.limits.battery, endurance=2.0))
    assert failures(replace(ground, mission=replace(mission, limits=short))) == ["flight time"]


def test_every_line_says_its_value_and_what_to_do(ground):
    for check in run_checks(ground):
        assert check.value
        assert check.threshold
        assert check.hint
