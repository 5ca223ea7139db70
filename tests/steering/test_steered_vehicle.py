"""A program steers the virtual vehicle on the stepped clock: what it asks for is flown, or refused in words."""

from dataclasses import replace

import numpy as np
import pytest
from slow_cases import slow_unless

import cfplan
from cfplan.air.requests import PathVerdict, Wish
from cfplan.air.stepped import PlannerFault
from cfplan.errors import (
    CfplanError,
    ExitCode,
    FlightEndedError,
    InfeasibleError,
    InputError,
    LinkError,
    PreflightError,
    RequestRefusedError,
)
from cfplan.flight.setpoints.encoding import RATE
from cfplan.recording.reader import read_record
from cfplan.safety.certificate import certify
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.steering.steered_vehicle import SteeredVehicle
from cfplan.steering.stepped_steering import SteppedSteering


@pytest.fixture
def connect(limits, tmp_path):
    """Connects to the virtual vehicle on a stepped clock; its records lie in a folder of the test."""
    return lambda **options: cfplan.connect("sim://0", stepped=True, safety=limits, records=tmp_path, **options)


@pytest.fixture
def flown(limits):
    """A vehicle in the air without a record, and the flight behind it."""
    flight = SteppedSteering(limits)
    with SteeredVehicle(flight, limits, uri="sim://0") as vehicle:
        vehicle.take_off(0.8)
        yield vehicle, flight


def test_the_readmes_example_flies_and_is_recorded(connect, limits):
    with connect() as vehicle:
        vehicle.take_off(0.8)
        assert vehicle.position[2] == pytest.approx(0.8, abs=0.05)
        first = vehicle.fly([[1, 0, 1], [0, 1, 1.2]])
        assert not vehicle.resting
        vehicle.extend([[-1, 0, 1]])
        vehicle.replace([[0, -1, 1.5], [1, 1, 1]])
        vehicle.wait()
        assert np.linalg.norm(np.subtract(vehicle.position, [1, 1, 1])) < 0.1
        vehicle.land()
    assert first.verdict is PathVerdict.ACCEPTED
    assert vehicle.outcome is not None
    assert vehicle.outcome.exit_code is ExitCode.OK
    assert vehicle.outcome.deviation.max < 0.1
    record = read_record(vehicle.record)
    assert record.requests.wish.tolist() == ["replace", "extend", "replace"]
    assert record.answers.verdict.tolist() == ["accepted"] * 3
    assert len(record.commitments.splice) > 4  # the hover, and each plan in parts
    assert sum("a new plan is flown" in text for text in record.events.text) == 3  # said once of each
    assert len(list(vehicle.record.glob("plan-*.parquet"))) == 3
    assert vehicle.summary["max_deviation"] < 0.1
    assert vehicle.summary["peak_speed"] > 1.0


def test_the_outcome_is_reported_even_if_the_summary_cannot_be_written(connect):
    with connect() as vehicle:
        vehicle.take_off(0.8)
        (vehicle.record / "summary.json").mkdir()
        vehicle.fly([[0.5, 0, 1]])
        vehicle.wait()
        vehicle.land()
    assert vehicle.outcome.exit_code is ExitCode.OK
    assert vehicle.summary["max_deviation"] < 0.1


def test_each_plan_goes_through_its_waypoints_without_a_stop_between(flown, limits):
    vehicle, flight = flown
    vehicle.fly([[1, 0, 1], [0, 1, 1.2]])
    vehicle.sleep(0.5)
    vehicle.extend([[-1, 0, 1]])
    timeline = flight.planner.timeline
    for trajectory in timeline.motion.trajectories[1:]:
        assert certify(trajectory, limits.plan, limits.space).passed
    states = timeline.motion.at(np.arange(0.0, timeline.ends, 1.0 / RATE))
    for waypoint in ([1, 0, 1], [0, 1, 1.2], [-1, 0, 1]):
        assert np.linalg.norm(states.position - waypoint, axis=1).min() < 0.03
    speeds = np.linalg.norm(states.velocity, axis=1)
    assert speeds[100:-100].min() > 0.3
    vehicle.wait()
    assert np.linalg.norm(np.subtract(vehicle.position, [-1, 0, 1])) < 0.1


