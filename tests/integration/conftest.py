"""A short flight, and a way to fly it in real time: real cflib, real processes."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from septic_flight import septic_payloads
from stepped_flight import Flight
from waiting import PATIENCE

from cfplan.flight.mocap.source import pose_source
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.pilot.process import fly
from cfplan.flight.setpoints.packets import decode
from cfplan.flight.setpoints.stops import encode_stops
from cfplan.flight.telemetry import Telemetry
from cfplan.safety.limits import GroundManoeuvres, Limits
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.lab.lab import Lab, start_lab
from cfplan.simulation.lab.sim_driver import SimDriver

SAFETY_FILE = Path(__file__).parents[2] / "safety.yaml"


def short_payloads(distance: float = 1.5, duration: float = 2.5, height: float = 0.6) -> np.ndarray:
    """Straight along x from rest to rest with a peak of 1.3 m/s, then half a second of hover."""
    moving = septic_payloads(distance, duration, height)
    return np.concatenate([moving, np.repeat(moving[-1:], 50, axis=0)])


@pytest.fixture(scope="session")
def limits() -> Limits:
    quick = GroundManoeuvres(take_off_height=0.5, take_off_speed=0.4, go_to_speed=0.6, land_speed=0.4)
    return replace(load_limits(SAFETY_FILE), ground=quick)


@pytest.fixture(scope="session")
def mission(limits) -> Mission:
    payloads = short_payloads()
    return Mission(payloads, encode_stops(decode(payloads), 100.0), limits, hold_time=0.5)


@pytest.fixture(scope="session")
def patient_mission(mission) -> Mission:
    """The same for real time: the computer that runs tests stands still now and then."""
    pose = replace(mission.limits.pose, age_brake=0.5, age_land=1.5)
    return replace(mission, limits=replace(mission.limits, pose=pose, lateness=0.1))


@pytest.fixture(scope="session")
def fly_in(patient_mission):
    """Flies in a lab in real time, and lets `react` see each message as it comes."""

    def flight(lab: Lab, react: Callable[[Telemetry], None] = lambda _: None) -> Flight:
        telemetry: list[Telemetry] = []

        def note(message: Telemetry) -> None:
            telemetry.append(message)
            react(message)

        source = pose_source(lab.mocap_uri, patient_mission.limits.pose, open_within=PATIENCE)
        outcome = fly(patient_mission, uri=lab.uri, drivers=[SimDriver], pose_source=source, on_telemetry=note)
        return Flight(outcome, telemetry, lab.truth())

    return flight


@pytest.fixture(scope="module")
def lab(limits):
    """One lab in real time for the flights that leave its vehicle fit to fly."""
    with start_lab(limits.airframe) as running:
        yield running
