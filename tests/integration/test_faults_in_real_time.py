"""Faults that need real processes, sockets and clients: virtual Vicon, cflib, and a pilot in a process of its own."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from cfplan.errors import ExitCode
from cfplan.flight.clock import monotonic
from cfplan.flight.mocap.source import pose_source
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.pilot.process import fly
from cfplan.flight.telemetry import Event, SetpointSent
from cfplan.preparation.prepare_flight import prepare_mission
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.lab.lab import Lab, start_lab
from cfplan.simulation.lab.radio import RadioFault, RadioFaultKind
from cfplan.simulation.lab.room import RoomSettings
from cfplan.simulation.lab.sim_driver import SimDriver
from cfplan.simulation.virtual_vicon.cameras import ViconSettings
from cfplan.simulation.virtual_vicon.faults import FaultKind, ViconFault

REPOSITORY = Path(__file__).parents[2]
AT = 150  # setpoints into the stream

pytestmark = [pytest.mark.integration, pytest.mark.slow]


def pilot() -> int:
    (found,) = [child.pid for child in multiprocessing.active_children() if child.name == "pilot"]
    assert found is not None
    return found


def children(parent: int) -> list[int]:
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            stat, command = (folder / "stat").read_text(), (folder / "cmdline").read_bytes()
        except OSError:  # it has ended meanwhile
            continue
        if int(stat.rpartition(")")[2].split()[1]) == parent and b"cfplan.flight.mocap.child" in command:
            found.append(int(folder.name))
    return found


def kill_driver(_: Lab) -> None:
    (child,) = children(pilot())
    os.kill(child, signal.SIGKILL)


def stall(seconds: float) -> Callable[[Lab], None]:
    def act(_: Lab) -> None:
        stopped = pilot()
        os.kill(stopped, signal.SIGSTOP)
        threading.Timer(seconds, os.kill, (stopped, signal.SIGCONT)).start()

    return act


def disturb(fault) -> Callable[[Lab], None]:
    return lambda lab: lab.disturb(fault)


ROWS = {
    "driver killed": (kill_driver, "vicon", (Rung.BRAKE, Rung.LAND)),
    "vendor's client killed": (kill_driver, "vicon-sdk", (Rung.BRAKE, Rung.LAND)),
    "connection reset for 0.5 s": (disturb(ViconFault(FaultKind.CLOSE, 0.0, 0.5)), "vicon", (Rung.LAND,)),
    "poses stop for 0.3 s": (disturb(ViconFault(FaultKind.OCCLUDE, 0.0, 0.3)), "vicon", (Rung.BRAKE,)),
    "radio loses 30 %": (disturb(RadioFault(RadioFaultKind.LOSS, 0.0, 20.0, 0.3)), "vicon", (Rung.NONE,)),
    # The vehicle's watchdog locks it 1 s after the last keep-alive packet, which may be 0.1 s before the radio dies.
    "radio dead for 0.8 s": (disturb(RadioFault(RadioFaultKind.DEAD, 0.0, 0.8)), "vicon", (Rung.LAND,)),
    "pilot stopped for 0.6 s": (stall(0.6), "vicon", (Rung.BRAKE, Rung.LAND)),
}


@pytest.fixture(scope="module")
def line():
    mission = prepare_mission(REPOSITORY / "flights" / "line.yaml", load_limits(REPOSITORY / "safety.yaml"))
    return replace(mission, limits=replace(mission.limits, lateness=0.1))  # other tests may run beside this


@pytest.mark.parametrize("row", ROWS)
def test_a_fault_in_real_time_comes_to_its_rung_and_the_vehicle_to_the_ground(row, line):
    act, system, rungs = ROWS[row]
    said, struck = [], []
    room = RoomSettings(vicon=ViconSettings(subject="cf1"))
    with start_lab(line.limits.airframe, room=room, number=4) as lab:

        def watch(message) -> None:
            if isinstance(message, Event):
                said.append(message.text)
            if isinstance(message, SetpointSent) and message.index >= AT and not struck:
                struck.append(monotonic())
                act(lab)

        outcome = fly(
            line,
            uri=lab.uri,
            drivers=[SimDriver],
            pose_source=pose_source(lab.mocap_uri.replace("vicon:", f"{system}:", 1), line.limits.pose),
            on_telemetry=watch,
        )
        truth = lab.truth()
    assert struck, outcome.reason
    assert outcome.rung in rungs, outcome.reason
    assert (outcome.exit_code is ExitCode.OK) == (outcome.rung is Rung.NONE)
    assert truth.position[-1, 2] < 0.05
    assert not truth.motor[-1].any()
    assert not truth.locked
    assert truth.off_in_air[-1] == 0
