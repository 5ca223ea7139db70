"""The dry run lets good bytes fly and says what is wrong with the others."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cfplan.errors import NotCertifiedError
from cfplan.flight.firmware import gains_for
from cfplan.flight.setpoints.encoding import check_bytes, encode_trajectory
from cfplan.flight.setpoints.packets import encode
from cfplan.geometry.min_snap import min_snap
from cfplan.safety.limits import FlightLimits, Ladder, PlanLimits
from cfplan.simulation.dry_run import SETTLING, dry_run
from cfplan.simulation.engine.flight import Conditions, EstimateErrors
from cfplan.vehicle.airframes import AIRFRAMES
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.trajectory import Trajectory

AIRFRAME = AIRFRAMES["crazyflie-2.1+"]
LIMITS = FlightLimits(
    deviation=Ladder(0.3, 0.5, 1.0), fence=Ladder(0.0, 0.1, 0.3), speed=Ladder(3.0, 4.0, 6.0),
    acceleration=Ladder(10.0, 15.0, 30.0), angular_velocity=Ladder(10.0, 15.0, 30.0), patience=0.1,
)  # fmt: skip
PLAN = PlanLimits(
    speed=2.0, acceleration=5.0, angular_velocity=8.0, tilt=np.radians(30), motor_thrust_min=0.0,
    motor_thrust_max=0.12, specific_thrust_min=4.905,
)  # fmt: skip


def slalom(airframe=AIRFRAME, *, speed=2.0, acceleration=5.0) -> Trajectory:
    """As fast as a constant h lets it be within speed, m/s, and acceleration, m/s²."""
    path = min_snap([[0, 0, 1], [1, 0.5, 1.2], [2, -0.5, 0.9], [3, 0.5, 1.1], [4, 0, 1]])
    s = np.linspace(0, path.end, 41)
    fine = np.linspace(0, path.end, 2001)
    fastest, sharpest = (np.linalg.norm(path(fine, order), axis=1).max() for order in (1, 2))
    h, none = np.full(41, min((speed / fastest) ** 2, acceleration / sharpest)), np.zeros(41)
    return Trajectory(path, SpeedProfile(s, h, none, none, none[:-1], none, none, none[:-1]), airframe)


@pytest.fixture(scope="module")
def trajectory():
    return slalom()


@pytest.fixture(scope="module")
def encoded(trajectory):
    return encode_trajectory(trajectory)


@pytest.fixture(scope="module")
def good(encoded, trajectory):
    return dry_run(encoded, trajectory, AIRFRAME, LIMITS)


def test_a_certified_flight_at_the_papers_limits_stays_within_five_centimetres(good, encoded, trajectory):
    check_bytes(encoded, trajectory, PLAN)
    assert good.passed
    good.require_passed()
    assert 0.0 < good.deviation_rms < good.deviation < 0.05
    assert 0.0 < good.path_distance <= good.deviation
    assert good.final_error < 0.01
    assert 0.0 <= good.settle_time < SETTLING
    assert 1.8 < good.speed < 2.1
    assert 0.0 <= good.saturation < 0.05
    assert good.real_time_factor > 0


def test_what_it_reports_is_what_the_vehicle_did(good, trajectory):
    loop = good.loop
    error = np.linalg.norm(loop.position - trajectory.at(loop.time).position, axis=1)
    assert good.deviation == pytest.approx(error.max(), abs=1e-4)
    assert loop.time[np.argmax(error)] == pytest.approx(good.deviation_time, abs=0.02)
    assert good.speed <= np.linalg.norm(loop.velocity, axis=1).max()
    assert loop.position[0] == pytest.approx(trajectory.path(0.0))
    assert loop.velocity[0] == pytest.approx(0.0)


def test_it_can_be_written_down_and_read(good):
    kept = json.loads(json.dumps(good.summary()))
    assert kept["passed"] is True
    assert kept["deviation"] == good.deviation
    assert "loop" not in kept
    assert dict(good.rows())["verdict"] == "passed"
    assert f"{100 * good.deviation:.1f} cm" in dict(good.rows())["deviation in time"]


def test_making_up_for_drag_and_sending_body_rates_both_pay(good, encoded, trajectory):
    told = encoded.decoded
    without_drag = replace(told, acceleration=trajectory.at(encoded.times).acceleration)
    without_rates = replace(told, body_rate=np.zeros_like(told.body_rate))
    for worse in (without_drag, without_rates):
        other = dry_run(replace(encoded, payloads=encode(worse)), trajectory, AIRFRAME, LIMITS)
        assert other.deviation_rms > 1.5 * good.deviation_rms


def test_the_quaternion_that_is_sent_keeps_the_heading_and_the_planned_one_would_not(good, encoded, trajectory):
    def heading_error(run):
        planned = Rotation.from_quat(trajectory.at(run.loop.time).quaternion)
        return np.abs((planned.inv() * Rotation.from_quat(run.loop.quaternion)).as_rotvec(degrees=True)[:, 2]).max()

    planned = replace(encoded.decoded, quaternion=trajectory.at(encoded.times).quaternion)
    other = dry_run(replace(encoded, payloads=encode(planned)), trajectory, AIRFRAME, LIMITS)
    assert heading_error(good) < 1.0
    assert heading_error(other) > 3.0


def test_the_bytes_are_flown_and_not_the_trajectory(encoded, trajectory):
    payloads = encoded.payloads.copy()
    middle = len(payloads) // 2
    payloads[middle:] = payloads[middle]
    stuck = dry_run(replace(encoded, payloads=payloads), trajectory, AIRFRAME, LIMITS)
    assert not stuck.passed
    assert "strays" in stuck.reason
    with pytest.raises(NotCertifiedError, match=r"dry run: .*hint: "):
        stuck.require_passed()


@pytest.mark.parametrize(
    ("limits", "said"),
    [
        ({"deviation": Ladder(0.001, 0.5, 1.0)}, "strays"),
        ({"speed": Ladder(1.0, 2.0, 3.0)}, "speed"),
        ({"acceleration": Ladder(1.0, 2.0, 3.0)}, "acceleration"),
        ({"angular_velocity": Ladder(0.1, 2.0, 3.0)}, "angular velocity"),
    ],
)
def test_each_limit_of_the_flight_can_fail_it(encoded, trajectory, limits, said):
    run = dry_run(encoded, trajectory, AIRFRAME, replace(LIMITS, **limits))
    assert not run.passed
    assert said in run.reason


def test_a_peak_shorter_than_the_limits_patience_does_not_count(good, encoded, trajectory):
    peak = np.linalg.norm(good.loop.body_rate, axis=1).max()
    assert good.angular_velocity < peak
    impatient = dry_run(encoded, trajectory, AIRFRAME, replace(LIMITS, patience=0.0))
    assert impatient.angular_velocity == pytest.approx(peak)


def test_a_vehicle_that_cannot_carry_itself_fails():
    weak = replace(AIRFRAME, motor_thrust_max=0.9 * AIRFRAME.hover_thrust)
    trajectory = slalom(weak, speed=0.5)
    run = dry_run(encode_trajectory(trajectory), trajectory, weak, LIMITS)
    assert not run.passed
    assert run.saturation > 0.25
    assert run.settle_time == np.inf


def test_numbers_that_are_none_fail_it(encoded, trajectory):
    run = dry_run(
        encoded,
        trajectory,
        replace(AIRFRAME, drag=(np.nan, np.nan)),
        LIMITS,
        conditions=Conditions(gains_for(AIRFRAME)),
    )
    assert not run.passed
    assert run.deviation == np.inf
    assert run.path_distance == np.inf
    assert json.dumps(run.summary(), allow_nan=False)


@pytest.mark.parametrize(
    ("other", "told"),
    [
        pytest.param({"mass": 1.05}, {"gains": gains_for(AIRFRAME)}, id="heavier"),
        pytest.param({"mass": 0.95}, {"gains": gains_for(AIRFRAME)}, id="lighter"),
        pytest.param({"motor_time_constant": 1.25}, {}, id="slow motors"),
        pytest.param({}, {"delay": 0.020}, id="setpoints late"),
        pytest.param({}, {"estimate": EstimateErrors(0.010, 0.002, 0.03)}, id="estimate late and noisy"),
    ],
)
def test_the_same_bytes_fly_a_vehicle_a_little_different_otherwise(good, encoded, trajectory, other, told):
    airframe = replace(AIRFRAME, **{name: factor * getattr(AIRFRAME, name) for name, factor in other.items()})
    run = dry_run(encoded, trajectory, airframe, LIMITS, conditions=Conditions(**told))
    assert run.passed
    assert run.deviation != good.deviation
    if other.get("mass", 1.0) > 1.0:
        assert run.final_error > good.final_error


@pytest.mark.parametrize("name", AIRFRAMES)
def test_every_airframe_flies_a_moderate_slalom(name):
    trajectory = slalom(AIRFRAMES[name], speed=1.5, acceleration=3.0)
    run = dry_run(encode_trajectory(trajectory), trajectory, AIRFRAMES[name], LIMITS)
    assert run.passed
    assert run.deviation < 0.05