@pytest.mark.parametrize(
    ("waypoints", "error", "words"),
    [
        ([[0, 0, 9]], RequestRefusedError, "7.200 m too far out"),
        ([["a", 1, 2]], InputError, "not numbers"),
        ([[np.nan, 0, 1]], InputError, "waypoint 1"),
        ([[1e300, 0, 1]], InputError, "waypoint 1"),
        ([[10**400, 0, 1]], InputError, "too large"),
        ([1, 2, 3], InputError, "rows of x, y, z"),
        ([], InputError, "rows of x, y, z"),
        (np.ones((1000, 3)), InputError, "at most 200"),
    ],
)
def test_what_cannot_be_flown_is_refused_in_words_and_the_flight_goes_on(flown, waypoints, error, words):
    vehicle, _ = flown
    vehicle.fly([[1, 0, 1]])
    with pytest.raises(error, match=words):
        vehicle.replace(waypoints)
    vehicle.wait()
    assert np.linalg.norm(np.subtract(vehicle.position, [1, 0, 1])) < 0.1
    vehicle.land()
    assert vehicle.outcome.exit_code is ExitCode.OK


def test_a_wish_of_another_type_is_refused_before_it_is_sent_and_its_text_is_accepted(flown):
    vehicle, _ = flown
    before = vehicle.request(Wish.SLOWER)
    for wish in ("dance", None, 7, ["stop"]):
        with pytest.raises(InputError, match="not a wish") as refused:
            vehicle.ask(wish, [[1, 0, 1]])
        assert "replace" in refused.value.hint
    assert vehicle.request("replace", [[1, 0, 1]]) == before + 1
    assert vehicle.ask("extend", [[0, 1, 1]]).verdict is PathVerdict.ACCEPTED
    with pytest.raises(RequestRefusedError):
        vehicle.ask("replace", [[0, 0, 9]])


def test_a_number_that_no_request_has_gets_no_answer_and_the_record_stays_readable(connect):
    with connect() as vehicle:
        vehicle.take_off(0.8)
        vehicle.fly([[1, 0, 1]])
        begun = vehicle.time
        for number in (77, "x", None, [1]):
            with pytest.raises(InputError, match="no request"):
                vehicle.answer_to(number)
        assert vehicle.time == begun
    assert read_record(vehicle.record).answers.verdict.tolist() == ["accepted"]


def test_a_request_to_go_where_it_is_is_accepted(flown):
    vehicle, _ = flown
    here = vehicle.position
    assert here != (0.0, 0.0, 0.8)
    for answer in (vehicle.fly([here]), vehicle.extend([here, here]), vehicle.replace([here, here])):
        assert answer.verdict is PathVerdict.ACCEPTED
    assert vehicle.wait(0.1)
    vehicle.land()
    assert vehicle.outcome.exit_code is ExitCode.OK


def test_the_same_target_ten_times_a_second_is_flown_like_a_target_asked_for_once(flown):
    vehicle, _ = flown
    begun = vehicle.time
    vehicle.fly([[1, 0, 1]])
    arrives = None
    for _ in range(60):
        asked = vehicle.time
        assert vehicle.fly([[1, 0, 1]]).verdict is PathVerdict.ACCEPTED
        arrives = arrives or (vehicle.time if vehicle.resting else None)
        vehicle.sleep(max(0.1 - (vehicle.time - asked), 0.0))
    assert arrives - begun < 2.5
    assert np.linalg.norm(np.subtract(vehicle.position, [1, 0, 1])) < 0.05


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("wish", [Wish.REPLACE, Wish.EXTEND])
def test_waypoints_that_repeat_the_one_before_count_once(flown, wish, moving):
    vehicle, flight = flown
    before = vehicle.position
    if moving:
        before = (1.0, 2.0, 1.0)
        vehicle.fly([before])
        vehicle.sleep(0.6)
    first = [before] if wish is Wish.EXTEND or not moving else []
    twice = [*first, [0.5, 0.5, 1], [0.5, 0.5, 1.004], [-0.5, 0.5, 1], [-0.5, 0.5, 1]]
    assert vehicle.ask(wish, twice).verdict is PathVerdict.ACCEPTED
    assert len(flight.planner.timeline.ahead) == (3 if moving and wish is Wish.EXTEND else 2)
    vehicle.wait()
    assert np.linalg.norm(np.subtract(vehicle.position, [-0.5, 0.5, 1])) < 0.05


def test_a_vehicle_asked_to_rest_where_it_passes_comes_back_there(flown):
    vehicle, flight = flown
    vehicle.fly([[1, 0, 1], [1, 2, 1]])
    vehicle.sleep(0.9)
    path = flight.planner.timeline.motion
    times = np.arange(0.0, path.duration, 0.01)
    now = times[np.argmin(np.linalg.norm(path.at(times).position - vehicle.position, axis=1))]
    place = path.at(now + 0.2).position
    assert vehicle.speed > 0.8
    assert vehicle.fly([place]).verdict is PathVerdict.ACCEPTED
    vehicle.wait()
    assert np.linalg.norm(np.subtract(vehicle.position, place)) < 0.05


