"""A flight's numbers, against flights of which they are known."""

import dataclasses
import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from cfplan.flight.setpoints.encoding import encode_trajectory
from cfplan.geometry.min_snap import min_snap
from cfplan.recording import record as columns
from cfplan.recording.path_distance import BLOCK, distance_to_path
from cfplan.recording.reader import read_record
from cfplan.recording.record import Record
from cfplan.recording.rerun.states import supervisor_states
from cfplan.recording.summary import (
    SETTLED,
    deviation,
    dropouts,
    finished,
    pose_gaps,
    settling,
    shares,
    summarise,
    summary_text,
)
from cfplan.recording.writer import RecordWriter
from cfplan.vehicle.airframes import AIRFRAMES
from cfplan.vehicle.correction import PlanCorrection, corrected
from cfplan.vehicle.trajectory import Trajectory

BEGIN, HELD = 100.0, 2.0  # s
LEAD, MOVING = 0.005, 4.0  # s by which setpoints are sent ahead of the plan, and for which it moves
TRAVEL = LEAD + MOVING  # s, planned: it begins with a rest, so that it is straight between setpoints
SPEED = 0.5  # m/s, along x


def straight_flight(
    header, *, lag=0.0, aside=0.0, end_error=lambda t: 0.0 * t, sent_until=math.inf, hover=0.0
) -> Record:
    """A flight along x at SPEED, its end held; poses lag behind by `lag` s, fly `aside` m in y, and end off in z."""
    due = np.arange(BEGIN, min(BEGIN + TRAVEL + HELD + 1e-9, sent_until), 0.01)
    where = np.clip(due - BEGIN, 0, MOVING) * SPEED
    zeros = np.zeros_like(due)
    time = np.arange(BEGIN - 1, BEGIN + TRAVEL + HELD, 0.005) + 0.0012
    flown = np.clip(time - LEAD - BEGIN - lag, 0, MOVING) * SPEED
    after = np.where(time >= BEGIN + TRAVEL, end_error(time - BEGIN - TRAVEL), 0.0)
    still = np.tile([0.0, 0.0, 0.0, 1.0], (len(due), 1))
    last = BEGIN + TRAVEL + hover + 0.005  # s, when the pilot goes from streaming to holding
    return Record(
        folder=None,
        header=dataclasses.replace(
            header, travel_time=TRAVEL, path=np.array([[0.0, 0.0, 1.0], [TRAVEL * SPEED, 0.0, 1.0]])
        ),
        setpoints=columns.Setpoints(
            due + 0.001, due, np.arange(len(due)), np.stack([where, zeros, zeros + 1], 1), np.zeros((len(due), 3)),
            np.zeros((len(due), 3)), still, np.zeros((len(due), 3)),
        ),
        poses=columns.Poses(
            time, time + 0.01, np.stack([flown, aside + 0 * time, 1 + after], 1),
            np.tile([0.0, 0.0, 0.0, 1.0], (len(time), 1)),
        ),
        estimates=columns.Estimates(
            due + LEAD, np.zeros((len(due), 3)), np.tile([0.3, 0.4, 0.0], (len(due), 1)), np.zeros((len(due), 3)), still
        ),
        status=columns.StatusReports(
            due, np.tile([1.0, 2.0, 2.0], (len(due), 1)), np.zeros((len(due), 4), int), 4.0 - 0.1 * (due - BEGIN),
            np.zeros(len(due), int),
        ),
        phases=columns.Phases(
            np.array([BEGIN - 0.5, BEGIN - 0.1, last, BEGIN + TRAVEL + HELD]),
            np.array(["arm", "stream", "hold", "land"]),
        ),
        events=columns.Events(np.empty(0), np.empty(0, str), np.empty(0, str)),
        summary={},
        truncated=False,
    )  # fmt: skip


@settings(deadline=None)
@given(lag=st.floats(0, 0.3), aside=st.floats(-0.5, 0.5))
def test_lag_counts_in_time_and_distance_aside_counts_in_both(flight, lag, aside):
    record = straight_flight(flight.header, lag=lag, aside=aside)
    summary = summarise(record)
    assert summary.max_deviation == pytest.approx(math.hypot(SPEED * lag, aside), abs=1e-9)
    assert summary.max_deviation_to_path == pytest.approx(abs(aside), abs=1e-9)
    assert summary.rms_deviation_to_path == pytest.approx(abs(aside), abs=1e-9)


