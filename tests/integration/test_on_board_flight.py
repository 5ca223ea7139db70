"""Flights on board, prepared, uploaded and flown in the stepped lab, and what ends them early."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from slow_cases import slow_unless
from stepped_flight import at_setpoint, fly_stepped

from cfplan.errors import ExitCode, InfeasibleError, InputError, PreflightError
from cfplan.flight.on_board.commands import GO_TO, LAND, START
from cfplan.flight.on_board.fall import falls_from
from cfplan.flight.on_board.memory_format import MEMORY_SIZE, read_compressed, read_raw
from cfplan.flight.pilot.keys import HeldOrders, Order
from cfplan.flight.pilot.mission import mission_of
from cfplan.flight.pilot.on_board_manoeuvres import OnBoardManoeuvres
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.radio.crtp import Port
from cfplan.flight.telemetry import Phase
from cfplan.preparation.on_board_flight import prepare_on_board_flight
from cfplan.preparation.prepare_flight import encode_flight
from cfplan.safety.limits import Ladder
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.lab.radio import RadioFault, RadioFaultKind
from cfplan.simulation.lab.stepped_lab import SteppedLab
from cfplan.simulation.virtual_crazyflie.faults import VehicleFault, VehicleFaultKind
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.vehicle.rotations import matrices_of
from studies.faults import SCENARIOS
from studies.stepped_flight import FOR_GOOD, Scenario, fly_scenario

REPOSITORY = Path(__file__).parents[2]
LIMITS = load_limits(REPOSITORY / "safety.yaml")
WORSE = 0.02  # m, by which the deviation may be larger than that of the same plan, streamed
BY_NAME = {scenario.name: scenario for scenario in SCENARIOS}
NO_STREAM = ("stream stalled for 0.6 s",)  # which it does without
FLIGHTS = sorted(file.stem for file in (REPOSITORY / "flights").glob("*.yaml"))
FAULTS = [scenario for scenario in SCENARIOS if not scenario.planner]
QUICK = [
    BY_NAME[name]
    for name in (
        "poses stop for 5 s",
        "radio dead for 3 s while taking off",
        "space bar in the stream",
        "pilot killed",
        "two bodies swapped",
    )
]

pytestmark = pytest.mark.integration


def prepared_of(name, limits=LIMITS):
    return prepare_on_board_flight(REPOSITORY / "flights" / f"{name}.yaml", limits)


@pytest.fixture(scope="module")
def line():
    return prepared_of("line")


@pytest.fixture(scope="module")
def flown(line):
    return fly_stepped(line.mission)


def compared(prepared):
    """Deviations, m, on board and of the same plan streamed."""
    on_board = fly_stepped(prepared.mission)
    streamed = fly_stepped(mission_of(encode_flight(prepared.planned), prepared.mission.limits))
    assert on_board.outcome.reason == streamed.outcome.reason == "landed"
    return on_board.outcome.deviation.max, streamed.outcome.deviation.max


def steepest(flight):
    """The largest tilt in the air, rad."""
    in_air = flight.truth.position[:, 2] > 0.3
    return np.arccos(matrices_of(flight.truth.quaternion[in_air])[:, 2, 2]).max()


def test_it_takes_off_flies_and_lands_by_its_own_commander(flown):
    assert flown.outcome.exit_code is ExitCode.OK
    assert flown.outcome.rung is Rung.NONE
    assert flown.phases == list(Phase)
    assert flown.truth.off_in_air[-1] == 0
    assert flown.truth.position[-1, 2] == 0.0
    assert not flown.truth.locked


def test_no_setpoint_is_sent_in_the_air(line):
    lab, sent = SteppedLab(LIMITS.airframe), []
    send = lab.radio.send

    def listen(packet):
        sent.append(packet)
        return send(packet)

    lab.radio.send = listen
    fly_stepped(line.mission, lab=lab)
    heads = [(packet[0] >> 4, packet[0] & 3) for packet in sent]
    assert (Port.SETPOINT, 0) not in heads
    assert (Port.HIGH_LEVEL, 0) in heads


@pytest.mark.parametrize("name", slow_unless(["line"], FLIGHTS))
def test_it_is_nearly_on_the_plan_that_a_stream_flies(name):
    on_board, streamed = compared(prepared_of(name))
    print(f"{name}: {100 * on_board:.1f} cm on board, {100 * streamed:.1f} cm streamed")
    assert on_board < streamed + WORSE


def test_what_is_uploaded_ends_on_the_floor_at_rest(line):
    program = line.mission.on_board
    assert len(program.memory) <= MEMORY_SIZE
    pieces = read_compressed(program.memory) if program.compressed else read_raw(program.memory, program.pieces)
    time = float(pieces.durations[-1])
    end = pieces.coefficients[-1].astype(float) @ time ** np.arange(8)
    speed = pieces.coefficients[-1, :, 1:].astype(float) @ (np.arange(1, 8) * time ** np.arange(7))
    assert end[2] < LIMITS.space.low[2]
    assert np.abs(speed).max() < 1e-3


def test_other_bytes_in_the_memory_keep_it_on_the_ground(line):
    lab = SteppedLab(LIMITS.airframe)
    memories = lab.vehicle.firmware.memories
    write = memories.receive

    def spoilt(channel, payload):
        answer = write(channel, payload)
        memories.trajectory[100] = (memories.trajectory[100] + 1) % 256  # at each write, however many there are
        return answer

    memories.receive = spoilt
    with pytest.raises(PreflightError, match="other bytes"):
        fly_stepped(line.mission, lab=lab)
    assert not any(lab.truth().motor.any(axis=1))


def test_without_the_watchdog_it_is_refused():
    limits = replace(LIMITS, firmware=replace(LIMITS.firmware, watchdog=False))
    with pytest.raises(InputError, match="no time-out"):
        prepared_of("line", limits)


def test_it_flies_more_slowly_where_it_would_fall_beyond_a_wall(line):
    assert "fall" in line.plan.describe_slowing()
    assert line.link_loss.beyond <= 0.0
    nets = replace(LIMITS, link_loss=replace(LIMITS.link_loss, only_warn=True))
    careless = prepared_of("line", nets)
    assert careless.plan.trajectory.duration < line.plan.trajectory.duration
    assert careless.link_loss.beyond > 0.0


def test_where_slowing_does_not_help_it_is_refused(tmp_path):
    path = tmp_path / "along.yaml"
    x = LIMITS.space.high[0] - LIMITS.space.margin - 0.01
    path.write_text(f"name: along\nwaypoints:\n  - [{x}, -1, 1.5]\n  - [{x}, 1, 1.5]\n")
    with pytest.raises(InfeasibleError, match="fall after link loss"):
        prepare_on_board_flight(path, LIMITS)


def test_a_vehicle_that_stands_too_near_to_a_wall_stays_down(line):
    x = LIMITS.space.high[0] - LIMITS.space.margin - 0.02
    lab = SteppedLab(LIMITS.airframe, vehicle=VehicleSettings(position=(x, 0.0, 0.0)))
    flight = fly_stepped(line.mission, lab=lab)
    assert flight.outcome.exit_code is ExitCode.PREFLIGHT
    assert "fall after link loss" in flight.outcome.reason


@pytest.mark.parametrize("share", slow_unless([0.35, 0.8], [0.2, 0.35, 0.5, 0.65, 0.8]))
def test_a_dead_link_ends_inside_the_walls_and_where_the_fall_was_foreseen(line, share):
    lab = SteppedLab(LIMITS.airframe)
    row = int(share * len(line.mission.payloads))
    dead = RadioFault(RadioFaultKind.DEAD, 0.0, 1e6)
    flight = fly_stepped(line.mission, at_setpoint(row, lambda: lab.disturb(dead)), lab=lab)
    assert flight.outcome.exit_code in (ExitCode.LINK_LOST, ExitCode.ENDED_BY_SAFETY)  # by what the poses still show
    motors_on = flight.truth.motor.any(axis=1)
    stopped = int(np.flatnonzero(motors_on)[-1])
    began = flight.outcome.first_setpoint + row / line.mission.rate
    assert 0.85 < flight.truth.time[stopped] - began < 1.1
    rest = flight.truth.position[-1]
    assert (LIMITS.space.beyond(rest) <= LIMITS.space.margin)[:2].all()
    states = line.plan.trajectory.at(np.array([flight.truth.time[stopped] - flight.outcome.first_setpoint]))
    state = np.stack([states.position, states.velocity, states.acceleration], axis=1)
    falls = falls_from(state, LIMITS, 0.04)
    assert np.linalg.norm(rest[:2] - states.position[0, :2]) <= falls.distance[0]


def test_the_operator_ends_it_by_a_stop_of_a_second(line):
    orders = HeldOrders()
    row = len(line.mission.payloads) // 3
    flight = fly_stepped(line.mission, at_setpoint(row, lambda: orders.give(Order.LAND)), orders=orders)
    assert flight.outcome.exit_code is ExitCode.ENDED_BY_OPERATOR
    assert flight.truth.off_in_air[-1] == 0
    begun = dict(flight.outcome.phases)[Phase.LAND]
    at = int(np.searchsorted(flight.truth.time, begun))
    assert np.linalg.norm(flight.truth.position[at] - flight.truth.position[at - 20]) < 0.1
    assert begun - flight.outcome.first_setpoint - row / line.mission.rate == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize(("dead", "order"), [(0.4, Order.LAND), (0.85, None)])
def test_it_stops_from_where_it_is_once_its_radio_returns(line, dead, order):
    lab, orders = SteppedLab(LIMITS.airframe), HeldOrders()
    row = int(2.0 * line.mission.rate)  # at full speed

    def strike():
        lab.disturb(RadioFault(RadioFaultKind.DEAD, 0.0, dead))
        orders.worst = order

    flight = fly_stepped(line.mission, at_setpoint(row, strike), orders=orders, lab=lab)
    assert flight.outcome.rung is Rung.LAND
    assert flight.truth.off_in_air[-1] == 0
    assert steepest(flight) < LIMITS.flight.stop_tilt


@pytest.mark.parametrize("command", [GO_TO, START])
@pytest.mark.parametrize("arrives", [False, True])
@pytest.mark.parametrize("dead", [0.35, 0.7, 0.9])
def test_a_radio_that_dies_with_a_command_to_fly_on_leaves_no_doubt_of_what_it_flies(line, command, arrives, dead):
    lab, struck = SteppedLab(LIMITS.airframe), []
    send, receive = lab.radio.send, lab.vehicle.firmware.planner.receive

    def strike(sent):
        if sent == command and not struck:
            struck.append(sent)
            lab.disturb(RadioFault(RadioFaultKind.DEAD, 0.0, dead))

    def strike_before(packet):
        strike(packet[1] if (packet[0] >> 4, packet[0] & 3) == (Port.HIGH_LEVEL, 0) else None)
        return send(packet)

    def strike_after(payload, *rest, **more):
        answer = receive(payload, *rest, **more)
        strike(payload[0])
        return answer

    if arrives:
        lab.vehicle.firmware.planner.receive = strike_after
    else:
        lab.radio.send = strike_before
    flight = fly_stepped(line.mission, lab=lab)
    assert struck
    assert flight.outcome.rung is (Rung.NONE if dead < 0.4 else Rung.LAND)
    assert flight.truth.off_in_air[-1] == 0
    assert steepest(flight) < LIMITS.flight.stop_tilt


def test_it_is_not_cut_while_it_rightly_leaves_the_start_unheard(line):
    tight = replace(LIMITS.flight, deviation=Ladder(0.2, 0.35, 0.5))
    lab = SteppedLab(LIMITS.airframe)
    receive = lab.vehicle.firmware.planner.receive

    def strike_after(payload, *rest, **more):
        if payload[0] == START:
            lab.disturb(RadioFault(RadioFaultKind.DEAD, 0.0, 0.75))
        return receive(payload, *rest, **more)

    lab.vehicle.firmware.planner.receive = strike_after
    mission = replace(line.mission, limits=replace(LIMITS, flight=tight))
    flight = fly_stepped(mission, lab=lab)
    assert flight.outcome.rung is Rung.LAND
    assert flight.truth.off_in_air[-1] == 0


@pytest.mark.parametrize(("dead", "loss", "phase"), [(0.8, 0.5, 0.0), (0.85, 0.3, 0.03), (0.88, 0.0, 0.0)])
def test_one_that_hears_again_in_time_is_landed_although_few_packets_come_through(line, dead, loss, phase):
    lab, row = SteppedLab(LIMITS.airframe), int(2.0 * line.mission.rate)

    def strike():
        lab.disturb(RadioFault(RadioFaultKind.DEAD, phase, dead))
        lab.disturb(RadioFault(RadioFaultKind.LOSS, phase + dead, 3.0, loss))

    flight = fly_stepped(line.mission, at_setpoint(row, strike), lab=lab)
    assert flight.outcome.rung is Rung.LAND
    assert flight.truth.off_in_air[-1] == 0


@pytest.mark.parametrize("step", ["_descend", "_command_stop"])
def test_a_fault_of_the_pilot_in_a_stop_or_descent_lands_it_by_setpoints(line, monkeypatch, step):
    def fail(*_):
        raise ValueError("injected")

    monkeypatch.setattr(OnBoardManoeuvres, step, fail)
    orders, row = HeldOrders(), len(line.mission.payloads) // 3
    flight = fly_stepped(line.mission, at_setpoint(row, lambda: orders.give(Order.LAND)), orders=orders)
    assert flight.outcome.rung is Rung.LAND
    assert "injected" in flight.outcome.reason
    assert flight.truth.off_in_air[-1] == 0
    assert flight.truth.position[-1, 2] == 0.0


@pytest.mark.parametrize("command", [LAND, GO_TO])
def test_where_its_commander_refuses_to_stop_or_to_land_setpoints_take_over(line, command):
    lab, orders = SteppedLab(LIMITS.airframe), HeldOrders()
    receive, row = lab.vehicle.firmware.planner.receive, len(line.mission.payloads) // 3
    refusing = False

    def refuse(payload, *rest, **more):
        if refusing and payload[0] == command:
            return bytes((command, 0, 0, 8))  # ENOEXEC
        return receive(payload, *rest, **more)

    def order():
        nonlocal refusing
        refusing = True
        orders.give(Order.LAND)

    lab.vehicle.firmware.planner.receive = refuse
    flight = fly_stepped(line.mission, at_setpoint(row, order), orders=orders, lab=lab)
    assert (flight.outcome.exit_code, flight.outcome.rung) == (ExitCode.ENDED_BY_OPERATOR, Rung.LAND)
    assert flight.truth.off_in_air[-1] == 0
    assert flight.truth.position[-1, 2] == 0.0
    assert not flight.truth.locked


@pytest.mark.parametrize("kind", [VehicleFaultKind.SILENT_ESTIMATE, VehicleFaultKind.SILENT_STATUS])
def test_a_silent_log_lands_it_by_its_commander(line, kind):
    flown = fly_scenario(Scenario("silent", Rung.LAND, (VehicleFault(kind, 0.0, FOR_GOOD),)), line.mission)
    assert (flown.rung, flown.motors_off) == ("land", 0)
    assert (flown.landed, flown.disarmed, flown.readable) == (True, True, True)


@pytest.mark.parametrize("scenario", slow_unless(QUICK, FAULTS), ids=lambda row: row.name)
def test_a_fault_comes_to_its_rung_and_the_vehicle_to_the_ground(scenario, line):
    flown = fly_scenario(scenario, line.mission)
    expected = "none" if scenario.name in NO_STREAM else flown.expected
    assert flown.rung == expected, flown.reason
    assert flown.to_wall > 0.0
    assert flown.landed
    assert flown.disarmed
    assert flown.readable
