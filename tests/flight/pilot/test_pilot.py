"""The pilot's decisions, on a clock of their own: what it does when, and what it never does."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest

from cfplan.errors import ExitCode, InputError
from cfplan.flight.pilot.keys import Order
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.telemetry import Phase, SetpointSent
from cfplan.safety.limits import Ladder


def test_a_flight_goes_through_every_phase_in_order_and_ends_disarmed(world, fly):
    outcome = fly()
    assert outcome.exit_code is ExitCode.OK
    assert world.phases == [phase for phase in Phase if phase is not Phase.UPLOAD]
    assert world.calls[0] == "release"
    assert world.calls[-4:-1] == ["disarm", "close", "restart"]
    assert world.position[2] < 0.05
    assert world.motors_off_in_the_air == 0.0


def test_each_setpoint_is_sent_when_it_is_due(world, mission, fly):
    outcome = fly()
    sent = [message for message in world.messages if isinstance(message, SetpointSent)]
    plan = [message for message in sent if message.time < outcome.first_setpoint + mission.duration + 1e-6]
    assert [message.index for message in plan] == list(range(len(mission.payloads)))
    assert outcome.lateness.max < 1e-9
    assert outcome.lateness.skipped == 0


def test_motors_stop_by_stop_setpoints_on_the_floor_and_the_vehicle_counts_its_own_again(world, fly):
    fly()
    flown = world.calls[world.calls.index("arm") :]
    assert flown == ["arm", "preflight logs off", "stop setpoint", "release", "disarm", "close", "restart", "close"]


def test_stop_setpoints_that_the_radio_swallows_are_sent_again(world, fly):
    world.stops_lost = 5
    assert fly().exit_code is ExitCode.OK
    assert world.calls.count("stop setpoint") == 2
    assert not world.motors_on


def test_good_poses_are_forwarded_while_the_stream_runs(world, fly):
    outcome = fly()
    during = [place for place in world.forwarded if 0.0 < place[0] - outcome.first_setpoint < 2.0]
    assert len(during) > 190
    assert all(later[1] > place[1] for place, later in pairwise(during[20:151]))


def test_a_late_tick_carries_the_setpoint_of_its_moment(world, mission, fly):
    world.when(Phase.STREAM, 0.5, lambda: world.clock.stall(0.05))
    outcome = fly()
    sent = [message for message in world.messages if isinstance(message, SetpointSent)]
    assert outcome.exit_code is ExitCode.OK
    assert outcome.lateness.max == pytest.approx(0.05, abs=0.01)
    assert outcome.lateness.skipped >= 3
    for message in sent[:190]:
        assert message.index == pytest.approx((message.time - outcome.first_setpoint) * 100, abs=0.51)


@pytest.mark.parametrize(("stall", "rung"), [(0.1, Rung.NONE), (0.3, Rung.BRAKE), (0.7, Rung.LAND)])
def test_a_computer_that_stands_still_within_a_tick_is_noticed_as_in_its_sleep(world, fly, stall, rung):
    poses = world.poses

    def slow():
        world.poses = poses
        world.clock.reach(world.now + stall)
        return poses()

    world.when(Phase.STREAM, 0.3, lambda: setattr(world, "poses", slow))
    outcome = fly()
    assert outcome.rung is rung
    assert world.position[2] < 0.05
    assert not world.armed


def stop_poses(world):
    world.poses_stopped = True


def freeze_poses(world):
    world.poses_frozen = True


def shift_poses(world):
    world.pose_shift = (1.0, 0.0, 0.0)


def break_poses(world):
    world.pose_shift = (math.nan, 0.0, 0.0)


def blow_away(world):
    world.push = 3.5


def blow_aside(world):
    world.push = 2.0


def drain(world):
    world.voltage = 2.9


def silence(world):
    world.estimate_silent = world.status_silent = True


def lock(world):
    world.extra_bits = 1 << 6


def land(world):
    world.orders.worst = Order.LAND


def cut(world):
    world.orders.worst = Order.CUT


def lose_main(world):
    world.orders.gone = True


SAFETY, PILOT = ExitCode.ENDED_BY_SAFETY, ExitCode.ENDED_BY_OPERATOR


@pytest.mark.parametrize(
    ("fault", "rung", "exit_code", "text"),
    [
        (stop_poses, Rung.LAND, SAFETY, "pose is"),
        (freeze_poses, Rung.LAND, SAFETY, "pose is"),
        (break_poses, Rung.LAND, SAFETY, "pose is"),
        (shift_poses, Rung.LAND, SAFETY, "pose is"),
        (blow_aside, Rung.CUT, SAFETY, "from the setpoint"),
        (drain, Rung.LAND, SAFETY, "battery"),
        (silence, Rung.LAND, SAFETY, "silent"),
        (lock, Rung.CUT, SAFETY, "locked"),
        (land, Rung.LAND, PILOT, "operator"),
        (cut, Rung.CUT, PILOT, "operator"),
        (lose_main, Rung.LAND, SAFETY, "main process"),
    ],
)
@pytest.mark.parametrize("after", [0.5, 1.0])
def test_a_fault_in_the_stream_takes_its_rung(world, fly, fault, rung, exit_code, text, after):
    world.when(Phase.STREAM, after, lambda: fault(world))
    outcome = fly()
    assert outcome.exit_code is exit_code
    assert outcome.rung is rung
    assert text in outcome.reason
    assert bool(outcome.hint) is (fault is not land)  # the operator's landing needs no cure
    assert world.closed
    assert not world.armed
    if rung is Rung.CUT:
        assert "emergency stop" in world.calls
    else:
        assert world.position[2] < 0.05
        assert world.motors_off_in_the_air == 0.0
        assert "emergency stop" not in world.calls


def test_a_dropout_of_poses_brakes_on_the_path_before_it_lands(world, fly):
    world.when(Phase.STREAM, 1.0, lambda: setattr(world, "poses_stopped", True))
    world.when(Phase.STREAM, 1.3, lambda: setattr(world, "poses_stopped", False))
    outcome = fly()
    assert outcome.rung is Rung.BRAKE
    assert abs(world.position[0]) < 1.0
    assert world.position[1] == pytest.approx(0.0, abs=1e-3)
    assert world.position[2] < 0.05


def test_poses_that_come_back_within_the_limit_change_nothing(world, fly):
    world.when(Phase.STREAM, 1.0, lambda: setattr(world, "poses_stopped", True))
    world.when(Phase.STREAM, 1.1, lambda: setattr(world, "poses_stopped", False))
    assert fly().exit_code is ExitCode.OK


def test_no_pose_of_a_frozen_source_is_forwarded(world, fly):
    world.when(Phase.STREAM, 1.0, lambda: freeze_poses(world))
    outcome = fly()
    frozen_from = outcome.first_setpoint + 1.03
    assert "pose: frozen" in world.said
    assert not [place for place in world.forwarded if place[0] > frozen_from]


@pytest.mark.parametrize("phase", [Phase.TAKE_OFF, Phase.GO_TO_START, Phase.HOLD, Phase.LAND])
@pytest.mark.parametrize("after", [0.0, 0.01, 0.02, 0.7])
def test_the_operator_can_land_at_any_time_in_the_air(world, fly, phase, after):
    if phase is Phase.TAKE_OFF and after == 0.0:
        after = 0.005  # before that it is still on the ground
    world.when(phase, after, lambda: land(world))
    outcome = fly()
    assert outcome.exit_code is ExitCode.ENDED_BY_OPERATOR
    assert world.position[2] < 0.05
    assert world.motors_off_in_the_air == 0.0
    assert not world.armed


@pytest.mark.parametrize("phase", [Phase.FEED, Phase.CONVERGE, Phase.PREFLIGHT, Phase.ARM])
def test_an_order_on_the_ground_ends_it_there(world, fly, phase):
    world.when(phase, 0.0, lambda: land(world))
    outcome = fly()
    assert outcome.exit_code is ExitCode.ENDED_BY_OPERATOR
    assert world.position[2] == world.floor
    assert world.closed


def test_a_cut_while_landing_is_still_obeyed(world, fly):
    world.when(Phase.STREAM, 1.0, lambda: land(world))
    world.when(Phase.LAND, 0.5, lambda: cut(world))
    outcome = fly()
    assert outcome.rung is Rung.CUT
    assert "emergency stop" in world.calls


def test_an_order_to_arm_or_disarm_that_the_radio_swallows_is_sent_again(world, fly):
    world.arms_lost = 1
    world.when(Phase.LAND, 0.0, lambda: setattr(world, "arms_lost", 1))
    assert fly().exit_code is ExitCode.OK
    assert world.calls.count("arm") == 2
    assert world.calls.count("disarm") == 2
    assert not world.armed


def test_a_status_from_before_the_order_does_not_confirm_disarming(world, fly):
    """As if the vehicle had been armed so lately that its newest status does not show it yet."""

    def show_unarmed() -> None:
        world.status = replace(world.status, time=world.now, supervisor=0)
        world.status_silent = True
        world.clock.at(world.now + 0.03, lambda: setattr(world, "status_silent", False))

    world.when(Phase.LAND, 0.0, lambda: setattr(world, "arms_lost", 1))
    world.when(Phase.DISARM, 0.0, show_unarmed)
    assert fly().exit_code is ExitCode.OK
    assert world.calls.count("disarm") == 2
    assert not world.armed


def test_a_cut_is_sent_until_the_vehicle_says_that_it_is_locked(world, fly):
    world.cuts_lost = 20
    world.when(Phase.STREAM, 1.0, lambda: cut(world))
    outcome = fly()
    assert outcome.rung is Rung.CUT
    assert world.calls.count("emergency stop") > 20
    assert world.stopped
    assert "does not say" not in world.said


def test_a_cut_that_never_arrives_is_said(world, fly):
    world.cuts_lost = 10_000
    world.when(Phase.STREAM, 1.0, lambda: cut(world))
    assert fly().rung is Rung.CUT
    assert "the vehicle does not confirm that its motors were cut" in world.said


def test_a_tracked_body_that_is_another_one_keeps_the_vehicle_on_the_floor(world, fly):
    world.other_body = True
    outcome = fly()
    assert outcome.exit_code is ExitCode.PREFLIGHT
    assert "stays on the floor" in outcome.reason
    assert "swapped" in outcome.reason
    assert world.position[2] < 0.2
    assert "stop setpoint" in world.calls
    assert "emergency stop" not in world.calls
    assert not world.armed
    assert world.closed


@pytest.mark.parametrize("phase", [Phase.TAKE_OFF, Phase.STREAM, Phase.LAND])
def test_a_lost_link_is_reported_and_nothing_is_closed_in_the_air(world, fly, phase):
    world.when(phase, 0.5, lambda: setattr(world, "lost", "too many packets lost"))
    outcome = fly()
    assert outcome.exit_code is ExitCode.LINK_LOST
    assert "too many packets lost" in outcome.reason
    assert "antenna" in outcome.hint
    assert not [call for call in world.calls if call in ("disarm", "emergency stop")]


def test_a_failed_check_leaves_the_vehicle_disarmed(world, fly):
    world.voltage = 3.7
    outcome = fly()
    assert outcome.exit_code is ExitCode.PREFLIGHT
    assert "battery at rest: 3.70 V" in outcome.reason
    assert "arm" not in world.calls
    assert world.closed
    assert [check.name for check in outcome.checks if not check.passed] == ["battery at rest"]


def test_a_parameter_that_the_vehicle_changes_back_fails_preflight(world, fly):
    world.stubborn["stabilizer.controller"] = 1
    outcome = fly()
    assert outcome.exit_code is ExitCode.PREFLIGHT
    assert "stabilizer.controller: 1, must be 2" in outcome.reason


def test_the_vehicle_is_told_of_its_drag_where_it_has_a_place_for_it(world, fly):
    fly()
    assert world.parameters["kalman.dragB_x"] > 0.1


def test_older_firmware_flies_without_it_and_that_is_said(world, fly):
    world.unknown = ("kalman.dragB_x", "kalman.dragB_y")
    assert fly().exit_code is ExitCode.OK
    assert "kalman.dragB_x" not in world.parameters
    assert "no kalman.dragB_x" in world.said


@pytest.mark.parametrize(
    ("refuse", "text"),
    [
        (lambda world: setattr(world, "can_fly", False), "it is armed and not ready to fly"),
        (lambda world: setattr(world, "armed", False), "it is no longer armed"),
        (lambda world: vars(world).update(can_fly=False, extra_bits=1 << 5), "it tumbled"),
    ],
)
def test_a_vehicle_that_may_not_fly_gets_no_setpoint(world, fly, refuse, text):
    world.when(Phase.ARM, 0.1, lambda: refuse(world))
    outcome = fly()
    assert outcome.exit_code is ExitCode.PREFLIGHT
    assert f"may not take off: {text}" in outcome.reason
    assert world.position[2] == world.floor
    assert not world.motors_on
    assert world.calls[-3:-1] == ["disarm", "close"]


def test_a_vehicle_that_ignores_setpoints_is_disarmed(world, fly):
    world.deaf = True
    outcome = fly()
    assert outcome.exit_code is ExitCode.PREFLIGHT
    assert "does not start its motors" in outcome.reason
    assert not world.armed
    assert world.closed


@pytest.mark.parametrize("floor", [0.3, 0.1, -0.1, -0.25])
def test_a_floor_that_is_higher_or_lower_than_believed_stops_the_motors_where_it_is(world, fly, floor):
    world.when(Phase.HOLD, 0.0, lambda: setattr(world, "floor", floor))
    outcome = fly()
    assert outcome.exit_code is ExitCode.OK
    assert outcome.rung is Rung.NONE
    assert world.position[2] == pytest.approx(floor)
    assert world.motors_off_in_the_air == 0.0


def test_where_no_floor_comes_the_motors_stop_a_little_below_it(world, fly):
    world.when(Phase.HOLD, 0.0, lambda: setattr(world, "floor", -10.0))
    outcome = fly()
    assert outcome.exit_code is ExitCode.OK
    assert "touchdown is not confirmed" in world.said
    assert world.position[2] == pytest.approx(-0.3, abs=0.01)


def test_landing_is_gentle_and_touches_the_floor_slowly(world, fly):
    begun = dict(fly().phases)[Phase.LAND]
    sent = [each for each in world.messages if isinstance(each, SetpointSent) and each.time > begun]
    assert max(-each.velocity[2] for each in sent) <= 1.5 * 0.4 + 1e-3
    assert -next(each for each in sent if each.position[2] < world.floor).velocity[2] == pytest.approx(0.1, abs=0.01)
    assert max(abs(each.acceleration[2]) for each in sent) < 1.0
    assert all(each.velocity[:2] == (0.0, 0.0) and each.body_rate == (0.0, 0.0, 0.0) for each in sent)


def test_poses_that_go_in_landing_make_it_quick_and_those_that_come_back_gentle(world, fly):
    world.when(Phase.LAND, 0.3, lambda: stop_poses(world))
    world.when(Phase.LAND, 1.05, lambda: setattr(world, "poses_stopped", False))
    outcome = fly()
    begun = dict(outcome.phases)[Phase.LAND]
    sent = [(each.time - begun, -each.velocity[2]) for each in world.messages if isinstance(each, SetpointSent)]
    assert max(speed for time, speed in sent if 0.0 < time < 0.7) <= 0.6 + 1e-3
    assert max(speed for time, speed in sent if 0.8 < time < 1.1) > 1.0
    assert max(speed for time, speed in sent if time > 1.7) <= 0.6 + 1e-3
    assert outcome.rung is Rung.LAND
    assert world.motors_off_in_the_air == 0.0


def test_without_poses_the_motors_stop_where_the_vehicle_believes_itself_beneath_the_floor(world, fly):
    standing = world.floor
    world.when(Phase.HOLD, 0.0, lambda: setattr(world, "floor", -10.0))
    world.when(Phase.HOLD, 0.0, lambda: stop_poses(world))
    assert fly().rung is Rung.LAND
    assert -0.05 < world.position[2] - (standing - 0.3) < 0.0


def test_without_poses_and_estimates_the_motors_stop_where_the_setpoint_is_beneath_the_floor(world, fly):
    """One that stands, blind and unheard, believes itself lower and lower, and would fly off."""
    standing = world.floor
    world.when(Phase.HOLD, 0.0, lambda: setattr(world, "estimate_silent", True))
    world.when(Phase.HOLD, 0.0, lambda: setattr(world, "floor", -10.0))
    world.when(Phase.HOLD, 0.0, lambda: stop_poses(world))
    outcome = fly()
    assert outcome.rung is Rung.LAND
    assert -0.05 < world.position[2] - (standing - 0.3) < 0.0
    assert world.motors_off_since - dict(outcome.phases)[Phase.HOLD] < 3.0


@pytest.mark.parametrize("mission", [6.0], indirect=True)
def test_without_poses_the_motors_stop_after_three_seconds_at_any_height(world, fly, mission):
    world.when(Phase.HOLD, 0.0, lambda: stop_poses(world))
    world.parameters["kalman.maxPos"] = 10.0
    outcome = fly(space=replace(mission.limits.space, high=(3.0, 3.0, 8.0)))
    assert outcome.rung is Rung.LAND
    assert "touchdown is not confirmed" in world.said
    assert world.motors_off_since - dict(outcome.phases)[Phase.HOLD] == pytest.approx(3.0, abs=0.05)
    assert world.position[2] > 1.0


def test_a_pose_from_before_a_stream_is_not_judged_by_it(world, fly):
    world.when(Phase.GO_TO_START, 0.05, lambda: stop_poses(world))
    outcome = fly()
    assert outcome.rung is Rung.LAND
    assert "from the setpoint" not in outcome.reason


@pytest.mark.parametrize(
    ("silent", "moment", "said"),
    [
        ("poses_stopped", 0.0, "may not take off: poses gone"),
        ("estimate_silent", 0.1, "may not take off: estimate gone"),
        ("status_silent", 0.1, "does not report its status"),
    ],
)
def test_a_vehicle_that_is_armed_does_not_take_off_once_a_source_is_gone(world, fly, silent, moment, said):
    world.when(Phase.ARM, moment, lambda: setattr(world, silent, True))
    outcome = fly()
    assert outcome.exit_code is ExitCode.PREFLIGHT
    assert said in outcome.reason
    assert not world.sent()
    assert not world.armed


def test_a_source_without_poses_is_an_error_with_a_hint(world, fly):
    world.poses_stopped = True
    with pytest.raises(InputError, match="no pose comes") as caught:
        fly()
    assert caught.value.hint
    assert world.closed


def test_a_fault_of_the_program_itself_lands(world, fly):
    def fault():
        raise ZeroDivisionError("invented")

    world.when(Phase.STREAM, 1.0, fault)
    outcome = fly()
    assert outcome.exit_code is ExitCode.ENDED_BY_SAFETY
    assert "invented" in outcome.reason
    assert world.position[2] < 0.05


def test_an_error_that_cfplan_raises_in_the_air_lands_too(world, fly):
    def fault():
        raise InputError("invented", where="flight", hint="none")

    world.when(Phase.STREAM, 1.0, fault)
    outcome = fly()
    assert (outcome.exit_code, outcome.rung) == (ExitCode.ENDED_BY_SAFETY, Rung.LAND)
    assert world.position[2] < 0.05
    assert not world.armed


@pytest.mark.parametrize("broken", ["keep_alive", "poses", "send_pose", "recreate_log"])
@pytest.mark.parametrize("phase", [Phase.TAKE_OFF, Phase.STREAM, Phase.LAND])
def test_a_lasting_fault_in_a_step_of_the_tick_lands_and_does_not_cut(world, fly, broken, phase):
    def fail(*_):
        raise ZeroDivisionError("invented")

    if broken == "recreate_log":
        world.when(phase, 0.3, lambda: setattr(world, "status_silent", True))
    world.when(phase, 0.3, lambda: setattr(world, broken, fail))
    outcome = fly()
    assert (outcome.exit_code, outcome.rung) == (ExitCode.ENDED_BY_SAFETY, Rung.LAND)
    assert "emergency stop" not in world.calls
    assert world.position[2] < 0.05
    assert not world.armed


def test_a_fault_of_pose_handling_counts_as_no_pose(world, fly):
    whole, failing = world.poses, []

    def fail():
        if len(failing) < 8:
            failing.append(world.now)
            raise ZeroDivisionError("invented")
        return whole()

    world.when(Phase.STREAM, 1.0, lambda: setattr(world, "poses", fail))
    assert fly().exit_code is ExitCode.OK  # 0.08 s without poses
    assert "invented" in world.said


def test_leaving_the_room_beyond_the_last_line_cuts(world, limits, fly):
    world.when(Phase.HOLD, 0.2, lambda: blow_away(world))
    outcome = fly(flight=replace(limits.flight, deviation=Ladder(9.0, 9.0, 9.0)))
    assert outcome.rung is Rung.CUT
    assert "fence" in outcome.reason


def test_the_watchdog_of_the_vehicle_sleeps_where_it_is_not_wanted(world, mission, fly):
    fly(firmware=replace(mission.limits.firmware, watchdog=False))
    assert not world.signs_of_life
    assert "restart" not in world.calls


def test_the_watchdog_gets_ten_signs_of_life_a_second_from_take_off_to_the_end_of_the_link(world, fly):
    outcome = fly()
    phases = dict(outcome.phases)
    assert phases[Phase.TAKE_OFF] <= min(world.signs_of_life) < phases[Phase.TAKE_OFF] + 0.5
    assert max(b - a for a, b in pairwise(world.signs_of_life)) < 0.15
    assert max(world.signs_of_life) > phases[Phase.DISARM] - 0.15


def test_a_vehicle_whose_motors_were_cut_stays_locked(world, fly):
    world.when(Phase.STREAM, 0.5, lambda: setattr(world.orders, "worst", Order.CUT))
    assert fly().rung is Rung.CUT
    assert "restart" not in world.calls


def test_a_vehicle_that_never_took_off_is_not_restarted(world, fly):
    world.can_fly = False
    assert fly().exit_code is ExitCode.PREFLIGHT
    assert "restart" not in world.calls


def test_a_restart_that_fails_is_said_and_the_flight_counts(world, fly):
    world.restarts = False
    assert fly().exit_code is ExitCode.OK
    assert "switch it off and on" in world.said
