"""Preflight against the virtual Crazyflie: each row of its table made wrong on board."""

import math
import struct
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from septic_flight import septic_payloads
from slow_cases import slow_unless
from wrong_values import wrong_on_board

from cfplan.errors import CfplanError, ExitCode
from cfplan.flight.firmware import GAIN_PARAMETERS, YAW_CORRECT, gains_for
from cfplan.flight.pilot.keys import HeldOrders, Order
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.pilot.pilot import Pilot
from cfplan.flight.pilot.vehicle_rules import COMMANDER_SIGNS, PARAMETER_RULES, Action
from cfplan.flight.radio.crtp import Port, pack
from cfplan.flight.setpoints.packets import decode
from cfplan.flight.setpoints.stops import encode_stops
from cfplan.flight.telemetry import Phase, PhaseEntered
from cfplan.preparation.prepare_flight import prepare_flight
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.engine.flight import Conditions, fly_setpoints
from cfplan.simulation.engine.layout import hovering
from cfplan.simulation.lab.stepped_lab import SteppedLab
from cfplan.simulation.lab.stepped_link import SteppedPoses, connect
from cfplan.simulation.virtual_crazyflie.parameters import parameter_toc
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_crazyflie.supervisor import State

REPOSITORY = Path(__file__).parents[2]
LIMITS = load_limits(REPOSITORY / "safety.yaml")
ZERO_ATTITUDE = pack(Port.ATTITUDE_SETPOINT, 0, struct.pack("<fffH", 0.0, 0.0, 0.0, 0))
HOVER_HERE = pack(Port.SETPOINT, 0, struct.pack("<Bffff", 7, 0.5, 0.5, 0.4, 0.0))
SPIN_UP = pack(Port.HIGH_LEVEL, 0, struct.pack("<BBff?f", 7, 0, 0.4, 0.0, True, 2.0))
GOES_NOWHERE = pack(Port.HIGH_LEVEL, 0, struct.pack("<BBBBfffff", 12, 0, 0, 0, math.nan, 0.0, 0.4, 0.0, 2.0))
MOTOR_TEST = pack(Port.PARAMETERS, 2, struct.pack("<HB", parameter_toc().index()["motorPowerSet.enable"], 1))
ONCE = 1e3  # s
ARE_SET = [rule for rule in PARAMETER_RULES if rule.action is Action.SET]
ASKS_TWICE_A_SECOND = pack(Port.HIGH_LEVEL, 0, bytes((3, 0)))  # stop, which a vehicle at rest obeys by doing nothing


@pytest.fixture(scope="module")
def mission():
    payloads = septic_payloads(2.0, 2.5, 1.0)
    return Mission(payloads, encode_stops(decode(payloads), 100.0), LIMITS)


class Flown:
    """One flight in the stepped lab; another client may send `guest` every 20 ms from a phase on.

    The operator gives an `order` as the client begins.
    """

    def __init__(self, mission, guest=b"", phase=Phase.CONNECT, period=0.02, order=None, **settings):
        orders = HeldOrders()
        self.lab = SteppedLab(LIMITS.airframe, vehicle=VehicleSettings(**{"auto_arming": False, **settings}))
        self.phases, self.armed = [], False

        def visit():
            self.lab.vehicle.receive(guest)
            self.lab.clock.at(self.lab.now + period, visit)

        def hear(message):
            self.armed = self.armed or self.lab.vehicle.firmware.supervisor.armed
            if isinstance(message, PhaseEntered):
                self.phases.append(message.phase)
                if guest and message.phase is phase:
                    visit()
                    orders.worst = order

        try:
            self.outcome = Pilot(
                mission,
                connect=lambda waiting: connect(self.lab, hear),
                source=SteppedPoses(self.lab, LIMITS.pose),
                report=hear,
                orders=orders,
                clock=self.lab.clock,
            ).fly()
            self.reason, self.code = self.outcome.reason, self.outcome.exit_code
        except CfplanError as error:
            self.outcome, self.reason, self.code = None, str(error), error.exit_code


@pytest.mark.parametrize(
    "firmware",
    slow_unless([("2026.08", 12)], [("2025.09.1", 10), ("2026.04", 12), ("2026.08", 12)]),
    ids=lambda each: each[0],
)
@pytest.mark.parametrize("auto_arming", [False, True])
def test_a_vehicle_as_it_comes_flies(mission, firmware, auto_arming):
    version, protocol = firmware
    accepting = replace(LIMITS, firmware=replace(LIMITS.firmware, oldest=YAW_CORRECT))
    flown = Flown(replace(mission, limits=accepting), firmware=version, protocol=protocol, auto_arming=auto_arming)
    assert flown.code is ExitCode.OK, flown.reason
    assert flown.outcome.deviation.max < 0.1


@pytest.mark.parametrize("rule", PARAMETER_RULES, ids=lambda rule: rule.name)
def test_each_parameter_that_is_wrong_on_board_keeps_the_vehicle_on_the_floor(mission, rule):
    wrong = wrong_on_board(rule, LIMITS)
    flown = Flown(mission, stored={rule.name: wrong}, stubborn=(rule.name,))
    assert flown.code is ExitCode.PREFLIGHT
    assert f"{rule.name}: {wrong:g}, must be {rule.threshold(LIMITS)}" in flown.reason
    (check,) = (check for check in flown.outcome.checks if check.name == rule.name)
    assert rule.reason in check.hint
    assert rule.hint in check.hint
    assert Phase.ARM not in flown.phases
    assert not flown.armed


