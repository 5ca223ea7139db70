"""Fleets in real time: a pilot's process for each virtual vehicle, the conductor in the main process."""

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pages
import pytest
from inline_crazyradio import radio_of_virtual_vehicles
from septic_flight import septic_payloads
from waiting import until

from cfplan.errors import ExitCode, FlightEndedError, InputError, RequestRefusedError
from cfplan.flight.fleet.conductor import ConductedFlight, Conductor
from cfplan.flight.fleet.dongle_process import SharedDongles, shared_uri
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
from cfplan.steering.connected_fleet import connect_fleet
from cfplan.steering.fleet_room import FleetRoom, VehiclePlace

pytestmark = [pytest.mark.integration, pytest.mark.slow]

REPOSITORY = Path(__file__).parents[2]
SHIPPED = load_limits(REPOSITORY / "safety.yaml")
LIMITS = replace(  # the computer that runs tests stands still now and then
    SHIPPED, pose=replace(SHIPPED.pose, age_brake=0.5, age_land=1.5), lateness=0.1
)
NAMES = ("left", "right")
ADDRESSES = {name: f"radio://0/80/2M/E7E7E7E70{number}" for number, name in enumerate(NAMES)}
DOWN = 0.05  # m, below which a vehicle is on the floor


def mission(y: float) -> Mission:
    """1.2 m along x at this y, in 4 s."""
    setpoints = decode(septic_payloads(1.2, 4.0, 0.6))
    payloads = encode(replace(setpoints, position=setpoints.position + np.array((0.0, y, 0.0))))
    return Mission(payloads, encode_stops(decode(payloads), 100.0), LIMITS, hold_time=0.5)


def fly_two(react=lambda name, message, pids: None, *, dongle: bool = False):
    """Fly two vehicles side by side; return the outcome and the truth of each, once both are down.

    With `dongle` they share a Crazyradio, which is simulated at the level of USB. `react` gets each message of a pilot
    and the process numbers of the pilots, by their vehicles' names, and of the "dongle".
    """
    missions = {name: mission(0.6 * number) for number, name in enumerate(NAMES)}
    places = [
        VehiclePlace(f"sim://{number}", name, missions[name].start[0][:2], missions[name].start[1])
        for number, name in enumerate(NAMES)
    ]
    with ExitStack() as stack:
        room = stack.enter_context(FleetRoom(places, LIMITS))
        uris, drivers = {place.body: place.uri for place in places}, {name: [SimDriver] for name in NAMES}
        if dongle:
            ports = dict(enumerate(room.lab.ports))
            shared = stack.enter_context(SharedDongles(ADDRESSES, partial(radio_of_virtual_vehicles, ports)))
            uris = {name: shared_uri(address) for name, address in ADDRESSES.items()}
            drivers = {name: shared.drivers(name) for name in NAMES}
        processes = {name: stack.enter_context(start_pilot(drivers[name])) for name in NAMES}
        pids = {name: pilot.process.pid for name, pilot in processes.items()}
        if dongle:
            shared.hand_over()
            pids["dongle"] = shared.processes["0"].pid
        keyboard = stack.enter_context(Keyboard(keys=False))
        pilots = [
            FleetPilot(
                ConductedFlight(place.body, missions[place.body].start[0], 0.0), missions[place.body], uris[place.body],
                room.poses(place.body), processes[place.body],
            )
            for place in places
        ]  # fmt: skip
        conductor = Conductor([pilot.flight for pilot in pilots], 0.3, 0.03)
        outcome = fly_together(
            pilots, conductor, listen=lambda name, message: react(name, message, pids), keyboard=keyboard
        )
        assert until(lambda: all(room.lab.truth(number).position[-1, 2] < DOWN for number in range(2)))
        return outcome, {name: room.lab.truth(number) for number, name in enumerate(NAMES)}


def assert_down(truths):
    assert not contacts(truths, LIMITS.airframe)
    for truth in truths.values():
        assert truth.position[-1, 2] < DOWN


def test_two_vehicles_start_together_and_land():
    outcome, truths = fly_two()
    assert outcome.exit_code is ExitCode.OK, outcome.ends
    starts = [outcome.outcomes[name].first_setpoint for name in NAMES]
    assert max(starts) - min(starts) < 0.015
    assert min(starts) >= outcome.begins
    assert outcome.nearest > 0.5
    assert_down(truths)


def kill_when_flying(which: str, number: signal.Signals = signal.SIGKILL):
    """Return a listener that sends a signal to a process once the vehicle `left` begins its path."""
    killed = False

    def kill(name, message, pids):
        nonlocal killed
        if name == "left" and isinstance(message, PhaseEntered) and message.phase is Phase.STREAM and not killed:
            killed = True
            os.kill(pids[which], number)

    return kill


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP], ids=["dies", "hangs"])
def test_both_are_lost_and_come_down_when_the_process_of_their_dongle(number):
    outcome, truths = fly_two(kill_when_flying("dongle", number), dongle=True)
    for name in NAMES:
        assert outcome.ends[name].exit_code is ExitCode.LINK_LOST, outcome.ends
    assert outcome.brakes
    assert_down(truths)


