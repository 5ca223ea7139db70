"""The planner beside the pilot on a stepped clock: a flight that is to finish waits for the rest of its plan."""

import numpy as np
import pytest
from slow_cases import slow_unless

from cfplan.air.requests import PathVerdict
from cfplan.air.stepped import PlannerFault
from cfplan.errors import ExitCode
from cfplan.flight.pilot.proposals import NEXT_PART_TIMEOUT
from cfplan.steering.steered_vehicle import SteeredVehicle
from cfplan.steering.stepped_steering import SteppedSteering

WAYPOINTS = [[1, 2, 1], [-1, 3, 1], [1, -2, 1.2], [-1, -3, 1]]
FAULTS = {
    PlannerFault.STOPPED: PathVerdict.CHANGED,
    PlannerFault.LATE: PathVerdict.CUT_SHORT,
    PlannerFault.KILLED: None,  # nothing is left to answer
}


@pytest.mark.parametrize("fault", slow_unless([PlannerFault.STOPPED, PlannerFault.KILLED], FAULTS))
def test_if_the_next_part_of_a_plan_comes_late_a_finishing_vehicle_goes_on_or_says_that_it_lands_before_the_end(
    limits, fault
):
    flight = SteppedSteering(limits)
    with SteeredVehicle(flight, limits, uri="sim://0") as vehicle:
        vehicle.take_off(0.8)
        vehicle.fly(WAYPOINTS)
        flight.planner.fault = fault
        begun = vehicle.time
        vehicle.finish()
        assert [answer.verdict for answer in vehicle.answers()] == ([FAULTS[fault]] if FAULTS[fault] else [])
    assert vehicle.outcome.exit_code is ExitCode.OK
    arrived = np.linalg.norm(np.subtract(vehicle.outcome.end_position[:2], WAYPOINTS[-1][:2])) < 0.1
    assert arrived == (FAULTS[fault] is PathVerdict.CHANGED)
    if not arrived:
        assert vehicle.time - begun < NEXT_PART_TIMEOUT + 10.0


def test_behind_a_whole_plan_or_a_stop_nothing_is_waited_for(limits):
    flight = SteppedSteering(limits)
    with SteeredVehicle(flight, limits, uri="sim://0") as vehicle:
        vehicle.take_off(0.8)
        vehicle.fly(WAYPOINTS[:2])
        assert flight.planner.timeline.commitment.unfinished
        vehicle.sleep(1.0)
        assert not flight.planner.timeline.commitment.unfinished
        vehicle.fly(WAYPOINTS)
        vehicle.stop()
        assert not flight.planner.timeline.commitment.unfinished
