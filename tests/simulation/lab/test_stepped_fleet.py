"""Fleets in the stepped lab: they start together, and with one fault none touches another and all come down."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fleets_down import assert_all_down
from septic_flight import septic_payloads
from stepped_flight import fly_stepped

from cfplan.errors import ExitCode
from cfplan.flight.fleet.conductor import OFF_BY_MORE, ConductedFlight, Conductor
from cfplan.flight.pilot.keys import Order
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.setpoints.packets import decode, encode
from cfplan.flight.setpoints.stops import encode_stops
from cfplan.flight.telemetry import Phase, PhaseEntered
from cfplan.planning.fleet.lost import BACK
from cfplan.planning.fleet.separation import allowed_deviation
from cfplan.preparation.plan_fleet import plan_fleet, prepare_fleet
from cfplan.safety.limits import GroundManoeuvres
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.lab.radio import RadioFault, RadioFaultKind
from cfplan.simulation.lab.stepped_fleet import SteppedFleet
from cfplan.simulation.lab.stepped_lab import SteppedLab
from cfplan.simulation.link_loss import TUBE_PART, link_loss_tubes
from cfplan.simulation.virtual_crazyflie.faults import VehicleFault, VehicleFaultKind
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_crazyflie.supervisor import State
from cfplan.simulation.virtual_vicon.faults import FaultKind, ViconFault

pytestmark = pytest.mark.integration

QUICK = GroundManoeuvres(take_off_height=0.5, take_off_speed=0.6, go_to_speed=0.6, land_speed=0.6)
REPOSITORY = Path(__file__).parents[3]
LIMITS = replace(load_limits(REPOSITORY / "safety.yaml"), ground=QUICK)
APART = 0.3


def mission(y: float) -> Mission:
    """1.2 m along x at this y, in 2.5 s."""
    setpoints = decode(septic_payloads(1.2, 2.5, 0.6))
    moving = encode(replace(setpoints, position=setpoints.position + np.array((0.0, y, 0.0))))
    payloads = np.concatenate([moving, np.repeat(moving[-1:], 30, axis=0)])
    return Mission(payloads, encode_stops(decode(payloads), 100.0), LIMITS, hold_time=0.3)


MISSIONS = {"left": mission(0.0), "right": mission(0.45)}


def standing(missions):
    """Each under its start; they do not arm themselves, so that the last state says whether they were disarmed."""
    return {
        name: VehicleSettings(position=(*each.start[0][:2], 0.0), yaw=each.start[1], auto_arming=False)
        for name, each in missions.items()
    }


OWN = standing(MISSIONS)


def fleet_of(missions=MISSIONS, delays=None):
    flights = [ConductedFlight(name, each.start[0], (delays or {}).get(name, 0.0)) for name, each in missions.items()]
    return SteppedFleet(missions, Conductor(flights, APART, 0.03), settings=standing(missions))


def streaming(fleet, name, moment, act):
    """Return a reaction that acts once, in that pilot's turn, a moment, s, after its plan has begun."""
    done = False

    def react(whose, message):
        nonlocal done
        if not done and whose == name and isinstance(message, PhaseEntered) and message.phase is Phase.STREAM:
            done = True
            clock = fleet.labs[name].clock
            clock.at(clock.now() + moment, act)

    return react


def begun(flight):
    return {name: outcome.first_setpoint for name, outcome in flight.outcomes.items()}


@pytest.fixture(scope="module")
def whole_flight():
    return fleet_of(delays={"left": 0.0, "right": 0.25}).fly()


def test_a_fleet_starts_together_and_lands(whole_flight):
    assert set(whole_flight.exit_codes.values()) == {ExitCode.OK}
    starts = begun(whole_flight)
    assert starts["right"] - starts["left"] == pytest.approx(0.25, abs=0.01)
    assert not whole_flight.brakes
    assert whole_flight.nearest > APART
    assert_all_down(whole_flight)
    for outcome in whole_flight.outcomes.values():
        assert outcome.deviation.max < 0.08


def test_nothing_is_armed_before_all_have_passed_preflight(whole_flight):
    phases = {name: dict(outcome.phases) for name, outcome in whole_flight.outcomes.items()}
    assert min(each[Phase.ARM] for each in phases.values()) > max(each[Phase.PREFLIGHT] for each in phases.values())


def test_a_lost_link_lets_the_other_brake():
    fleet = fleet_of()
    lab = fleet.labs["left"]
    flight = fleet.fly(streaming(fleet, "left", 0.6, lambda: lab.disturb(RadioFault(RadioFaultKind.DEAD))))
    assert flight.exit_codes["left"] is ExitCode.LINK_LOST
    assert "left" in flight.reasons["right"]
    assert_all_down(flight)
    stopped = max(flight.truths["right"].position[:, 0])
    assert stopped < 0.5  # of 0.6: it did not fly to its end


