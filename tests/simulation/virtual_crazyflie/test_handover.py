"""Who commands: priorities, and the way between on-board flight and streaming without a moment of motors off."""

import struct

import pytest

from cfplan.flight.radio.crtp import Port
from cfplan.simulation.virtual_crazyflie.commander import Priority
from cfplan.simulation.virtual_crazyflie.high_level import PlannerState
from cfplan.simulation.virtual_crazyflie.supervisor import State

EBUSY, ENOEXEC, PLANNER_BUSY = 16, 8, 1
ZERO_ATTITUDE = struct.pack("<fffH", 0.0, 0.0, 0.0, 0)  # what cflib sends when it closes a link


def test_take_off_go_to_and_land_from_the_floor(rig):
    assert rig.take_off(0.8) == 0
    rig.run(2.0)
    assert rig.truth[2] == pytest.approx(0.8, abs=0.05)
    assert rig.go_to(0.6, -0.4, 1.1, yaw=0.5, duration=2.0) == 0
    rig.run(3.0)
    assert rig.truth[:3] == pytest.approx([0.6, -0.4, 1.1], abs=0.05)
    assert rig.land(duration=2.0) == 0
    rig.run(3.0)
    assert rig.truth[2] == 0.0
    rig.run(2.0)
    assert rig.state is State.LANDED
    assert rig.off_in_air == 0


def test_notify_before_go_to_leaves_a_gap_with_motors_off(streamed):
    before = streamed.off_in_air
    streamed.notify_setpoint_stop()
    streamed.run(0.03)
    assert streamed.go_to(*streamed.belief[:3]) == 0
    streamed.run(0.5)
    assert 10 <= streamed.off_in_air - before <= 40
    assert streamed.state is State.FLYING


def test_go_to_before_notify_leaves_none(streamed):
    before = streamed.off_in_air
    assert streamed.go_to(*streamed.belief[:3]) == 0
    streamed.notify_setpoint_stop()
    streamed.run(1.0)
    assert streamed.off_in_air == before
    assert streamed.truth[2] == pytest.approx(1.0, abs=0.05)
    assert streamed.land() == 0
    streamed.run(2.5)
    assert streamed.truth[2] == 0.0


def test_streaming_takes_over_from_the_planner_without_a_gap(hovering):
    hovering.stream_hover(0.5)
    assert hovering.off_in_air == 0
    assert hovering.vehicle.firmware.commander.priority is Priority.RADIO
    assert hovering.vehicle.firmware.planner.state is PlannerState.IDLE


def test_a_command_while_the_stream_goes_on_is_forgotten(streamed):
    place = streamed.belief[:3].copy()
    assert streamed.go_to(place[0] + 1.0, place[1], place[2]) == 0
    streamed.stream_hover(0.3)
    streamed.notify_setpoint_stop()
    streamed.run(0.05)
    assert not streamed.vehicle.motors.any()  # idle again: it wants nothing


def test_the_setpoint_of_a_closing_link_cuts_the_motors_in_flight(hovering):
    hovering.send(Port.ATTITUDE_SETPOINT, 0, ZERO_ATTITUDE)
    hovering.run(0.01)
    assert not hovering.vehicle.motors.any()
    assert hovering.off_in_air > 0


def test_a_stale_priority_makes_take_off_do_nothing_though_it_says_well(rig):
    rig.send(Port.ATTITUDE_SETPOINT, 0, ZERO_ATTITUDE)
    rig.run(1.0)
    assert rig.take_off() == 0
    rig.run(2.0)
    assert rig.truth[2] == 0.0
    assert not rig.vehicle.motors.any()


def test_notifying_first_lets_take_off_happen(rig):
    rig.send(Port.ATTITUDE_SETPOINT, 0, ZERO_ATTITUDE)
    rig.run(1.0)
    rig.notify_setpoint_stop()
    assert rig.take_off() == 0
    rig.run(2.0)
    assert rig.truth[2] > 0.9


def test_an_idle_planner_keeps_setpoints_fresh_on_the_floor(rig):
    rig.run(5.0)
    assert rig.state is State.READY_TO_FLY
    assert rig.vehicle.tick - rig.vehicle.firmware.commander.setpoint.tick <= 10


def test_take_off_is_refused_while_the_planner_flies(hovering):
    assert hovering.take_off() == PLANNER_BUSY


def test_a_second_landing_is_refused_while_one_goes_on(hovering):
    assert hovering.land() == 0
    assert hovering.land() == PLANNER_BUSY


def test_everything_is_refused_before_the_vehicle_may_fly(make_rig):
    rig = make_rig()
    rig.vehicle.advance(40)
    assert [rig.take_off(), rig.go_to(0, 0, 1), rig.land()] == [EBUSY] * 3


def test_an_unknown_command_is_not_executed(rig):
    assert rig.high_level(b"\x63\x00\x00") == ENOEXEC


def test_the_answer_carries_the_command_and_the_return_code_in_the_fourth_byte(rig):
    answer = rig.send(Port.HIGH_LEVEL, 0, struct.pack("<BBff?f", 7, 0, 1.0, 0.0, True, 1.5))[0]
    assert answer[0] >> 4 == Port.HIGH_LEVEL
    assert len(answer) == 5
    assert answer[1] == 7


def test_stop_cuts_the_motors(hovering):
    assert hovering.high_level(struct.pack("<BB", 3, 0)) == 0
    hovering.run(0.02)
    assert not hovering.vehicle.motors.any()


def test_commands_for_another_group_do_nothing(hovering):
    assert hovering.high_level(struct.pack("<BB", 3, 0b100)) == 0
    hovering.run(0.1)
    assert hovering.truth[2] > 0.9
    assert hovering.high_level(struct.pack("<BB", 0, 0b100)) == 0
    assert hovering.high_level(struct.pack("<BB", 3, 0b100)) == 0
    hovering.run(0.5)
    assert hovering.truth[2] < 0.5
