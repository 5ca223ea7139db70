"""Each line of the preflight table can fail, alone, with its value and a hint."""

import math
import re
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cfplan.flight.firmware import GAIN_PARAMETERS, NEWEST_KNOWN, Timeouts, version_of, version_text
from cfplan.flight.mocap.poses import Pose
from cfplan.flight.pilot.deadlines import Lateness
from cfplan.flight.pilot.health import GONE, Health
from cfplan.flight.pilot.preflight import PreflightSnapshot, firmware_check, run_checks
from cfplan.flight.pilot.vehicle_rules import COMMANDER_SIGNS, PARAMETER_GROUPS, PARAMETER_RULES, Action, Traffic
from cfplan.flight.radio.supervisor_bits import (
    CAN_FLY,
    DECK_FAULT,
    FLYING,
    HIGH_LEVEL_ACTIVE,
    HIGH_LEVEL_DISABLED,
    LOCKED,
    TUMBLED,
)
from cfplan.flight.telemetry import Estimate, VehicleStatus
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.virtual_crazyflie.defaults import DEFAULTS
from cfplan.simulation.virtual_crazyflie.supervisor import LEVEL_OUT_AFTER, PERIOD, SHUT_DOWN_AFTER
from cfplan.vehicle.airframes import AIRFRAMES

SHIPPED = load_limits(Path(__file__).parents[3] / "safety.yaml")
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
        traffic=Traffic(CAN_FLY, (), setpoint=False),
        parameters={rule.name: rule.value(mission.limits) for rule in PARAMETER_RULES},
        poses=poses(),
        pose_age=0.01,
        stood=PLACE,
        estimate=Estimate(1.0, PLACE, STILL, STILL, LEVEL),
        variance=(1e-5, 1e-5, 1e-5),
        health=Health(),
        waking=Lateness(1e-4, 3e-4, 1e-3, 100, 0),
    )


def failures(ground):
    return [check.name for check in run_checks(ground) if not check.passed]


def test_a_vehicle_in_order_passes_every_line(ground):
    assert failures(ground) == []


def test_the_page_on_preflight_explains_every_line(ground):
    page = (Path(__file__).parents[3] / "docs" / "preflight.md").read_text(encoding="utf-8")
    for check in run_checks(ground):
        assert check.name in PARAMETER_GROUPS or f"| {check.name} | " in page


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("radio protocol", {"protocol": 7}),
        ("drift of the standing body", {"stood": (0.06, 0.0, 0.02)}),
        ("firmware", {"firmware": "2025.02"}),
        ("firmware", {"firmware": "2025.09"}),
        ("link round trip", {"round_trip": 0.2}),
        ("link round trip", {"round_trip": 0.0}),
        ("vehicle's logs", {"health": Health(status=GONE)}),
        ("vehicle's logs", {"health": Health(estimate=GONE)}),
        ("supervisor", {"could_fly": False}),
        ("supervisor", {"status": status(bits=CAN_FLY | LOCKED)}),
        ("supervisor", {"status": status(bits=CAN_FLY | TUMBLED)}),
        ("supervisor", {"status": status(bits=CAN_FLY | DECK_FAULT)}),
        ("supervisor", {"status": status(bits=CAN_FLY | FLYING)}),
        ("battery at rest", {"status": status(voltage=3.8)}),
        ("battery at rest", {"status": status(voltage=math.nan)}),
        ("other commanders", {"traffic": Traffic(CAN_FLY | HIGH_LEVEL_ACTIVE, (), setpoint=False)}),
        ("other commanders", {"traffic": Traffic(CAN_FLY | HIGH_LEVEL_DISABLED, (), setpoint=False)}),
        ("other commanders", {"traffic": Traffic(CAN_FLY, (7,), setpoint=False)}),
        ("other commanders", {"traffic": Traffic(CAN_FLY, (), setpoint=True)}),
        ("pose rate", {"poses": poses(rate=30.0)}),
        ("pose rate", {"poses": poses()[:1]}),
        ("pose age", {"pose_age": 0.3}),
        ("estimate against pose", {"estimate": Estimate(1.0, (0.1, 0.0, 0.02), STILL, STILL, LEVEL)}),
        ("yaw against pose", {"estimate": Estimate(1.0, PLACE, STILL, STILL, (0.0, 0.0, 0.7071, 0.7071))}),
        ("tilt of the body", {"poses": poses(quaternion=(math.sin(0.05), 0.0, 0.0, math.cos(0.05)))}),  # 5.7°
        ("estimator deviation", {"variance": (1.0, 0.0, 0.0)}),
        ("estimator deviation", {"variance": (math.inf,)}),
        ("this computer's lateness", {"waking": Lateness(0.001, 0.02, 0.03, 100, 0)}),
    ],
)
def test_each_line_fails_alone(ground, name, change):
    assert failures(replace(ground, **change)) == [name]


