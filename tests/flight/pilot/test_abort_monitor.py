"""Each trigger at its threshold, and its rung."""

import math
from dataclasses import replace

import pytest

from cfplan.errors import ExitCode
from cfplan.flight.mocap.poses import Pose
from cfplan.flight.pilot.abort_monitor import AbortMonitor, Observation, ordered
from cfplan.flight.pilot.health import FRESH, GONE, LATE, Health
from cfplan.flight.pilot.keys import Order
from cfplan.flight.pilot.outcome import Deviation, Rung, settle_time
from cfplan.flight.telemetry import Estimate, VehicleStatus

LEVEL = (0.0, 0.0, 0.0, 1.0)
STILL = (0.0, 0.0, 0.0)
HERE = (0.0, 0.0, 1.0)


def observation(now=10.0, place=HERE, age=0.01, velocity=STILL, rate=STILL, voltage=3.9, bits=0, **changes):
    pose = Pose(now - age, now, place, LEVEL)
    estimate = Estimate(now, place, velocity, STILL, LEVEL)
    status = VehicleStatus(now, rate, (0, 0, 0, 0), voltage, bits)
    return Observation(now, pose=pose, estimate=estimate, status=status, **changes)


def rung(monitor, what):
    abort = monitor.gravest(what)
    return abort.rung if abort is not None else Rung.NONE


@pytest.fixture
def monitor(limits):
    return AbortMonitor(limits)


def test_a_good_flight_gives_no_reason(monitor):
    assert monitor.gravest(observation(setpoint_at_pose=HERE)) is None


@pytest.mark.parametrize(("poses", "expected"), [(FRESH, Rung.NONE), (LATE, Rung.BRAKE), (GONE, Rung.LAND)])
def test_old_poses_brake_and_then_land(monitor, poses, expected):
    assert rung(monitor, observation(age=0.3, health=Health(poses=poses))) is expected


def test_poses_that_stay_late_or_are_distrusted_are_named(monitor):
    late = monitor.gravest(observation(age=0.12, health=Health(poses=GONE)))
    assert "0.12 s late" in late.text
    distrusted = monitor.gravest(observation(health=Health(poses=GONE), pose_fault="another body"))
    assert "another body" in distrusted.text


@pytest.mark.parametrize("log", ["estimate", "status"])
def test_a_silent_log_lands_and_is_named(monitor, log):
    abort = monitor.gravest(observation(health=Health(**{log: GONE})))
    assert abort.rung is Rung.LAND
    assert log in abort.text


def test_the_last_values_of_a_log_that_is_gone_do_not_count(monitor):
    fast, turning, empty = (9.0, 0.0, 0.0), (0.0, 40.0, 0.0), 2.0
    for now in (10.0, 10.2, 15.0):
        seen = observation(now=now, velocity=fast, rate=turning, voltage=empty, bits=1 << 6)
        seen.estimate = seen.status = None
        assert rung(monitor, seen) is Rung.NONE


@pytest.mark.parametrize(
    ("height", "asked", "poses", "expected"),
    [
        (-0.01, 0.5, LATE, Rung.CUT),
        (-0.01, 0.5, FRESH, Rung.NONE),  # poses correct the estimate
        (0.01, 0.5, LATE, Rung.BRAKE),
        (-0.01, 0.1, LATE, Rung.BRAKE),  # it follows its setpoint
        (-0.2, -0.3, LATE, Rung.BRAKE),  # a landing without poses
    ],
)
def test_a_vehicle_that_fell_to_the_floor_without_poses_is_cut(monitor, height, asked, poses, expected):
    seen = observation(place=(0.0, 0.0, height), health=Health(poses=poses), setpoint_at_estimate=(0.0, 0.0, asked))
    assert rung(monitor, seen) is expected
    if expected is Rung.CUT:
        assert "on the floor without poses, 0.51 m below its setpoint" in monitor.gravest(seen).text


@pytest.mark.parametrize(
    ("off", "expected"), [(0.29, Rung.NONE), (0.31, Rung.BRAKE), (0.61, Rung.LAND), (1.01, Rung.CUT)]
)
def test_deviation_climbs_the_ladder(monitor, off, expected):
    assert rung(monitor, observation(setpoint_at_pose=(off, 0.0, 1.0))) is expected


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        ((2.79, 0.0, 1.0), Rung.NONE),
        ((2.85, 0.0, 1.0), Rung.BRAKE),
        ((0.0, -2.95, 1.0), Rung.LAND),
        ((0.0, 0.0, 2.4), Rung.CUT),
        ((0.0, 0.0, 0.02), Rung.NONE),
    ],
)
def test_the_fence_has_walls_and_a_ceiling_but_no_floor(monitor, place, expected):
    assert rung(monitor, observation(place=place)) is expected


