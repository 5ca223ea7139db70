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
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.glitches import GAP, glitch_at_every_setpoint
from studies.fault_scenarios import Scenario
from studies.faults import fly_stepped

LOOP = Path(__file__).parents[1] / "data" / "loop_that_a_gap_loses.npz"
"""Setpoints of an earlier plan of flights/loop3d.yaml: after some gaps the vehicle strays for 1.5 s, and is lost."""
pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def loop():
    """The loop, for the vehicle without a moment by velocity, for which it was planned."""
    limits = load_limits(Path(__file__).parents[2] / "safety.yaml")
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
