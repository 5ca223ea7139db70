"""Fleets in real time: a pilot's process for each virtual vehicle, the conductor in the main process."""

import json
import os
import shlex
import signal
import subprocess
import sys
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pages
import pytest
from septic_flight import septic_payloads

from cfplan.errors import ExitCode
from cfplan.flight.fleet.conductor import ConductedFlight
from cfplan.flight.fleet.fly_together import FleetPilot, fly_together
from cfplan.flight.pilot.keys import Keyboard
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.pilot.process import start_pilot
from cfplan.flight.setpoints.packets import decode, encode
from cfplan.flight.setpoints.stops import encode_stops
from cfplan.flight.telemetry import Phase, PhaseEntered
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.lab.downwash import contacts
from cfplan.simulation.lab.sim_driver import SimDriver
from cfplan.steering.fleet_room import FleetRoom, VehiclePlace

pytestmark = [pytest.mark.integration, pytest.mark.slow]

REPOSITORY = Path(__file__).parents[2]
SHIPPED = load_limits(REPOSITORY / "safety.yaml")
LIMITS = replace(  # the computer that runs tests stands still now and then
    SHIPPED, pose=replace(SHIPPED.pose, age_brake=0.5, age_land=1.5), lateness=0.1
)
NAMES = ("left", "right")


def mission(y: float) -> Mission:
    """1.2 m along x at this y, in 4 s."""
    setpoints = decode(septic_payloads(1.2, 4.0, 0.6))
    payloads = encode(replace(setpoints, position=setpoints.position + np.array((0.0, y, 0.0))))
    return Mission(payloads, encode_stops(decode(payloads), 100.0), LIMITS, hold_time=0.5)


def fly_two(react=lambda name, message, pilots: None):
    """Fly two vehicles side by side; return the outcome and the truth of each."""
    missions = {name: mission(0.6 * number) for number, name in enumerate(NAMES)}
    places = [
        VehiclePlace(f"sim://{number}", name, missions[name].start[0][:2], missions[name].start[1])
        for number, name in enumerate(NAMES)
    ]
    with ExitStack() as stack:
        room = stack.enter_context(FleetRoom(places, LIMITS))
        processes = {name: stack.enter_context(start_pilot([SimDriver])) for name in NAMES}
        keyboard = stack.enter_context(Keyboard(keys=False))
        pilots = [
            FleetPilot(
                ConductedFlight(place.body, missions[place.body].start[0], 0.0), missions[place.body], place.uri,
                room.poses(place.body), processes[place.body],
            )
            for place in places
        ]  # fmt: skip
        outcome = fly_together(
            pilots, 0.3, listen=lambda name, message: react(name, message, processes), keyboard=keyboard
        )
        return outcome, {name: room.lab.truth(number) for number, name in enumerate(NAMES)}


def assert_down(truths):
    assert not contacts(truths, LIMITS.airframe)
    for truth in truths.values():
        assert truth.position[-1, 2] < 0.05


def test_two_vehicles_start_together_and_land():
    outcome, truths = fly_two()
    assert outcome.exit_code is ExitCode.OK, outcome.ends
    starts = [outcome.outcomes[name].first_setpoint for name in NAMES]
    assert max(starts) - min(starts) < 0.015
    assert min(starts) >= outcome.begins
    assert outcome.nearest > 0.5
    assert_down(truths)


def test_the_other_brakes_when_the_process_of_a_pilot_is_killed():
    killed = False

    def kill(name, message, pilots):
        nonlocal killed
        if name == "left" and isinstance(message, PhaseEntered) and message.phase is Phase.STREAM and not killed:
            killed = True
            os.kill(pilots["left"].process.pid, signal.SIGKILL)

    outcome, truths = fly_two(kill)
    assert outcome.ends["left"].exit_code is ExitCode.LINK_LOST
    assert "left" in outcome.ends["right"].reason
    assert outcome.exit_code is ExitCode.LINK_LOST
    assert truths["right"].position[:, 0].max() < 0.5
    assert_down(truths)


@pytest.mark.parametrize("line", pages.lines_for(pages.FLEETS))
def test_a_fleet_lands_as_it_is_shown(tmp_path, line):
    command = [sys.executable, "-m", *shlex.split(line), "--records", tmp_path, "--json"]
    ended = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    (flight,) = tmp_path.iterdir()
    vehicles = json.loads(ended.stdout)["vehicles"]
    assert len(vehicles) == len([each for each in flight.iterdir() if each.is_dir()]) == 2