def test_a_firmware_with_other_time_outs_is_refused_even_where_it_may_be_that_old(ground, mission):
    old = replace(mission.limits, firmware=replace(mission.limits.firmware, oldest=(2023, 2)))
    before = replace(ground, firmware="2023.02", mission=replace(mission, limits=old))
    assert failures(before) == ["supervisor's time-outs"]


@pytest.mark.parametrize(
    ("firmware", "deviates"),
    [("2025.12.1", "5 to 9 cm"), ("2025.09.1", "8 to 13 cm"), ("2025.02", ""), ("2026.04", "")],
)
def test_a_firmware_that_deviates_more_than_dry_runs_say_flies_only_by_a_key_with_the_figure(firmware, deviates):
    shipped = firmware_check(firmware, SHIPPED)
    assert shipped.passed == (firmware == "2026.04")
    assert f'oldest: "{firmware}"' in shipped.hint or not deviates
    named = replace(SHIPPED, firmware=replace(SHIPPED.firmware, oldest=version_of(firmware)))
    accepted = firmware_check(firmware, named)
    assert accepted.passed
    assert deviates in accepted.value
    assert ("deviates" in accepted.value) == bool(deviates)


def test_a_vehicle_that_does_not_tell_its_firmware_is_refused(ground):
    assert failures(replace(ground, firmware="")) == ["firmware", "supervisor's time-outs"]


@pytest.mark.parametrize("firmware", ["2026.08.1", "2026.08 +37", "2026.08-312", "2026.09", "2031.11"])
def test_a_firmware_newer_than_those_known_is_refused_unless_the_limits_name_it(ground, mission, firmware):
    newer = replace(ground, firmware=firmware)
    (refused,) = (check for check in run_checks(newer) if not check.passed)
    assert (refused.name, refused.value) == ("firmware", firmware)
    assert "newest" in refused.hint
    (newest,) = re.findall(r'newest: "(\d{4}\.\d\d(?:\.\d)?)"', refused.hint)
    named = replace(mission.limits, firmware=replace(mission.limits.firmware, newest=version_of(newest)))
    allowed = replace(newer, mission=replace(mission, limits=named))
    assert failures(allowed) == []
    told = any("newest that cfplan knows" in check.value for check in run_checks(allowed))
    assert told == (version_of(firmware) > NEWEST_KNOWN)


def outside(rule, limits):
    """Values just outside what a rule allows, and values that are none."""
    intervals = rule.allowed(limits)
    step = max(abs(end) for interval in intervals for end in interval if math.isfinite(end)) * 1e-3 or 1.0
    ends = [low - step for low, _ in intervals] + [high + step for _, high in intervals if math.isfinite(high)]
    return [value for value in ends if not any(low <= value <= high for low, high in intervals)] + [math.nan]


@pytest.mark.parametrize("rule", PARAMETER_RULES, ids=lambda rule: rule.name)
def test_each_parameter_fails_alone_with_its_value_what_is_allowed_and_why(ground, mission, rule):
    for value in outside(rule, mission.limits):
        parameters = {**ground.parameters, rule.name: value}
        (check,) = (check for check in run_checks(replace(ground, parameters=parameters)) if not check.passed)
        assert check.name == rule.name
        assert check.value == f"{value:g}"
        assert check.threshold.startswith(rule.threshold(mission.limits))
        assert rule.reason in check.hint
        assert rule.hint in check.hint


@pytest.mark.parametrize("rule", PARAMETER_RULES, ids=lambda rule: rule.name)
def test_a_vehicle_that_lacks_a_parameter_flies_only_where_the_table_says_so(ground, rule):
    parameters = {name: value for name, value in ground.parameters.items() if name != rule.name}
    assert failures(replace(ground, parameters=parameters)) == ([] if rule.optional else [rule.name])