def test_the_rms_is_that_of_a_known_deviation(flight):
    along = deviation(straight_flight(flight.header, lag=0.2), BEGIN + 1, BEGIN + 3)
    np.testing.assert_allclose(along.in_time, 0.1, atol=1e-9)
    assert summarise(straight_flight(flight.header, lag=0.2)).rms_deviation == pytest.approx(0.1, rel=0.03)


@pytest.mark.parametrize("shifted", [False, True], ids=["plain", "corrected"])
def test_a_vehicle_that_flies_its_plan_as_planned_does_not_deviate(flight, make_profile, shifted):
    """By the plan's own motion, and the packets that are sent for it: they round to 1 mm."""
    path = min_snap([[0, 0, 1], [1.5, 1, 1.4], [1, -1.5, 0.6], [-1, 0.5, 1.2]])
    plan = asked = Trajectory(path, make_profile(path.end, np.full(30, 1.5)), AIRFRAMES["crazyflie-2.1+"])
    assert np.linalg.norm(plan.at(np.linspace(0.0, plan.duration, 300)).velocity, axis=1).max() > 1.9
    if shifted:
        asked = corrected(plan, PlanCorrection(np.random.default_rng(1).normal(0.0, 0.05, (8, 3)), plan.duration))
    sent = encode_trajectory(asked)
    due = BEGIN + sent.times
    time = np.arange(BEGIN - 0.5, due[-1], 0.01) + 0.0037
    where = plan.at(np.clip(time - BEGIN, 0.0, plan.duration)).position
    made_up = straight_flight(flight.header)
    still = np.tile([0.0, 0.0, 0.0, 1.0], (len(time), 1))
    motion = sent.decoded
    record = dataclasses.replace(
        made_up,
        header=dataclasses.replace(
            flight.header, travel_time=plan.duration, path=path(np.linspace(0.0, path.end, 500)),
            shift=asked.at(sent.times + LEAD).position - plan.at(sent.times + LEAD).position if shifted else [],
        ),
        setpoints=columns.Setpoints(
            due + 0.001, due, np.arange(len(due)), motion.position, motion.velocity, motion.acceleration,
            motion.quaternion, motion.body_rate,
        ),
        poses=columns.Poses(time, time + 0.01, where, still),
        phases=columns.Phases(np.array([BEGIN - 0.1, due[-1] + 0.002]), np.array(["stream", "hold"])),
    )  # fmt: skip
    summary = summarise(record)
    assert summary.max_deviation < 0.0015
    assert summary.max_deviation_to_path < 0.001
    assert summary.travel_time_flown == pytest.approx(plan.duration, abs=0.005)


def test_a_perfect_flight_takes_its_planned_time(flight):
    summary = summarise(straight_flight(flight.header))
    assert (summary.travel_time_planned, summary.settling) == (TRAVEL, 0.0)
    assert summary.travel_time_flown == pytest.approx(TRAVEL, abs=1e-9)


@pytest.mark.parametrize("lag", [-0.02, 0.004, 0.05, 0.2])
def test_the_time_flown_is_measured_by_the_poses(flight, lag):
    summary = summarise(straight_flight(flight.header, lag=lag))
    assert summary.travel_time_planned == TRAVEL
    assert summary.travel_time_flown == pytest.approx(TRAVEL + lag, abs=1e-6)
    assert summary.settling == pytest.approx(max(lag - SETTLED / SPEED, 0.0), abs=1e-6)


def test_the_hover_streamed_behind_the_end_is_no_travel_time(flight):
    record = straight_flight(flight.header, hover=0.8, end_error=lambda t: np.where(t < 0.3, 0.08, 0.02))
    summary = summarise(record)
    assert summary.settling == pytest.approx(0.3, abs=0.006)
    assert summary.travel_time_flown == pytest.approx(TRAVEL + 0.3 + SETTLED / SPEED, abs=0.006)


