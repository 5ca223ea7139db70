"""When the motors may turn: time-outs, arming, tumbling, stops."""

import struct

import numpy as np
import pytest

from cfplan.flight.radio.crtp import Port
from cfplan.flight.radio.supervisor_bits import DECK_FAULT, HIGH_LEVEL_ACTIVE, HIGH_LEVEL_DISABLED
from cfplan.simulation.virtual_crazyflie.faults import VehicleFault, VehicleFaultKind
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_crazyflie.supervisor import State, Supervisor
from cfplan.simulation.virtual_crazyflie.vehicle import VirtualCrazyflie
from cfplan.vehicle.airframes import AIRFRAMES

PLANNER_IDLE = {"planner_active": False, "planner_finished": False, "planner_disabled": False}
UPRIGHT = np.array([0.0, 0.0, 1.0])
RUNNING, OFF = np.full(4, 30000.0), np.zeros(4)


class Hand:
    """A supervisor moved by hand, 40 ms a look."""

    def __init__(self, **settings):
        self.tick = 0
        self.setpoint_tick = 0
        self.said: list[str] = []
        self.supervisor = Supervisor(**({"auto_arming": True} | settings), say=self.said.append)

    def look(self, seconds, *, motors=OFF, acceleration=UPRIGHT, fresh=True):
        """Its states in turn."""
        states = []
        for _ in range(round(seconds * 25)):
            self.tick += 40
            if fresh:
                self.setpoint_tick = self.tick
            self.supervisor.update(self.tick, self.setpoint_tick, np.array(acceleration), motors)
            states.append(self.supervisor.state)
        return states

    def fly(self):
        self.look(0.4)
        assert self.look(0.2, motors=RUNNING)[-1] is State.FLYING
        return self


def test_a_brushed_vehicle_arms_itself():
    assert Hand().look(0.16) == [State.CHECKS_NOT_PASSED, State.CHECKS_PASSED, State.ARMING, State.READY_TO_FLY]


def test_a_brushless_vehicle_waits_for_a_request():
    hand = Hand(auto_arming=False)
    assert not hand.supervisor.request_arming(True)  # the checks have not passed yet
    assert hand.look(1.0)[-1] is State.CHECKS_PASSED
    assert hand.supervisor.request_arming(True)
    assert hand.look(0.08)[-1] is State.READY_TO_FLY


def test_the_airframe_says_whether_it_arms_itself():
    for name, arms_itself in (("crazyflie-2.1+", True), ("crazyflie-2.1-brushless", False)):
        vehicle = VirtualCrazyflie(AIRFRAMES[name])
        vehicle.advance(300)
        assert vehicle.firmware.supervisor.can_fly == arms_itself


def test_an_armed_vehicle_that_does_not_fly_disarms_after_30_s_and_arms_itself_again():
    states = Hand().look(31.0)
    assert states.index(State.CHECKS_NOT_PASSED, 5) * 0.04 == pytest.approx(30.2, abs=0.1)
    assert states[-1] is State.READY_TO_FLY


def test_old_setpoints_level_out_after_half_a_second_and_lock_after_two():
    hand = Hand().fly()
    states = hand.look(2.3, motors=RUNNING, fresh=False)
    assert states.index(State.WARNING_LEVEL_OUT) == pytest.approx(0.5 / 0.04, abs=1)
    assert states.index(State.FREE_FALL) == pytest.approx(2.0 / 0.04, abs=1)
    assert states[-1] is State.LOCKED
    assert hand.supervisor.ever_locked
    assert "SUP: Locked, reboot required" in hand.said


def test_fresh_setpoints_lead_back_from_level_out():
    hand = Hand().fly()
    assert hand.look(1.0, motors=RUNNING, fresh=False)[-1] is State.WARNING_LEVEL_OUT
    assert hand.look(0.04, motors=RUNNING)[-1] is State.FLYING


def test_a_stream_that_ends_as_soon_as_the_motors_stop_ends_locked():
    hand = Hand().fly()
    assert State.LANDED not in hand.look(2.3, fresh=False)
    assert hand.supervisor.locked