@pytest.mark.parametrize("rule", PARAMETER_RULES, ids=lambda rule: rule.name)
@settings(max_examples=25)
@given(value=st.floats(width=32))
def test_what_a_rule_accepts_is_what_its_intervals_hold(rule, value):
    held = any(low - 1e-6 * low <= value <= high + 1e-6 * high for low, high in rule.allowed(SHIPPED))
    assert rule.accepts(value, SHIPPED) == held


def test_the_table_is_complete_and_names_each_parameter_once():
    names = [rule.name for rule in PARAMETER_RULES]
    assert len(names) == len(set(names))
    assert set(GAIN_PARAMETERS) <= set(names)
    for rule in PARAMETER_RULES:
        assert rule.reason.endswith(".")
        assert not rule.hint.endswith(".")
        assert rule.optional or not rule.since, "a firmware that may fly could lack it"
    for sign in COMMANDER_SIGNS:
        assert sign.reason.endswith(".")


def test_what_is_set_is_one_value(mission):
    for rule in PARAMETER_RULES:
        if rule.action is Action.SET:
            ((low, high),) = rule.allowed(mission.limits)
            assert low == high


@pytest.mark.parametrize("airframe", AIRFRAMES.values(), ids=AIRFRAMES)
def test_a_vehicle_as_it_comes_has_what_is_only_read(airframe):
    limits = replace(SHIPPED, airframe=airframe)
    for rule in PARAMETER_RULES:
        if rule.action is Action.REFUSED:
            assert rule.accepts(DEFAULTS.get(rule.name, 0.0), limits), rule.name
    assert PARAMETER_GROUPS["settings on board"]
    idle = next(rule for rule in PARAMETER_RULES if rule.name == "powerDist.idleThrust")
    assert idle.accepts(7000.0, limits) or "brushless" not in airframe.name  # as brushless vehicles come


def test_the_time_outs_are_those_that_the_virtual_supervisor_keeps():
    times = Timeouts()
    assert (1000 * times.level_out, 1000 * times.motors_off) == (LEVEL_OUT_AFTER, SHUT_DOWN_AFTER)
    assert 1000 * times.period == PERIOD


@given(st.text())
def test_any_text_is_a_firmware_or_none(text):
    version = version_of(text)
    assert version == () or version_of(version_text(version)) == version


def test_versions_are_read_as_bitcraze_writes_them():
    assert version_of("2025.09.1 (abc)") == (2025, 9, 1)
    assert version_text((2025, 9, 1)) == "2025.09.1"
    assert version_of("2026.08 +12") == NEWEST_KNOWN


def test_a_vehicle_near_the_wall_may_not_take_off(ground):
    place = (2.9, 0.0, 0.02)
    away = replace(ground, poses=poses(place=place), stood=place, estimate=replace(ground.estimate, position=place))
    assert failures(away) == ["take-off position"]


@pytest.mark.parametrize(
    ("standing", "passes"), [((1.2, 0.02, -0.8), False), ((1.2, 0.02, 0.5), False), ((1.2, 0.4, 0.2), True)]
)
def test_a_vehicle_that_stands_far_above_or_beneath_the_floor_has_another_axis_up(ground, standing, passes):
    stands = replace(
        ground, poses=poses(place=standing), stood=standing, estimate=replace(ground.estimate, position=standing)
    )
    assert failures(stands) == ([] if passes else ["height of the body"])


def test_a_plan_outside_the_space_is_refused(ground, mission):
    limits = mission.limits
    narrow = replace(limits, space=replace(limits.space, high=(1.0, 3.0, 2.0)))
    assert failures(replace(ground, mission=replace(mission, limits=narrow))) == ["plan and stops in the space"]


def test_a_plan_longer_than_the_battery_is_refused(ground, mission):
    short = replace(mission.limits, battery=replace(mission.limits.battery, endurance=2.0))
    assert failures(replace(ground, mission=replace(mission, limits=short))) == ["flight time"]


def test_every_line_says_its_value_and_each_that_fails_what_to_do(ground):
    silent = replace(
        ground, protocol=0, firmware="", round_trip=0.0, status=status(voltage=0.0, bits=LOCKED), parameters={},
        traffic=Traffic(HIGH_LEVEL_ACTIVE, (7,), setpoint=True), pose_age=1.0, poses=poses(rate=1.0),
    )  # fmt: skip
    for check in (*run_checks(ground), *run_checks(silent)):
        assert check.value
        assert check.threshold
        assert check.passed or check.hint