def test_a_path_flown_already_is_left_for_a_shorter_one(flown):
    """A request for its last waypoint alone is a new one, without the waypoints before."""
    vehicle, _ = flown
    round_about = vehicle.fly([[1, 0, 1], [1, 2, 1], [0.3, 0.3, 1]])
    assert vehicle.fly([[1, 0, 1], [1, 2, 1], [0.3, 0.3, 1]]).splice < 0  # nothing new
    straight = vehicle.fly([[0.3, 0.3, 1]])
    assert straight.ends < round_about.ends - 1.0


def test_slower_counts_for_what_is_ahead_and_for_what_comes_until_faster_undoes_it(flown):
    vehicle, _ = flown
    vehicle.slower()
    vehicle.slower()
    slow = vehicle.fly([[1.5, 2.5, 1], [1.5, -2.5, 1]])
    speeds = []
    for _ in range(20):
        vehicle.sleep(0.2)
        speeds.append(vehicle.speed)
    assert 0.9 < max(speeds) < 1.14  # 0.75² of 2 m/s
    vehicle.faster()
    assert vehicle.faster().ends < slow.ends - 0.5


def test_a_stop_ends_soon_ahead_on_the_path(flown):
    vehicle, _ = flown
    vehicle.fly([[1.2, 1, 1], [0.5, 3, 1]])
    vehicle.sleep(0.8)
    begun = vehicle.time
    vehicle.stop()
    vehicle.wait()
    assert vehicle.time - begun < 2.0
    with pytest.raises(RequestRefusedError, match="cannot stop sooner"):
        vehicle.stop()


def test_the_latest_request_wins(flown):
    """Those that wait while the first is planned are superseded."""
    vehicle, _ = flown
    numbers = [vehicle.request(Wish.REPLACE, [[0.2 * k, 0.5, 1]]) for k in range(4)]
    vehicle.wait()
    verdicts = {answer.number: answer.verdict for answer in vehicle.answers()}
    first, last, waited = PathVerdict.ACCEPTED, PathVerdict.ACCEPTED, PathVerdict.SUPERSEDED
    assert [verdicts[number] for number in numbers] == [first, waited, waited, last]
    assert np.linalg.norm(np.subtract(vehicle.position, [0.6, 0.5, 1])) < 0.05
    assert vehicle.answers() == []


@pytest.mark.parametrize("fault", slow_unless([PlannerFault.LATE], PlannerFault))
def test_whatever_is_wrong_with_the_planner_the_vehicle_flies_what_is_committed(flown, fault):
    vehicle, flight = flown
    vehicle.fly([[1, 0, 1], [0, 1, 1.2]])
    vehicle.sleep(1.0)  # until all of it is committed
    assert not flight.planner.timeline.unfinished
    flight.planner.fault = fault
    number = vehicle.request(Wish.REPLACE, [[-1, 0, 1]])
    vehicle.sleep(4.0)
    assert np.linalg.norm(np.subtract(vehicle.position, [0, 1, 1.2])) < 0.1
    assert all(answer.verdict is not PathVerdict.ACCEPTED for answer in vehicle.answers() if answer.number == number)


@pytest.mark.parametrize("fault", slow_unless([PlannerFault.GARBAGE, PlannerFault.STOPPED], PlannerFault))
def test_a_planner_that_fails_before_all_of_a_plan_is_committed_leaves_it_to_the_stop_behind_what_is(flown, fault):
    """It rests on the plan; where the planner can plan again, it goes on from there, or says that it will not.

    In a hover, which is the same at each setpoint, also a proposal for another joint is taken; then the planner does
    not know what is committed, and the vehicle rests at the end of that.
    """
    vehicle, flight = flown
    vehicle.fly([[1.5, 2.5, 1], [-1.5, 2.5, 1.2]])
    flown_to = flight.planner.timeline.motion
    flight.planner.fault = fault
    vehicle.sleep(1.6)
    flight.planner.fault = None if fault is not PlannerFault.KILLED else fault
    vehicle.sleep(5.0)
    path = flown_to.at(np.arange(0.0, flown_to.duration, 0.01)).position
    assert np.linalg.norm(path - vehicle.position, axis=1).min() < 0.1
    told = [answer for answer in vehicle.answers() if answer.verdict is PathVerdict.CUT_SHORT]
    arrived = np.linalg.norm(np.subtract(vehicle.position, [-1.5, 2.5, 1.2])) < 0.1
    assert len(told) == (fault is PlannerFault.GARBAGE)
    assert arrived == (fault in (PlannerFault.STOPPED, PlannerFault.LATE))
    vehicle.land()
    assert vehicle.outcome.exit_code is ExitCode.OK


