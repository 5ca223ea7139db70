"""The dry run lets good bytes fly, says what deviation to expect, and what is wrong with other bytes."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cfplan.errors import NotCertifiedError
from cfplan.flight.firmware import FLIES_AS_PREDICTED, gains_for
from cfplan.flight.setpoints.byte_check import check_bytes
from cfplan.flight.setpoints.encoding import encode_trajectory
from cfplan.flight.setpoints.packets import encode
from cfplan.geometry.min_snap import min_snap
from cfplan.safety.limits import FlightLimits, Ladder, PlanLimits
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.draws import DRAWS
from cfplan.simulation.dry_run import SETTLING, dry_run, fly_motion, rehearse_motion
from cfplan.simulation.engine.flight import Conditions, EstimateErrors
from cfplan.vehicle.airframe import Spread
from cfplan.vehicle.airframes import AIRFRAMES
from cfplan.vehicle.profile import SpeedProfile
from cfplan.vehicle.trajectory import Trajectory

AIRFRAME = AIRFRAMES["crazyflie-2.1+"].simplified()  # its moment by velocity would hide what the other causes add
FLIGHT = FlightLimits(
    deviation=Ladder(0.3, 0.5, 1.0), fence=Ladder(0.0, 0.1, 0.3), speed=Ladder(3.0, 4.0, 6.0),
    acceleration=Ladder(10.0, 15.0, 30.0), angular_velocity=Ladder(10.0, 15.0, 30.0), patience=0.1,
)  # fmt: skip
SHIPPED = load_limits(Path(__file__).parents[2] / "safety.yaml")
KNOWS_DRAG = replace(SHIPPED.firmware, oldest=FLIES_AS_PREDICTED)
LIMITS = replace(SHIPPED, airframe=AIRFRAME, flight=FLIGHT, firmware=KNOWS_DRAG)
NONE = Spread(mass=0.0, thrust_scale=0.0, drag=0.0, velocity_moment=0.0, motor_time_constant=0.0)
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
    return dry_run(encoded, trajectory, LIMITS)


def test_a_certified_flight_at_the_papers_limits_stays_within_six_centimetres(good, encoded, trajectory):
    check_bytes(encoded, trajectory, PLAN)
    assert good.passed
    good.require_passed()
    assert 0.0 < good.deviation_rms < good.deviation_median < 0.04
    assert good.deviation_median < good.deviation < 0.06
    assert good.path_distance > 0.0
    assert good.final_error < 0.03
    assert 0.0 <= good.settle_time < SETTLING
    assert 1.8 < good.speed < 2.1
    assert 0.0 <= good.saturation < 0.05
    assert good.real_time_factor > 0
    assert good.knows_drag


def test_what_it_reports_is_what_the_vehicles_did(good, trajectory):
    assert len(good.deviations) == DRAWS
    assert good.deviation_median == pytest.approx(np.median(good.deviations))
    assert sorted(good.deviations)[-2:] >= [good.deviation]  # one of 32 is beyond the 95th percentile
    assert sum(each > good.deviation for each in good.deviations) == 1
    loop = good.loop
    error = np.linalg.norm(loop.position - trajectory.at(loop.time).position, axis=1)
    assert good.deviation_rms == pytest.approx(np.sqrt(np.mean(error[loop.time <= trajectory.duration] ** 2)), rel=0.01)
    assert loop.position[0] == pytest.approx(trajectory.path(0.0))
    assert loop.velocity[0] == pytest.approx(0.0)


def test_the_same_bytes_always_give_the_same_figures(good, encoded, trajectory):
    again = dry_run(encoded, trajectory, LIMITS)
    assert again.deviations == good.deviations


def test_a_vehicle_that_is_known_exactly_strays_less_than_the_draws(good, encoded, trajectory):
    known = dry_run(encoded, trajectory, replace(LIMITS, airframe=replace(AIRFRAME, spread=NONE)))
    assert known.deviation < 0.8 * good.deviation
    assert np.ptp(known.deviations) > 0.0  # late and noisy poses alone


@pytest.mark.parametrize("name", ["mass", "thrust_scale", "drag", "motor_time_constant"])
def test_each_spread_of_the_airframe_counts(encoded, trajectory, name):
    spread = replace(NONE, **{name: 0.15})
    known, drawn = (
        dry_run(encoded, trajectory, replace(LIMITS, airframe=replace(AIRFRAME, spread=each)))
        for each in (NONE, spread)
    )
    # Poses are the same in both; the lag matters least.
    assert np.abs(np.subtract(drawn.deviations, known.deviations)).max() > 2e-4


def test_a_moment_by_velocity_adds_to_the_deviation_and_its_spread_counts(good, encoded, trajectory):
    tilting = replace(AIRFRAME, velocity_moment=(4.4e-4, 6.2e-4), spread=NONE)
    known, drawn = (
        dry_run(encoded, trajectory, replace(LIMITS, airframe=replace(tilting, spread=each)))
        for each in (NONE, replace(NONE, velocity_moment=0.5))
    )
    assert known.deviation_median > 1.3 * good.deviation_median
    assert np.abs(np.subtract(drawn.deviations, known.deviations)).max() > 2e-3


def test_a_filter_that_knows_no_drag_strays_several_centimetres_more(good, encoded, trajectory):
    older = replace(LIMITS, firmware=replace(SHIPPED.firmware, oldest=(2025, 9, 1)))
    run = dry_run(encoded, trajectory, older)
    assert not run.knows_drag
    assert run.deviation_median > good.deviation_median + 0.03
    assert "without a model of rotor drag" in dict(run.rows())["vehicle's filter"]


@pytest.mark.parametrize(
    "pose", [{"position_noise": 0.03}, {"attitude_noise": np.radians(5.0)}, {"latency": 0.08}], ids=str
)
def test_poses_are_as_late_and_noisy_as_the_room_says(good, encoded, trajectory, pose):
    run = dry_run(encoded, trajectory, replace(LIMITS, pose=replace(LIMITS.pose, **pose)))
    assert run.deviation_rms > 1.1 * good.deviation_rms


def test_it_can_be_written_down_and_read(good):
    kept = json.loads(json.dumps(good.summary()))
    assert kept["passed"] is True
    assert kept["deviation"] == good.deviation
    assert "loop" not in kept
    assert dict(good.rows())["verdict"] == "passed"
    assert f"{100 * good.deviation_median:.1f} cm" in dict(good.rows())["largest deviation, median"]
    assert f"{100 * good.deviation:.1f} cm" in dict(good.rows())["largest deviation, 95 %"]


def test_making_up_for_drag_and_sending_body_rates_both_pay(good, encoded, trajectory):
    told = encoded.decoded
    without_drag = replace(told, acceleration=trajectory.at(encoded.times).acceleration)
    without_rates = replace(told, body_rate=np.zeros_like(told.body_rate))
    for worse in (without_drag, without_rates):
        other = dry_run(replace(encoded, payloads=encode(worse)), trajectory, LIMITS)
        assert other.deviation_rms > 1.5 * good.deviation_rms


def test_the_quaternion_that_is_sent_keeps_the_heading_and_the_planned_one_would_not(good, encoded, trajectory):
    def heading_error(run):
        planned = Rotation.from_quat(trajectory.at(run.loop.time).quaternion)
        return np.abs((planned.inv() * Rotation.from_quat(run.loop.quaternion)).as_rotvec(degrees=True)[:, 2]).max()

    planned = replace(encoded.decoded, quaternion=trajectory.at(encoded.times).quaternion)
    other = dry_run(replace(encoded, payloads=encode(planned)), trajectory, LIMITS)
    assert heading_error(good) < 1.0
    assert heading_error(other) > 3.0


def test_the_bytes_are_flown_and_not_the_trajectory(encoded, trajectory):
    payloads = encoded.payloads.copy()
    middle = len(payloads) // 2
    payloads[middle:] = payloads[middle]
    stuck = dry_run(replace(encoded, payloads=payloads), trajectory, LIMITS)
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
    run = dry_run(encoded, trajectory, replace(LIMITS, flight=replace(FLIGHT, **limits)))
    assert not run.passed
    assert said in run.reason


def test_a_peak_shorter_than_the_limits_patience_does_not_count(encoded, trajectory):
    patient, impatient = (
        rehearse_motion(encoded, trajectory, AIRFRAME, replace(FLIGHT, patience=patience)).angular_velocity
        for patience in (FLIGHT.patience, 0.0)
    )
    peak = np.linalg.norm(fly_motion(encoded, trajectory, AIRFRAME).body_rate, axis=1).max()
    assert patient < impatient == pytest.approx(peak)


def test_a_vehicle_that_cannot_carry_itself_fails():
    weak = replace(AIRFRAME, motor_thrust_max=0.9 * AIRFRAME.hover_thrust)
    trajectory = slalom(weak, speed=0.5)
    run = dry_run(encode_trajectory(trajectory), trajectory, replace(LIMITS, airframe=weak))
    assert not run.passed
    assert run.saturation > 0.25
    assert run.settle_time == np.inf


def test_numbers_that_are_none_fail_it(encoded, trajectory):
    run = dry_run(encoded, trajectory, replace(LIMITS, airframe=replace(AIRFRAME, drag=(np.nan, np.nan))))
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
def test_the_same_bytes_fly_a_vehicle_a_little_different_otherwise(encoded, trajectory, other, told):
    airframe = replace(AIRFRAME, **{name: factor * getattr(AIRFRAME, name) for name, factor in other.items()})
    run = rehearse_motion(encoded, trajectory, airframe, FLIGHT, conditions=Conditions(**told))
    as_planned = rehearse_motion(encoded, trajectory, AIRFRAME, FLIGHT)
    assert run.passed
    assert run.deviation != as_planned.deviation
    if other.get("mass", 1.0) > 1.0:
        assert run.final_error > as_planned.final_error


@pytest.mark.parametrize("name", AIRFRAMES)
def test_every_airframe_flies_a_moderate_slalom(name):
    trajectory = slalom(AIRFRAMES[name], speed=1.5, acceleration=3.0)
    run = dry_run(encode_trajectory(trajectory), trajectory, replace(LIMITS, airframe=AIRFRAMES[name]))
    assert run.passed
    assert run.deviation_median < 0.05