def test_flying_ends_two_seconds_after_the_last_thrust_and_landed_three_after_that():
    states = Hand().fly().look(5.5)
    assert states.index(State.LANDED) == pytest.approx(2.0 / 0.04, abs=1)
    assert states.index(State.RESET) == pytest.approx(5.0 / 0.04, abs=2)
    assert states[-1] is State.READY_TO_FLY


@pytest.mark.parametrize(
    ("acceleration", "seconds"), [((0.0, 0.0, 0.4), 1.0), ((0.0, 0.0, -0.5), 0.1), ((0.9, 0.0, 0.3), 1.0)]
)
def test_a_tilt_that_lasts_is_a_crash(acceleration, seconds):
    hand = Hand().fly()
    assert hand.look(seconds - 0.04, motors=RUNNING, acceleration=acceleration)[-1] is State.FLYING
    assert hand.look(0.16, motors=RUNNING, acceleration=acceleration)[-1] is State.CRASHED
    assert hand.supervisor.info(**PLANNER_IDLE) & 0x80


def test_free_fall_is_no_crash():
    assert Hand().fly().look(3.0, motors=RUNNING, acceleration=(0.05, 0.0, 0.05))[-1] is State.FLYING


def test_a_crash_needs_recovery_and_recovery_needs_an_upright_vehicle():
    hand = Hand().fly()
    hand.look(1.2, motors=RUNNING, acceleration=(0.0, 0.0, 0.2))
    assert not hand.supervisor.request_recovery()
    assert hand.look(2.0)[-1] is State.CRASHED
    assert hand.supervisor.request_recovery()
    assert hand.look(1.2)[-1] is State.READY_TO_FLY


def test_the_tumble_check_can_be_switched_off():
    hand = Hand().fly()
    hand.supervisor.settings.tumble_check = False
    assert hand.look(2.0, motors=RUNNING, acceleration=(0.0, 0.0, 0.2))[-1] is State.FLYING


def test_an_emergency_stop_locks_for_good():
    hand = Hand().fly()
    hand.supervisor.emergency_stop()
    assert hand.look(0.08, motors=RUNNING)[-1] is State.LOCKED
    assert not hand.supervisor.request_arming(True)
    assert hand.look(10.0)[-1] is State.LOCKED


def test_the_emergency_watchdog_bites_a_second_after_the_last_sign_of_life():
    hand = Hand().fly()
    for _ in range(5):
        hand.supervisor.keep_alive(hand.tick)
        assert hand.look(0.4, motors=RUNNING)[-1] is State.FLYING
    assert hand.look(0.48, motors=RUNNING)[-1] is State.FLYING
    assert hand.look(0.24, motors=RUNNING)[-1] is State.LOCKED


def test_disarming_in_flight_stops_the_motors():
    hand = Hand().fly()
    assert hand.supervisor.request_arming(False)
    hand.look(0.04, motors=RUNNING)
    assert not hand.supervisor.motors_allowed


def test_info_bits_are_those_that_cflib_knows():
    hand = Hand()
    hand.look(0.2)
    assert hand.supervisor.info(**PLANNER_IDLE | {"planner_finished": True}) == 0b10_0000_1110
    hand.look(0.1, motors=RUNNING)
    assert hand.supervisor.info(**PLANNER_IDLE | {"planner_active": True}) == 0b1_0001_1110


def test_a_planner_that_is_given_no_number_is_disabled_until_a_setpoint_comes(hovering):
    assert hovering.go_to(np.nan, 0.0, 1.0) == 0
    hovering.run(0.1)
    assert hovering.vehicle.firmware.info() & HIGH_LEVEL_DISABLED
    assert not hovering.vehicle.firmware.info() & HIGH_LEVEL_ACTIVE
    hovering.stream_hover(0.1)
    assert not hovering.vehicle.firmware.info() & HIGH_LEVEL_DISABLED