def test_pilots_whose_conductor_dies_brake_and_land():
    fleet = fleet_of()

    def die():
        fleet.conductor_dies_at = fleet.labs["left"].now

    flight = fleet.fly(streaming(fleet, "left", 0.2, die))
    assert all("silent" in reason for reason in flight.reasons.values())
    assert_all_down(flight)


def test_a_pilot_that_stalls_before_its_start_lets_all_brake():
    fleet = fleet_of(delays={"left": 0.0, "right": 0.25})
    stalled = fleet.labs["right"].clock
    flight = fleet.fly(streaming(fleet, "left", 0.1, lambda: stalled.stall(0.24)))
    assert flight.brakes.startswith("right: it began")
    assert_all_down(flight)
    assert max(flight.truths["left"].position[:, 0]) < 0.5


def lose_link(fleet, duration):
    return lambda: fleet.labs["left"].disturb(RadioFault(RadioFaultKind.DEAD, 0.0, duration))


def test_all_brake_when_a_short_loss_of_a_link_takes_a_vehicle_off_its_path():
    """By itself its pilot would fly on: it takes the uplink for gone after 0.5 s only."""
    fleet = fleet_of()
    flight = fleet.fly(streaming(fleet, "left", 0.6, lose_link(fleet, 0.3)))
    off = re.match(r"left: it is ([0-9.]+) m from its place", flight.brakes)
    assert off is not None, flight.brakes
    assert allowed_deviation(APART) + OFF_BY_MORE < float(off[1]) + 0.005 < 0.3
    assert_all_down(flight)
    assert max(max(truth.position[:, 0]) for truth in flight.truths.values()) < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("lasts", [0.5, 0.7, 0.9])
@pytest.mark.parametrize("moment", [0.8, 1.1, 1.6])
def test_a_vehicle_whose_link_comes_back_lands_where_its_tube_has_been(moment, lasts):
    """From BACK on; that is where the certificate of lost vehicles has it until all rest."""
    fleet = fleet_of()
    flight = fleet.fly(streaming(fleet, "left", moment, lose_link(fleet, lasts)))
    assert_all_down(flight)
    payloads, lost = MISSIONS["left"].payloads, begun(flight)["left"] + moment
    tubes = link_loss_tubes(payloads, LIMITS, round(100 * moment) + np.arange(-2, 3))[-1]
    boxes = tubes[:, round(1000 * BACK / TUBE_PART) :]
    low, high = boxes[:, :, 0, :2].min(axis=(0, 1)), boxes[:, :, 1, :2].max(axis=(0, 1))
    truth = flight.truths["left"]
    way = truth.position[truth.time > lost + BACK, :2]
    assert (low <= way).all()
    assert (way <= high).all()


def kill_pilot(fleet):
    fleet.labs["left"].kill_pilot()


def lose_poses(fleet):
    fleet.labs["left"].disturb(ViconFault(FaultKind.OCCLUDE))


def tumble(fleet):
    fleet.labs["left"].disturb(VehicleFault(VehicleFaultKind.TUMBLE))


def sag(fleet):
    fleet.labs["left"].disturb(VehicleFault(VehicleFaultKind.BATTERY, 0.0, 60.0, 3.0))


def stall(fleet):
    fleet.labs["left"].clock.stall(0.6)


def land(fleet):
    fleet.labs["left"].orders.give(Order.LAND)


@pytest.mark.slow
@pytest.mark.parametrize("moment", [0.2, 0.8, 1.3])
@pytest.mark.parametrize("fault", [kill_pilot, lose_poses, tumble, sag, stall, land])
def test_with_one_fault_none_touches_another_and_all_come_down(fault, moment):
    fleet = fleet_of()
    flight = fleet.fly(streaming(fleet, "left", moment, lambda: fault(fleet)))
    assert flight.brakes.startswith("left")
    assert flight.reasons["right"].startswith("the fleet brakes: left")
    assert_all_down(flight)


def lose_all_poses(fleet):
    for lab in fleet.labs.values():
        lab.disturb(ViconFault(FaultKind.OCCLUDE))


def nearest_after(flight, begin):
    """The least distance of the two columns, m, from a time on until both are on the floor."""
    left, right = flight.truths.values()
    other = np.column_stack([np.interp(left.time, right.time, along) for along in right.position.T])
    flies = (np.maximum(left.position[:, 2], other[:, 2]) > 0.05) & (left.time >= begin)
    return float(np.linalg.norm((other - left.position)[flies, :2], axis=1).min())


def test_vehicles_beside_a_wall_keep_apart_when_all_poses_are_lost():
    """One alone would move 0.4 m off the wall at y = 4, to where the other is."""
    missions = {"left": mission(2.95), "right": mission(3.35)}
    fleet = fleet_of(missions)
    flight = fleet.fly(streaming(fleet, "left", 0.8, lambda: lose_all_poses(fleet)))
    assert_all_down(flight)
    assert nearest_after(flight, begun(flight)["left"]) > APART