def test_the_other_brakes_when_the_process_of_a_pilot_is_killed():
    outcome, truths = fly_two(kill_when_flying("left"))
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


def test_a_program_flies_a_fleet_as_the_page_shows(tmp_path, monkeypatch, capsys):
    shutil.copytree(REPOSITORY / "flights", tmp_path / "flights")
    shutil.copy(REPOSITORY / "safety.yaml", tmp_path)
    monkeypatch.chdir(tmp_path)
    page = (REPOSITORY / "docs" / "fleets.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"^```python\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    names: dict = {}
    exec(block, names)
    fleet = names["fleet"]
    assert fleet.outcome.exit_code is ExitCode.OK, fleet.outcome.ends
    assert fleet.outcome.nearest > fleet.plan.apart - 0.1
    assert set(fleet.summary) == {"weave", "short"}
    assert "weave" in capsys.readouterr().out


def narrow_room(folder: Path, *uris: str) -> Path:
    """Write a fleet of two lines 1 m apart; return its file."""
    for number, name in enumerate(NAMES):
        (folder / f"{name}.yaml").write_text(
            f"waypoints: [[0, {number}, 0.8], [0.6, {number}, 0.8]]\nshape: min-snap\n"
        )
    addresses = [f", uri: '{uri}'" for uri in uris] or ["", ""]
    lines = [f"  {name}: {{path: {name}.yaml{uri}}}\n" for name, uri in zip(NAMES, addresses, strict=True)]
    (folder / "fleet.yaml").write_text("vehicles:\n" + "".join(lines))
    return folder / "fleet.yaml"


def put_in_place_of_a_crazyradio(monkeypatch, ports):
    """Simulate a Crazyradio 2.0; `ports` maps the last bytes of its vehicles' addresses to their UDP ports."""
    open_radio = partial(radio_of_virtual_vehicles, ports)
    monkeypatch.setattr("cfplan.steering.connected_fleet.SharedDongles", partial(SharedDongles, open_radio=open_radio))
    monkeypatch.setattr("cfplan.steering.fleet_addresses.find_radios", lambda: [SimpleNamespace(bcdDevice=0x0501)])
    monkeypatch.setattr("cfplan.flight.radio.crazyradio.check_radio", lambda uri: None)


@pytest.mark.parametrize("dongle", [False, True], ids=["a link each", "one dongle"])
def test_a_fleet_with_addresses_flies_by_the_poses_of_a_motion_capture_system(tmp_path, monkeypatch, dongle):
    places = [VehiclePlace(f"sim://{number}", name, (0.0, float(number))) for number, name in enumerate(NAMES)]
    with FleetRoom(places, LIMITS) as room:
        mocap = room.lab.mocap_uri.rpartition("/")[0]
        uris = [f"udp://127.0.0.1:{port}" for port in room.lab.ports]
        if dongle:
            uris = list(ADDRESSES.values())
            put_in_place_of_a_crazyradio(monkeypatch, dict(enumerate(room.lab.ports)))
        file = narrow_room(tmp_path, *uris)
        with connect_fleet(file, mocap=mocap, safety=LIMITS, records=None) as fleet:
            with pytest.raises(InputError, match="take_off"):
                fleet.fly()
            fleet.take_off()
            for change in (fleet.replace, fleet.fly, fleet.extend, fleet.stop, fleet.slower, fleet.ask, fleet.request):
                with pytest.raises(RequestRefusedError, match="in the air"):
                    change([[0, 0, 1]])
            assert not fleet.begun
            fleet.finish()
            with pytest.raises(FlightEndedError):
                fleet.fly()
        assert fleet.outcome.exit_code is ExitCode.OK, fleet.outcome.ends
        truths = {name: room.lab.truth(number) for number, name in enumerate(NAMES)}
    assert_down(truths)
    assert all(truth.position[:, 0].max() > 0.5 for truth in truths.values())


def test_swapped_bodies_are_refused_before_anything_is_armed(tmp_path):
    places = [VehiclePlace(f"sim://{number}", name, (0.0, 1.0 - number)) for number, name in enumerate(NAMES)]
    with FleetRoom(places, LIMITS) as room:
        mocap = room.lab.mocap_uri.rpartition("/")[0]
        file = narrow_room(tmp_path, *(f"udp://127.0.0.1:{port}" for port in room.lab.ports))
        fleet = connect_fleet(file, mocap=mocap, safety=LIMITS, records=None)
        with fleet, pytest.raises(FlightEndedError, match="swapped"):
            fleet.take_off()
        truths = [room.lab.truth(number) for number in range(2)]
    assert all(not truth.motor.any() for truth in truths)
