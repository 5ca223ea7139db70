"""A planner's process that dies or hangs while its pilot flies: both are processes of a real flight."""

import os
import signal

import numpy as np
import pytest
from stepped_flight import Flight
from waiting import PATIENCE

from cfplan.air.process import PLANNER_GONE, AirPlanner
from cfplan.air.requests import PathAnswer, PathVerdict, Wish
from cfplan.air.timeline import hold
from cfplan.errors import ExitCode
from cfplan.flight.mocap.source import pose_source
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.pilot.process import fly, start_pilot
from cfplan.flight.telemetry import SetpointSent, Telemetry
from cfplan.geometry.min_snap import centripetal_times, min_snap
from cfplan.planning.plan import plan
from cfplan.simulation.lab.sim_driver import SimDriver

pytestmark = [pytest.mark.integration, pytest.mark.slow]

WAYPOINTS = np.array([[-1.0, -2.0, 0.8], [0.8, -1.0, 1.1], [-0.6, 0.6, 0.9], [0.7, 1.8, 1.1]])


@pytest.fixture
def fly_with_planner(lab, patient_mission):
    """Flies with a planner's process; `react` sees each message and the planner, and gets its answers at the end."""
    limits = patient_mission.limits
    path = min_snap(WAYPOINTS, times=centripetal_times(WAYPOINTS))
    held = hold(plan(path, limits.airframe, limits, planner="expert"), WAYPOINTS)
    mission = Mission(held.commitment.payloads, held.commitment.stops, limits, hold_time=4.0)

    def flight(react) -> tuple[Flight, list[PathAnswer]]:
        telemetry: list[Telemetry] = []
        answers: list[PathAnswer] = []
        with start_pilot([SimDriver]) as pilot, AirPlanner(held, limits, pilot.proposals) as planner:
            while not planner.ready:
                answers += planner.answers(1.0)

            def note(message: Telemetry) -> None:
                telemetry.append(message)
                answers.extend(planner.answers())
                react(message, planner)

            source = pose_source(lab.mocap_uri, mission.limits.pose, open_within=PATIENCE)
            outcome = fly(mission, uri=lab.uri, pose_source=source, pilot=pilot, on_telemetry=note)
            answers += planner.answers(1.0)
        return Flight(outcome, telemetry, lab.truth()), answers

    return flight


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_without_its_planner_a_flight_ends_on_what_is_committed(fly_with_planner, how):
    done: list[int] = []

    def react(message: Telemetry, planner: AirPlanner) -> None:
        if isinstance(message, SetpointSent) and message.index == 100 and not done and planner.process_id:
            os.kill(planner.process_id, how)
            done.append(planner.request(Wish.REPLACE, [(0.0, 0.5, 1.0)]))

    flight, answers = fly_with_planner(react)
    assert flight.outcome.exit_code is ExitCode.OK, flight.outcome.reason
    assert done
    refused = [PathAnswer(number, PathVerdict.REFUSED, PLANNER_GONE) for number in done]
    assert answers == (refused if how is signal.SIGKILL else [])
    np.testing.assert_allclose(flight.truth.position[-1, :2], WAYPOINTS[-1, :2], atol=0.15)
