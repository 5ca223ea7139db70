"""A gap in the setpoints, flown in the stepped lab against the simulation of gaps."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cfplan.flight.pilot.mission import Mission
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.setpoints.encoding import RATE
from cfplan.flight.setpoints.packets import decode
from cfplan.flight.setpoints.rate_trade import gains_under
from cfplan.flight.setpoints.stops import encode_stops
from cfplan.preparation.prepare_flight import prepare_mission
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.draws import draw_vehicles
from cfplan.simulation.glitches import GAP, glitch_at_every_setpoint, glitch_at_sampled_setpoints
from cfplan.simulation.lab.stepped_lab import SteppedLab
from studies.stepped_flight import Scenario, fly_stepped

REPOSITORY = Path(__file__).parents[2]
LOOP = REPOSITORY / "tests" / "data" / "loop_that_a_gap_loses.npz"
"""Setpoints of an earlier plan of flights/loop3d.yaml: after some gaps the vehicle strays for 1.5 s, and is lost."""
pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def loop():
    """The loop, for the vehicle without a moment by velocity, for which it was planned."""
    limits = load_limits(REPOSITORY / "safety.yaml")
    plain = replace(limits.airframe, velocity_moment=(0.0, 0.0), thrust_scale=1.0, lift_with_speed=0.0)
    limits = replace(limits, airframe=plain)
    payloads = np.load(LOOP)["payloads"]
    stops = encode_stops(decode(payloads), RATE, gains=gains_under(limits), space=limits.space)
    return Mission(payloads, stops, limits)


def test_gaps_that_lose_the_vehicle_in_the_lab_lose_it_in_the_simulation(loop):
    """By the true state, the simulation did not lose it at 2.45 s and 2.6 s."""
    found = glitch_at_every_setpoint(loop.payloads, loop.limits)
    for moment, rung in ((1.2, Rung.NONE), (2.45, Rung.CUT), (2.55, Rung.CUT), (2.6, Rung.CUT), (4.5, Rung.NONE)):
        # The stall adds to the period between two setpoints.
        flown = fly_stepped(Scenario("gap", rung, moment=moment, stall=GAP - 1 / RATE), loop)
        assert flown.outcome is not None
        assert flown.outcome.rung is rung, (moment, flown.reason)
        assert found.lost[0, round(moment * RATE)] == (rung is Rung.CUT), moment


@pytest.mark.slow
def test_the_plan_of_that_loop_as_it_is_now_loses_no_drawn_vehicle_at_its_worst_moments():
    limits = load_limits(REPOSITORY / "safety.yaml")
    mission = prepare_mission(REPOSITORY / "flights" / "loop3d.yaml", limits)
    usage = glitch_at_sampled_setpoints(mission.payloads, limits).usage(limits)[0]
    worst = int(np.argmax(usage))
    vehicles = [limits.airframe, *(draw.airframe for draw in draw_vehicles(limits.airframe, limits.pose, 4))]
    for number in (worst - 8, worst, worst + 8):
        scenario = Scenario("gap", Rung.NONE, moment=number / RATE, stall=GAP - 1 / RATE)
        for seed, airframe in enumerate(vehicles):
            flown = fly_stepped(scenario, mission, lab=SteppedLab(airframe, vehicle=scenario.vehicle, seed=seed))
            assert flown.outcome is not None
            assert flown.outcome.rung is Rung.NONE, (number, airframe, flown.reason)