@pytest.mark.parametrize("moment", [0.2, 0.75, 1.5])
def test_settling_lasts_until_the_vehicle_stays_near_the_end(flight, moment):
    record = straight_flight(flight.header, end_error=lambda t: np.where(t < moment, 0.08, 0.02))
    assert settling(record) == pytest.approx(moment, abs=0.006)
    assert summarise(record).travel_time_flown == pytest.approx(TRAVEL + moment + SETTLED / SPEED, abs=0.006)


def test_a_swing_back_outside_counts_as_not_yet_settled(flight):
    record = straight_flight(flight.header, end_error=lambda t: np.where((t > 1.0) & (t < 1.2), 0.08, 0.0))
    assert settling(record) == pytest.approx(1.2, abs=0.006)


def test_a_vehicle_that_never_settles_has_no_travel_time(flight):
    summary = summarise(straight_flight(flight.header, end_error=lambda t: 0.08 + 0 * t))
    assert math.isnan(summary.settling)
    assert math.isnan(summary.travel_time_flown)


def test_a_path_that_was_not_finished_has_no_travel_time(flight):
    summary = summarise(straight_flight(flight.header, sent_until=BEGIN + TRAVEL / 2))
    assert math.isnan(summary.travel_time_flown)
    assert summary.max_deviation == pytest.approx(0.0, abs=1e-9)


def test_a_stream_that_ends_where_packets_show_a_hover_flew_the_whole_plan(flight):
    """As on board: the last moment of a plan is slower than a packet can say."""
    assert finished(straight_flight(flight.header, sent_until=BEGIN + TRAVEL - 0.05))
    assert not finished(straight_flight(flight.header, sent_until=BEGIN + TRAVEL - 0.2))


def test_a_setpoint_sent_late_with_the_state_of_its_own_time_is_no_deviation(flight):
    record = straight_flight(flight.header)
    setpoints = record.setpoints
    time, position = setpoints.time.copy(), setpoints.position.copy()
    time[150], position[150] = setpoints.due[151] + 0.002, setpoints.position[151]
    late = dataclasses.replace(record, setpoints=dataclasses.replace(setpoints, time=time, position=position))
    assert summarise(late).max_deviation == pytest.approx(0.0, abs=1e-9)
    assert summarise(late).lateness_max == pytest.approx(0.012)


def test_a_stop_on_the_way_does_not_finish_the_path_however_long_it_takes(flight):
    record = straight_flight(flight.header)
    index = record.setpoints.index.copy()
    index[390:] -= 390  # the stop, encoded apart
    stopped = dataclasses.replace(record, setpoints=dataclasses.replace(record.setpoints, index=index))
    assert math.isnan(summarise(stopped).travel_time_flown)


def test_peaks_lateness_and_battery_are_those_of_the_streams(flight):
    summary = summarise(straight_flight(flight.header))
    assert summary.peak_speed == pytest.approx(0.5)
    assert summary.peak_body_rate == pytest.approx(3.0)
    assert summary.lateness_p50 == pytest.approx(0.001)
    assert summary.battery_start == pytest.approx(4.0)
    assert summary.battery_end == pytest.approx(4.0 - 0.1 * (MOVING + HELD))


@pytest.mark.parametrize(("lag", "share"), [(0.0, -0.05), (0.1, -0.05), (0.0, 0.02)])
def test_a_vehicle_that_believes_itself_slower_than_its_poses_are_says_so(flight, lag, share):
    record = straight_flight(flight.header, lag=lag)
    moving = (record.estimates.time > BEGIN + LEAD + lag) & (record.estimates.time < BEGIN + TRAVEL + lag)
    velocity = np.where(moving[:, None], [(1.0 + share) * SPEED, 0.0, 0.0], 0.0)
    believed = dataclasses.replace(record, estimates=dataclasses.replace(record.estimates, velocity=velocity))
    found = summarise(believed).estimated_speed
    assert found == pytest.approx(share, abs=0.002)
    assert f"| speed by the estimate, over that by poses | {100 * found:.1f} % |" in summary_text(believed)


def test_nothing_is_said_of_speed_where_nothing_moves(flight):
    record = straight_flight(flight.header)
    still = dataclasses.replace(record.poses, position=np.ones_like(record.poses.position))
    assert math.isnan(summarise(dataclasses.replace(record, poses=still)).estimated_speed)