def test_the_fault_of_a_deck_keeps_a_vehicle_on_the_floor_and_locks_one_in_the_air(make_rig):
    on_floor, in_air, old = make_rig(), make_rig(), make_rig(VehicleSettings(firmware="2026.04"))
    for rig in (in_air, old):
        rig.prepare()
        rig.take_off()
        rig.run(1.0)
    for rig in (on_floor, in_air, old):
        rig.vehicle.inject(VehicleFault(VehicleFaultKind.DECK, 0.0, 0.3))
        rig.run(0.2)
    assert on_floor.state is State.CHECKS_NOT_PASSED
    assert on_floor.vehicle.firmware.info() & DECK_FAULT
    assert in_air.state is State.LOCKED
    assert old.state is State.FLYING  # it knows nothing of decks
    on_floor.run(0.5)
    assert on_floor.state is State.READY_TO_FLY


def test_the_port_answers_arming_recovery_and_the_bits(make_rig):
    rig = make_rig(VehicleSettings(auto_arming=False))
    rig.run(0.2)
    assert rig.send(Port.SUPERVISOR, 0, b"\x0c")[0][1:] == b"\x8c" + (0x201).to_bytes(2, "little")
    assert rig.send(Port.SUPERVISOR, 1, b"\x01\x01")[0][1:] == b"\x81\x01\x01"
    rig.run(0.2)
    assert rig.send(Port.SUPERVISOR, 0, b"\x04")[0][1:] == b"\x84\x01"
    assert rig.send(Port.SUPERVISOR, 1, b"\x02")[0][1:] == b"\x82\x01\x01"
    assert rig.send(Port.SUPERVISOR, 1, b"\x01\x00")[0][1:] == b"\x81\x01\x00"


def test_an_emergency_stop_packet_cuts_the_motors_in_flight(hovering):
    assert hovering.send(Port.SUPERVISOR, 1, b"\x03") == []
    hovering.run(0.1)
    assert hovering.state is State.LOCKED
    assert not hovering.vehicle.motors.any()
    hovering.run(1.0)
    assert hovering.truth[2] == 0.0
    assert hovering.take_off() == 16  # EBUSY
    assert any(b"Locked" in packet for packet in hovering.received)


def test_the_stop_parameter_is_an_emergency_stop_too(hovering):
    hovering.set("stabilizer.stop", 1)
    hovering.run(0.1)
    assert hovering.state is State.LOCKED


def test_a_descent_with_less_than_half_a_g_of_thrust_for_a_second_is_taken_for_a_crash(rig):
    rig.take_off(8.0, 4.0)
    rig.run(5.0)
    begin, acceleration = rig.vehicle.tick, -7.0

    def setpoint(tick):
        if tick % 10 == 0:
            time = (tick - begin) / 1000
            values = (0, 0, 8 + acceleration * time**2 / 2, 0, 0, acceleration * time, 0, 0, acceleration)
            encoded = struct.pack("<B9hI3h", 6, *(round(1000 * value) for value in values), 3 << 30, 0, 0, 0)
            rig.send(Port.SETPOINT, 0, encoded)

    rig.run(1.0, setpoint)
    assert rig.state is State.FLYING
    rig.run(0.4, setpoint)
    assert rig.state is State.CRASHED
    assert not rig.vehicle.motors.any()


def test_the_stream_stopping_levels_out_then_falls(streamed):
    streamed.run(0.45)
    assert streamed.state is State.FLYING
    streamed.run(0.15)
    assert streamed.state is State.WARNING_LEVEL_OUT
    assert abs(streamed.truth[2] - 1.0) < 0.1  # height is kept
    streamed.run(1.6)
    assert streamed.state is State.LOCKED
    assert streamed.off_in_air > 0


@pytest.mark.parametrize("length", [1, 15, 28, 30])
def test_a_full_state_of_wrong_length_stops_the_firmware(hovering, length):
    hovering.send(Port.SETPOINT, 0, bytes([6]) + bytes(length - 1))
    assert hovering.vehicle.firmware.supervisor.locked
    assert any(b"Assert" in packet for packet in hovering.received)


def test_a_notification_of_wrong_length_stops_the_firmware(hovering):
    hovering.send(Port.SETPOINT, 1, struct.pack("<BH", 0, 0))
    assert hovering.vehicle.firmware.supervisor.locked
