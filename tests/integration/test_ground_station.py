"""MAVSDK as the ground station of a flight on the virtual Crazyflie: what it sees, and what it can do.

The flight is stepped: it stands still while MAVSDK, which goes by the computer's clock, looks at it or acts.
"""

import contextlib
import math
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from mavsdk import ComponentType, Configuration, ConnectionResult, Mavsdk
from mavsdk.plugins.action import Action, ActionError, ActionResult
from mavsdk.plugins.telemetry import Telemetry as StationTelemetry
from stepped_flight import Flight, at_setpoint, fly_stepped
from waiting import PATIENCE, until

from cfplan.errors import ExitCode
from cfplan.flight.clock import BEGIN
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.pilot.outcome import FlightOutcome, Rung
from cfplan.flight.radio.supervisor_bits import ARMED
from cfplan.flight.telemetry import Estimate, Phase, PhaseEntered, Telemetry, VehicleStatus
from cfplan.recording.mavlink.bridge import GroundStation, Place
from cfplan.recording.mavlink.frames import ned

pytestmark = pytest.mark.integration
SCRIPTS = Path(sys.executable).parent


class Station:
    """MAVSDK's ground station; it knows the vehicle from its first heartbeat on."""

    def __init__(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            self.place = Place("127.0.0.1", probe.getsockname()[1])
        kind = Configuration.create_with_component_type(ComponentType.GROUND_STATION)
        self._mavsdk = Mavsdk(kind)
        opened = self._mavsdk.add_any_connection(f"udpin://127.0.0.1:{self.place.port}")
        assert opened is ConnectionResult.SUCCESS
        self.telemetry: StationTelemetry | None = None
        self.action: Action | None = None

    def meet(self) -> None:
        """Wait for the vehicle."""
        system = self._mavsdk.first_autopilot(timeout_s=PATIENCE)
        assert system is not None
        self.telemetry, self.action = StationTelemetry(system), Action(system)

    def close(self) -> None:
        for plugin in (self.telemetry, self.action):
            if plugin is not None:
                plugin.destroy()
        self._mavsdk.destroy()


@dataclass
class Seen:
    """What the ground station showed at one moment, beside what the pilot reported."""

    armed: tuple[bool, bool]
    # as the ground station shows it, as the pilot reported it
    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    voltage: tuple[float, float]
    estimate: Estimate


@dataclass
class Watched:
    """One flight with its ground station."""

    log: Path
    outcome: FlightOutcome | None = None
    seen: dict[str, Seen] = field(default_factory=dict)
    refused: list[ActionResult] = field(default_factory=list)


@pytest.fixture
def station() -> Iterator[Station]:
    made = Station()
    yield made
    made.close()


def fly_with(station: Station, mission: Mission, log: Path, react: Callable[[Telemetry], None]) -> Flight:
    """Fly, told by a ground station as well as by the keys."""
    with GroundStation(station.place, log, boot=BEGIN) as link:
        station.meet()

        def tell(message: Telemetry) -> None:
            link.show(message)
            react(message)

        flight = fly_stepped(mission, tell, more_orders=link.orders)
    assert link.failure == ""
    return flight


def refused(action: Callable[[], object]) -> ActionResult:
    with pytest.raises(ActionError) as caught:
        action()
    return caught.value.result


@pytest.fixture(scope="module")
def landed(mission, tmp_path_factory) -> Watched:
    """A flight that the ground station looks at, tries to arm and to take off with, and lands."""
    with contextlib.closing(Station()) as station:
        return watched_flight(station, mission, tmp_path_factory.mktemp("log") / "flight.tlog")


def watched_flight(station: Station, mission: Mission, log: Path) -> Watched:
    watched = Watched(log)
    newest: Estimate | None = None
    status: VehicleStatus | None = None

    def shown() -> Seen:
        assert newest is not None
        assert status is not None
        telemetry = station.telemetry
        place, turn = telemetry.position_velocity_ned().position, telemetry.attitude_quaternion()
        return Seen(
            armed=(telemetry.armed(), bool(status.supervisor & ARMED)),
            position=(place.north_m, place.east_m, place.down_m),
            quaternion=(turn.w, turn.x, turn.y, turn.z),
            voltage=(telemetry.battery().voltage_v, status.battery_voltage),
            estimate=newest,
        )

    def up_to_date() -> bool:
        seen = shown()
        return (
            seen.armed[0] == seen.armed[1]
            and math.isclose(*seen.voltage, abs_tol=0.001)
            and math.dist(seen.position, ned(seen.estimate.position)) < 0.001
        )

    def look(name: str) -> None:
        assert until(up_to_date)
        watched.seen[name] = shown()

    def land() -> None:
        look("air")
        watched.refused += [refused(station.action.arm), refused(station.action.disarm)]
        station.action.land()

    at_full_speed = at_setpoint(120, land)

    def react(message: Telemetry) -> None:
        nonlocal newest, status
        if isinstance(message, Estimate):
            newest = message
        elif isinstance(message, VehicleStatus):
            status = message
        elif isinstance(message, PhaseEntered) and message.phase is Phase.ARM:
            look("ground")
            watched.refused += [refused(station.action.arm), refused(station.action.takeoff)]
        at_full_speed(message)

    watched.outcome = fly_with(station, mission, log, react).outcome
    return watched


def test_a_ground_station_sees_position_attitude_battery_and_arming(landed):
    ground, air = landed.seen["ground"], landed.seen["air"]
    assert ground.armed[0] == ground.armed[1]
    assert air.armed == (True, True)
    x, y, z = air.estimate.position
    assert math.dist(air.position, (y, x, -z)) < 0.001
    assert air.position[2] < -0.4
    w, qx, qy, qz = air.quaternion
    facing_east = np.array([math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)])
    assert abs(np.dot([w, qx, qy, qz], facing_east)) > 0.95
    assert ground.voltage[0] == pytest.approx(4.15, abs=0.1)
    assert air.voltage[0] == pytest.approx(air.voltage[1], abs=0.001)


def test_arming_and_taking_off_are_refused(landed):
    assert landed.refused == [ActionResult.COMMAND_DENIED] * 4


def test_the_ground_station_lands_the_vehicle_as_a_key_does(landed):
    assert landed.outcome.exit_code is ExitCode.ENDED_BY_OPERATOR
    assert landed.outcome.rung is Rung.LAND
    assert landed.outcome.reason == "the operator ended the flight"


def test_mavlogdump_reads_the_flight_and_nothing_is_lost(landed):
    dumped = subprocess.run(
        [sys.executable, SCRIPTS / "mavlogdump.py", landed.log], capture_output=True, text=True, timeout=120, check=True
    )
    for kind in ("HEARTBEAT", "LOCAL_POSITION_NED", "ODOMETRY", "BATTERY_STATUS", "STATUSTEXT", "COMMAND_ACK"):
        assert kind in dumped.stdout
    lost = subprocess.run(
        [sys.executable, SCRIPTS / "mavloss.py", landed.log], capture_output=True, text=True, timeout=120, check=True
    )
    assert " 0 lost" in lost.stdout


@pytest.mark.parametrize("command", ["kill", "terminate"])
def test_the_ground_station_stops_the_motors(mission, station, tmp_path, command):
    def stop() -> None:
        assert getattr(station.action, command)() is ActionResult.SUCCESS

    flight = fly_with(station, mission, tmp_path / "flight.tlog", at_setpoint(80, stop))
    assert flight.outcome.exit_code is ExitCode.ENDED_BY_OPERATOR, flight.outcome.reason
    assert flight.outcome.rung is Rung.CUT
    assert not flight.truth.motor[-1].any()
    assert flight.truth.locked