@pytest.mark.parametrize("rule", slow_unless(ARE_SET[:2], ARE_SET), ids=lambda rule: rule.name)
def test_what_is_set_flies_whatever_it_was_before(mission, rule):
    unwatched = replace(LIMITS, firmware=replace(LIMITS.firmware, watchdog=False))
    flown = Flown(replace(mission, limits=unwatched), stored={rule.name: wrong_on_board(rule, LIMITS)})
    assert flown.code is ExitCode.OK, flown.reason
    assert flown.lab.vehicle.firmware.parameters[rule.name] == pytest.approx(rule.value(LIMITS))


@pytest.mark.parametrize(
    ("sign", "guest", "period", "auto_arming"),
    [
        (0, SPIN_UP, 1.0, True),
        (1, GOES_NOWHERE, ONCE, True),
        (2, ASKS_TWICE_A_SECOND, 0.5, False),
        (3, HOVER_HERE, 0.02, True),
        (3, ZERO_ATTITUDE, 0.02, True),
    ],
)
def test_another_commander_is_heard_before_arming(mission, sign, guest, period, auto_arming):
    flown = Flown(mission, guest, period=period, auto_arming=auto_arming)
    assert flown.code is ExitCode.PREFLIGHT
    assert COMMANDER_SIGNS[sign].name in flown.reason
    assert Phase.ARM not in flown.phases


@pytest.mark.parametrize("phase", [Phase.ARM, Phase.GO_TO_START, Phase.STREAM, Phase.LAND])
def test_a_motor_test_that_starts_after_preflight_is_ended_and_the_vehicle_lands(mission, phase):
    flown = Flown(mission, MOTOR_TEST, phase, period=ONCE)
    if phase is not Phase.LAND:  # it was landing already
        assert flown.code is ExitCode.ENDED_BY_SAFETY
        assert "a motor test is on" in flown.reason
    assert (Phase.LAND in flown.phases) == (phase is not Phase.ARM)
    assert flown.lab.vehicle.firmware.parameters["motorPowerSet.enable"] == 0
    assert not flown.lab.vehicle.firmware.supervisor.crashed


def test_a_cut_stops_the_motors_of_a_vehicle_under_a_motor_test(mission):
    flown = Flown(mission, MOTOR_TEST, Phase.STREAM, period=ONCE, order=Order.CUT)
    assert flown.code is ExitCode.ENDED_BY_OPERATOR
    assert flown.lab.vehicle.firmware.supervisor.locked
    assert flown.lab.vehicle.firmware.parameters["motorPowerSet.enable"] == 0
    assert not flown.lab.vehicle.motors.any()


@pytest.mark.parametrize("guest", [HOVER_HERE, ZERO_ATTITUDE])
def test_one_that_an_unarmed_vehicle_does_not_obey_is_heard_before_take_off(mission, guest):
    flown = Flown(mission, guest)
    assert flown.code is ExitCode.PREFLIGHT
    assert "the controller has a setpoint" in flown.reason
    assert Phase.TAKE_OFF not in flown.phases
    flown.lab.clock.sleep(0.2)
    assert not flown.lab.vehicle.firmware.supervisor.armed


def test_before_2026_08_a_joystick_at_rest_is_heard_only_by_what_it_does(mission):
    """What the table says cannot be known: the modes of a setpoint are not logged."""
    flown = Flown(mission, ZERO_ATTITUDE, firmware="2026.04", auto_arming=True)
    assert all(check.passed for check in flown.outcome.checks)
    assert flown.code is not ExitCode.OK
    assert flown.lab.truth().position[:, 2].max() < 0.2


def test_gains_that_may_fly_fly_what_the_dry_run_flew():
    """Every gain at an end of what is accepted, kR_xy and kw_xy in the direction in which they hurt most."""
    flight = prepare_flight(REPOSITORY / "flights" / "line.yaml", LIMITS)
    own = gains_for(LIMITS.airframe)
    rules = {rule.name: rule for rule in PARAMETER_RULES}
    trajectory, state = flight.planned.plan.trajectory, flight.planned.plan.trajectory.at(0.0)

    def deviation(gains):
        loop = fly_setpoints(
            flight.encoded.decoded,
            flight.encoded.times,
            LIMITS.airframe,
            hovering(LIMITS.airframe, state.position, float(state.yaw)),
            duration=trajectory.duration,
            conditions=Conditions(gains),
        )
        return np.linalg.norm(loop.position - trajectory.at(loop.time).position, axis=1).max()

    for end in (0, 1):
        ends = {
            field.name: rules[name].allowed(LIMITS)[-1][end if field.name != "kw_xy" else 1 - end]
            for field, name in zip(fields(own), GAIN_PARAMETERS, strict=True)
        }
        assert deviation(replace(own, **ends)) < deviation(own) + 0.01


def test_a_vehicle_that_refused_stays_unlocked(mission):
    flown = Flown(mission, stored={"colAv.enable": 1})
    assert flown.lab.vehicle.firmware.supervisor.state is not State.LOCKED