def test_a_program_that_fails_leaves_its_vehicle_landed_and_disarmed(limits):
    flight = SteppedSteering(limits)

    def program() -> None:
        with vehicle:
            vehicle.take_off()
            vehicle.fly([[1, 0, 1]])
            vehicle.sleep(0.5)
            raise ZeroDivisionError

    vehicle = SteeredVehicle(flight, limits, uri="sim://0")
    with pytest.raises(ZeroDivisionError):
        program()
    assert vehicle.outcome.exit_code is ExitCode.ENDED_BY_OPERATOR
    assert flight.lab.truth().position[-1, 2] < 0.05
    assert not flight.lab.truth().motor[-1].any()


def test_a_block_that_ends_in_flight_flies_on_to_its_end_and_lands(limits):
    with SteeredVehicle(SteppedSteering(limits), limits, uri="sim://0") as vehicle:
        vehicle.take_off()
        vehicle.fly([[1, 0, 1]])
    assert vehicle.outcome.exit_code is ExitCode.OK
    assert np.linalg.norm(np.subtract(vehicle.outcome.end_position[:2], [1, 0])) < 0.15


def test_landing_in_motion_stops_along_the_path(flown):
    vehicle, flight = flown
    vehicle.fly([[0, 2.5, 1]])
    vehicle.sleep(0.6)
    vehicle.land()
    assert 0.2 < flight.lab.truth().position[-1, 1] < 2.2
    with pytest.raises(FlightEndedError):
        vehicle.fly([[0, 0, 1]])


def test_a_take_off_that_cannot_be_is_refused_and_nothing_is_armed(limits):
    for height in (1.9, 0.0, np.nan, "high", [0.8], [0.8, 0.8], 10**400):
        flight = SteppedSteering(limits)
        with SteeredVehicle(flight, limits, uri="sim://0") as vehicle, pytest.raises((InfeasibleError, InputError)):
            vehicle.take_off(height)
        assert vehicle.outcome is None


@pytest.mark.slow
def test_a_take_off_that_takes_too_long_has_landed_when_it_raises(limits):
    slow = replace(limits, ground=replace(limits.ground, take_off_speed=0.004))
    flight = SteppedSteering(slow)
    with SteeredVehicle(flight, slow, uri="sim://0") as vehicle:
        with pytest.raises(PreflightError, match="did not hover"):
            vehicle.take_off(0.8)
        assert flight.lab.truth().position[:, 2].max() > 0.2
        assert vehicle.outcome is not None
        assert not flight.lab.truth().motor[-1].any()


@pytest.mark.slow
def test_landing_raises_if_the_flight_does_not_end(flown, monkeypatch):
    vehicle, flight = flown
    monkeypatch.setattr(flight, "order", lambda _: None)
    with pytest.raises(LinkError, match="not ended"):
        vehicle.land()
    monkeypatch.undo()


def test_a_vehicle_that_was_cut_does_not_take_off(limits):
    flight = SteppedSteering(limits)
    with SteeredVehicle(flight, limits, uri="sim://0") as vehicle:
        vehicle.cut()
        with pytest.raises(FlightEndedError, match="cut"):
            vehicle.take_off()
    assert not flight.lab.truth().motor.any()


def test_a_failed_preflight_check_is_said_in_words(limits):
    old = VehicleSettings(protocol=10, firmware="2025.09")
    with SteeredVehicle(SteppedSteering(limits, vehicle=old), limits, uri="sim://0") as vehicle:
        with pytest.raises(InputError, match="take_off"):
            vehicle.fly([[0, 0, 1]])
        with pytest.raises(FlightEndedError, match="firmware") as refused:
            vehicle.take_off()
    assert refused.value.exit_code is ExitCode.PREFLIGHT
    assert refused.value.hint


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"uri": "sim//0"}, "hint"),
        ({"uri": "radio://0/80/2M/E7E7E7E7E7", "stepped": True, "mocap": "vicon://1.2.3.4/cf1"}, "stepped"),
        ({"uri": "udp://127.0.0.1:1"}, "poses"),
        ({"safety": "nowhere.yaml"}, "nowhere.yaml"),
    ],
)
def test_wrong_arguments_are_refused_with_place_and_hint(options, words):
    with pytest.raises(CfplanError) as refused:
        cfplan.connect(**options)
    assert words in str(refused.value)
    assert refused.value.hint
