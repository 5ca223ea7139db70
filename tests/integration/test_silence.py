"""Each combination of sources that fall silent, in each phase, in the stepped lab: the vehicle lands, disarmed."""

import itertools
from pathlib import Path

import pytest
from slow_cases import slow_unless
from stepped_flight import at_setpoint, fly_stepped

from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.telemetry import Phase
from cfplan.preparation.prepare_flight import prepare_mission
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.lab.radio import RadioFault, RadioFaultKind
from cfplan.simulation.lab.stepped_lab import SteppedLab
from cfplan.simulation.virtual_crazyflie.faults import VehicleFault, VehicleFaultKind
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_vicon.faults import FaultKind, ViconFault
from studies.stepped_flight import FOR_GOOD, Scenario, fly_scenario

REPOSITORY = Path(__file__).parents[2]
MOMENTS = {Phase.TAKE_OFF: 0.9, Phase.GO_TO_START: 0.5, Phase.STREAM: 1.5, Phase.HOLD: 0.2, Phase.LAND: 0.3}  # s
PHASES = slow_unless([Phase.TAKE_OFF, Phase.STREAM], MOMENTS)
BOTH = ESTIMATE, STATUS = VehicleFaultKind.SILENT_ESTIMATE, VehicleFaultKind.SILENT_STATUS


@pytest.fixture(scope="module")
def line():
    return prepare_mission(REPOSITORY / "flights" / "line.yaml", load_limits(REPOSITORY / "safety.yaml"))


def fly_silenced(line, phase, *faults):
    return fly_scenario(Scenario("silence", Rung.LAND, faults, phase, MOMENTS[phase]), line)


def assert_down(flown):
    assert flown.to_wall > 0.0
    assert (flown.landed, flown.disarmed, flown.readable) == (True, True, True)


@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize("logs", slow_unless([BOTH], [(ESTIMATE,), (STATUS,), BOTH]))
@pytest.mark.parametrize("poses", [True, False])
def test_a_vehicle_that_acknowledges_lands_whatever_is_silent(line, phase, logs, poses):
    faults = [VehicleFault(log, 0.0, FOR_GOOD) for log in logs]
    if not poses:
        faults.append(ViconFault(FaultKind.STALL, 0.0, FOR_GOOD))
    flown = fly_silenced(line, phase, *faults)
    assert_down(flown)
    assert flown.rung == "land"
    if poses:
        assert flown.motors_off == 0
        assert flown.off_plan < 0.1


@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize("logs", slow_unless([BOTH], [(ESTIMATE,), (STATUS,), BOTH]))
def test_logs_that_come_back_for_a_moment_change_nothing(line, phase, logs):
    spans = ((0.0, 0.7), (0.8, FOR_GOOD))
    flown = fly_silenced(line, phase, *(VehicleFault(log, *span) for log, span in itertools.product(logs, spans)))
    assert_down(flown)
    assert (flown.rung, flown.motors_off) == ("land", 0)
    assert flown.off_plan < 0.1


@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize("kind", [RadioFaultKind.DEAD, RadioFaultKind.UNACKNOWLEDGED])
@pytest.mark.parametrize("silent", slow_unless([BOTH], [(), (ESTIMATE,), (STATUS,), BOTH]))
def test_a_vehicle_whose_uplink_is_gone_ends_by_link_loss_inside(line, phase, kind, silent):
    faults = (VehicleFault(log, 0.0, FOR_GOOD) for log in silent)
    assert_down(fly_silenced(line, phase, RadioFault(kind, 0.0, FOR_GOOD), *faults))


@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize("kind", [RadioFaultKind.DEAD, RadioFaultKind.UNACKNOWLEDGED])
def test_an_uplink_and_poses_that_are_both_gone_end_by_link_loss_inside(line, phase, kind):
    assert_down(fly_silenced(line, phase, RadioFault(kind, 0.0, FOR_GOOD), ViconFault(FaultKind.STALL, 0.0, FOR_GOOD)))


@pytest.mark.parametrize("kind", [RadioFaultKind.DEAD, RadioFaultKind.UNACKNOWLEDGED])
@pytest.mark.parametrize("back_after", [0.7, 1.5])
def test_logs_that_the_vehicle_deleted_while_its_radio_was_dead_are_created_anew(line, kind, back_after):
    flown = fly_silenced(line, Phase.STREAM, RadioFault(kind, 0.0, back_after))
    assert_down(flown)
    if back_after > 1.0:  # its watchdog has stopped the motors
        assert flown.rung == "cut"
        assert "nothing was acknowledged for 1." in flown.reason
    else:
        assert flown.rung == "land"


@pytest.mark.parametrize("setpoint", [60, 150])
def test_a_vehicle_that_restarts_in_the_air_is_not_flown_from_where_it_fell(line, setpoint):
    x, y, _ = line.start[0]
    lab = SteppedLab(line.limits.airframe, vehicle=VehicleSettings(position=(x, y, 0.0)))
    restarted = []

    def restart():
        restarted.append(lab.now)
        lab.clock.at(lab.now, lab.vehicle.firmware.restart)

    flown = fly_stepped(line, at_setpoint(setpoint, restart), lab=lab)
    assert flown.outcome.rung is Rung.CUT
    truth = flown.truth
    assert not truth.motor[truth.time > restarted[0] + 0.1].any()
    assert truth.position[-1, 2] < 0.05