def test_the_made_up_flight_shows_its_dropout_and_its_late_setpoint(flight):
    summary = summarise(flight.record)
    assert summary.pose_dropouts == 1
    assert summary.longest_pose_gap == pytest.approx(0.16)
    assert summary.lateness_max == pytest.approx(0.012)
    assert summary.lateness_p50 < 0.001 < summary.lateness_max
    reference_speed = np.max(np.linalg.norm(flight.record.setpoints.velocity, axis=1))
    assert summary.max_deviation == pytest.approx(0.02 * reference_speed, rel=0.15)  # it lags by 30 ms less 10 ms


def test_the_made_up_flight_lags_but_keeps_to_its_path(flight):
    summary = summarise(flight.record)
    assert summary.max_deviation_to_path < 0.006 < summary.max_deviation  # noise of 1 mm on each axis


@given(gap=st.integers(1, 40), place=st.integers(1, 150))
def test_a_gap_is_a_dropout_from_more_than_three_intervals_on(gap, place):
    times = np.arange(200) * 0.01
    kept = np.delete(times, slice(place, place + gap))
    assert len(dropouts(pose_gaps(kept))) == (1 if gap > 2 else 0)


@given(x=st.floats(-2, 2), y=st.floats(-2, 2))
def test_the_distance_to_a_path_is_that_of_a_numerical_search(x, y):
    angle = np.linspace(0, np.pi, 200)
    path = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)

    def gap(a):
        return math.dist((x, y), (math.cos(a), math.sin(a)))

    guess = min(angle, key=gap)
    found = minimize_scalar(gap, bounds=(max(0, guess - 0.1), min(np.pi, guess + 0.1)), options={"xatol": 1e-9})
    nearest = min(found.fun, gap(0), gap(np.pi))
    assert distance_to_path(np.array([[x, y, 0.0]]), path)[0] == pytest.approx(nearest, abs=5e-5)


def test_a_path_of_one_point_has_a_distance_too():
    assert distance_to_path(np.array([[3.0, 4.0, 0.0]]), np.zeros((1, 3)))[0] == pytest.approx(5.0)


@given(seed=st.integers(0, 10_000), corners=st.integers(1, 3 * BLOCK + 1))
def test_the_distance_to_a_tangled_path_is_that_to_its_nearest_segment(seed, corners):
    random = np.random.default_rng(seed)
    path, points = random.normal(size=(corners, 3)), random.normal(size=(20, 3))
    begin, step = path[:-1], np.diff(path, axis=0)
    share = np.clip(np.sum((points[:, None] - begin) * step, axis=2) / np.sum(step**2, axis=1), 0, 1)
    feet = np.concatenate([begin + share[..., None] * step, np.broadcast_to(path[-1:], (20, 1, 3))], axis=1)
    expected = np.linalg.norm(points[:, None] - feet, axis=2).min(axis=1)
    np.testing.assert_allclose(distance_to_path(points, path), expected, atol=1e-12)


def test_a_record_with_nothing_in_it_has_a_summary_of_unknowns(tmp_path, small_header):
    RecordWriter(tmp_path, small_header).close()
    record = read_record(tmp_path)
    values = summarise(record).to_json()
    assert values["max_deviation"] is None
    assert values["battery_end"] is None
    json.dumps(values, allow_nan=False)
    assert "–" in summary_text(record)


def test_the_text_says_that_a_record_was_cut(flight):
    assert "ends early" not in summary_text(flight.record)
    assert "ends early" in summary_text(dataclasses.replace(flight.record, truncated=True))


def test_the_supervisor_is_named_by_its_gravest_bit():
    bits = np.array([0, 0b1, 0b11, 0b11011, 0b1011011, 0b10000000, 0b100])
    wanted = ["not ready", "can be armed", "armed", "flying", "locked", "crashed", "not ready"]
    assert supervisor_states(bits).tolist() == wanted


def test_a_limit_of_zero_in_a_damaged_header_has_no_share(flight):
    """Found by fuzzing."""
    limits = dataclasses.replace(flight.header.plan_limits, speed=0.0)
    found = shares(summarise(flight.record), limits)
    assert math.isnan(found["peak_speed"])
    assert found["peak_body_rate"] > 0.0