@pytest.fixture(scope="module")
def two():
    """The example fleet of two, certified, and its missions."""
    planned = plan_fleet(REPOSITORY / "flights" / "fleets" / "two.yaml", load_limits(REPOSITORY / "safety.yaml"))
    return planned, {each.planned.name: each.mission for each in prepare_fleet(planned)}


@pytest.mark.slow
@pytest.mark.parametrize("moment", [0.5, 2.5, 4.5, 5.5, 6.0, 7.0])
def test_two_vehicles_whose_poses_all_stop_come_no_nearer_than_certified(two, moment):
    planned, missions = two
    flights = [ConductedFlight(each.name, missions[each.name].start[0], each.delay) for each in planned.members]
    fleet = SteppedFleet(missions, Conductor(flights, planned.apart, planned.skew), settings=standing(missions))
    first = min(planned.members, key=lambda each: each.delay).name
    flight = fleet.fly(streaming(fleet, first, moment, lambda: lose_all_poses(fleet)))
    assert_all_down(flight)
    assert "pose" in flight.brakes
    allowed = 2.0 * allowed_deviation(planned.apart)
    assert nearest_after(flight, begun(flight)[first] + moment) > planned.separations[0].distance - allowed


@pytest.mark.slow
def test_a_pilot_that_the_order_does_not_reach_brakes_by_itself():
    fleet = fleet_of()

    def lose_both():
        fleet.labs["right"].deaf = True
        lose_poses(fleet)

    flight = fleet.fly(streaming(fleet, "left", 0.5, lose_both))
    assert "silent" in flight.reasons["right"]
    assert_all_down(flight)


@pytest.mark.slow
def test_a_vehicle_that_does_not_arm_keeps_the_other_on_the_floor():
    fleet = fleet_of()
    locks = VehicleFault(VehicleFaultKind.LOCK)

    def react(name, message):
        if name == "left" and isinstance(message, PhaseEntered) and message.phase is Phase.ARM:
            fleet.labs["left"].disturb(locks)

    flight = fleet.fly(react)
    assert flight.exit_codes["left"] is ExitCode.PREFLIGHT
    assert all(truth.position[:, 2].max() < 0.02 for truth in flight.truths.values())
    assert_all_down(flight)


def test_a_link_lost_before_take_off_ends_with_all_disarmed():
    """The vehicle hears no order any more, so it disarms by itself, 30 s after arming."""
    fleet = fleet_of()
    lab = fleet.labs["left"]

    def react(name, message):
        if name == "left" and isinstance(message, PhaseEntered) and message.phase is Phase.ARM:
            lab.clock.at(lab.now + 0.2, lambda: lab.disturb(RadioFault(RadioFaultKind.DEAD)))

    flight = fleet.fly(react)
    assert flight.exit_codes["left"] is ExitCode.PREFLIGHT
    assert "left" in flight.brakes
    assert State.READY_TO_FLY in flight.truths["left"].supervisor
    assert all(truth.position[:, 2].max() < 0.02 for truth in flight.truths.values())
    assert_all_down(flight)


@pytest.mark.slow
def test_swapped_bodies_are_noticed_while_one_vehicle_takes_off():
    fleet = fleet_of()
    left, right = fleet.labs["left"], fleet.labs["right"]
    left.body, right.body = right, left
    flight = fleet.fly()
    assert flight.brakes
    assert flight.truths["right"].position[:, 2].max() < 0.02
    assert flight.truths["left"].position[:, 2].max() < 0.3
    assert_all_down(flight)


def test_a_vehicle_among_others_flies_as_one_alone(whole_flight):
    """Until the conductor makes it wait, to the last bit: sharing a clock changes nothing."""
    shared = whole_flight.telemetry["left"]
    alone = fly_stepped(MISSIONS["left"], lab=SteppedLab(LIMITS.airframe, vehicle=OWN["left"])).telemetry
    armed = next(message for message in alone if isinstance(message, PhaseEntered) and message.phase is Phase.ARM)
    assert [each for each in shared if each.time < armed.time] == [each for each in alone if each.time < armed.time]
    assert len([each for each in shared if each.time < armed.time]) > 300


def test_a_fleet_flies_on_another_firmware(whole_flight, monkeypatch):
    monkeypatch.setenv("CFPLAN_FIRMWARE", "firmware_doubles:Counting")
    flight = (fleet := fleet_of(delays={"left": 0.0, "right": 0.25})).fly()
    assert_all_down(flight)
    for name, lab in fleet.labs.items():
        assert lab.vehicle.firmware.calls["receive"] > 500
        assert np.array_equal(flight.truths[name].position, whole_flight.truths[name].position)