def test_a_speed_counts_only_when_it_lasts(monitor):
    fast = (3.5, 0.0, 0.0)
    assert rung(monitor, observation(now=10.0, velocity=fast)) is Rung.NONE
    assert rung(monitor, observation(now=10.05, velocity=fast)) is Rung.NONE
    assert rung(monitor, observation(now=10.11, velocity=fast)) is Rung.BRAKE


def test_a_single_noisy_value_is_forgotten(monitor):
    fast = (3.5, 0.0, 0.0)
    assert rung(monitor, observation(now=10.0, velocity=fast)) is Rung.NONE
    assert rung(monitor, observation(now=10.05)) is Rung.NONE
    assert rung(monitor, observation(now=10.14, velocity=fast)) is Rung.NONE


def test_one_value_beyond_a_graver_threshold_is_no_reason_for_its_rung(monitor, limits):
    speed, patience = limits.flight.speed, limits.flight.patience
    for now in (10.0, 10.0 + 1.1 * patience):
        found = rung(monitor, observation(now=now, velocity=(speed.brake + 0.1, 0.0, 0.0)))
    assert found is Rung.BRAKE
    fast = (speed.cut + 0.1, 0.0, 0.0)
    assert rung(monitor, observation(now=10.0 + 1.2 * patience, velocity=fast)) is Rung.BRAKE
    assert rung(monitor, observation(now=10.0 + 2.3 * patience, velocity=fast)) is Rung.CUT


def test_a_noisy_value_that_is_the_last_of_its_log_for_a_while_is_no_reason(monitor, limits):
    noisy = observation(rate=(2.0 * limits.flight.angular_velocity.cut, 0.0, 0.0))
    for later in (0.0, 0.5, 1.0, 2.0):
        assert rung(monitor, replace(noisy, now=noisy.now + later * limits.flight.patience)) is Rung.NONE


def test_a_body_rate_beyond_the_limit_that_lasts_brakes(monitor):
    for now in (10.0, 10.06, 10.12):
        last = rung(monitor, observation(now=now, rate=(0.0, 12.0, 0.0)))
    assert last is Rung.BRAKE


@pytest.mark.parametrize("broken", [{"velocity": (math.nan, 0.0, 0.0)}, {"rate": (0.0, 0.0, math.nan)}])
def test_a_measurement_that_is_no_number_lands_when_it_lasts(monitor, broken):
    assert rung(monitor, observation(now=10.0, **broken)) is Rung.NONE
    assert rung(monitor, observation(now=10.2, **broken)) is Rung.LAND


def test_a_voltage_dip_is_averaged_away_and_an_empty_battery_is_not(monitor):
    for step in range(100):
        assert rung(monitor, observation(now=10.0 + step / 100)) is Rung.NONE
    for step in range(30):
        assert rung(monitor, observation(now=11.0 + step / 100, voltage=3.0)) is Rung.NONE
    for step in range(300):
        last = rung(monitor, observation(now=11.3 + step / 100, voltage=3.0))
    assert last is Rung.LAND


@pytest.mark.parametrize("bit", [5, 6, 7])
def test_a_vehicle_that_is_out_of_control_is_cut(monitor, bit):
    assert rung(monitor, observation(bits=1 << bit)) is Rung.CUT


def test_an_estimate_that_leaves_the_poses_brakes(monitor):
    what = observation()
    what.estimate = Estimate(10.0, (0.2, 0.0, 1.0), STILL, STILL, LEVEL)
    assert rung(monitor, what) is Rung.BRAKE


def test_a_setpoint_far_too_late_brakes(monitor):
    assert rung(monitor, observation(late=0.2)) is Rung.NONE
    assert rung(monitor, observation(late=0.3)) is Rung.BRAKE


def test_no_pose_at_all_lands(monitor):
    assert rung(monitor, Observation(10.0, health=Health(poses=GONE))) is Rung.LAND


def test_an_operator_command_and_the_loss_of_the_main_process_end_the_flight():
    assert ordered(Order.LAND, main_gone=True).exit_code is ExitCode.ENDED_BY_OPERATOR
    assert ordered(Order.CUT, main_gone=False).rung is Rung.CUT
    assert ordered(None, main_gone=True).rung is Rung.LAND
    assert ordered(None, main_gone=False) is None


def test_the_gravest_reason_wins(monitor):
    abort = monitor.gravest(observation(health=Health(poses=GONE), bits=1 << 6))
    assert abort.rung is Rung.CUT
    assert "locked" in abort.text


def test_deviation_is_summed_up():
    deviation = Deviation.of([(0.0, 0.3), (1.0, 0.4), (2.0, 0.0)])
    assert deviation.max == 0.4
    assert deviation.time_of_max == 1.0
    assert deviation.rms == pytest.approx(math.sqrt(0.25 / 3))


def test_settled_means_that_it_stays():
    assert settle_time([(0.1, 0.01), (0.2, 0.05), (0.3, 0.02), (0.4, 0.01)], within=0.03) == 0.3
    assert settle_time([(0.1, 0.01), (0.2, 0.05)], within=0.03) == math.inf
    assert settle_time([], within=0.03) == math.inf
