"""A vehicle in a room on one simulated clock: packets in, poses fed, time goes on when told."""

import struct
from collections.abc import Callable

import pytest

from cfplan.flight.radio.crtp import Port, pack
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_crazyflie.supervisor import State
from cfplan.simulation.virtual_crazyflie.vehicle import VirtualCrazyflie
from cfplan.simulation.virtual_vicon.cameras import Cameras, ViconSettings
from cfplan.vehicle.airframes import AIRFRAMES

AIRFRAME = AIRFRAMES["crazyflie-2.1+"]


class Rig:
    def __init__(self, settings: VehicleSettings | None = None, vicon: ViconSettings | None = None):
        self.airframe = AIRFRAME
        self.vehicle = VirtualCrazyflie(AIRFRAME, settings)
        self.cameras = Cameras(vicon or ViconSettings(), 0.0)
        self.feeding = True
        self.received: list[bytes] = []

    def send(self, port: Port, channel: int, payload: bytes = b"") -> list[bytes]:
        """Send a packet; the packets that answer it at once."""
        self.vehicle.receive(pack(port, channel, payload))
        answers = self.vehicle.sent()
        self.received += answers
        return answers

    def run(self, seconds: float, every_10_ms: Callable[[int], None] | None = None) -> None:
        """Let time go by, poses fed; `every_10_ms` is called with the tick of 1 ms before each step of 10."""
        end = self.vehicle.tick + round(seconds * 1000)
        while self.vehicle.tick < end:
            tick = self.vehicle.tick
            if tick / 1000 > self.cameras.next_look - 1e-9:
                self.cameras.look(tick / 1000, tuple(self.truth[0:3]), tuple(self.truth[6:10]))
            for picture in self.cameras.due(tick / 1000 + 1e-9):
                if self.feeding:
                    position, quaternion = picture.bodies[0].pose
                    self.send(Port.LOCALIZATION, 1, b"\x08" + struct.pack("<7f", *position, *quaternion))
            if every_10_ms is not None:
                every_10_ms(tick)
            self.vehicle.advance(min(10 - tick % 10, end - tick))
            self.received += self.vehicle.sent()

    @property
    def truth(self):
        return self.vehicle.truth

    @property
    def belief(self):
        return self.vehicle.firmware.stabilizer.loop.belief

    @property
    def state(self) -> State:
        return self.vehicle.supervisor_state

    @property
    def off_in_air(self) -> int:
        """Milliseconds with motors off in the air, so far."""
        return self.vehicle.off_in_air

    def set(self, name: str, value: float) -> None:
        parameters = self.vehicle.firmware.parameters
        number = parameters.toc.index()[name]
        layout = parameters.toc.variables[number].format
        self.send(Port.PARAMETERS, 2, struct.pack("<H", number) + struct.pack(layout, value))

    def prepare(self) -> None:
        """What a pilot does before take-off, in short."""
        self.set("stabilizer.controller", 2)
        self.set("stabilizer.estimator", 2)
        self.set("ctrlMel.mass", AIRFRAME.mass)
        self.set("ctrlMel.massThrust", AIRFRAME.command_per_thrust)
        self.set("locSrv.extPosStdDev", 0.003)
        self.set("locSrv.extQuatStdDev", 0.01)
        for axis, drag in zip("xyz", (AIRFRAME.drag[0], AIRFRAME.drag[0], AIRFRAME.drag[1]), strict=True):
            self.set(f"kalman.dragB_{axis}", drag / AIRFRAME.mass)
        self.run(0.2)
        for axis, value in zip("XYZ", self.truth[:3], strict=True):
            self.set(f"kalman.initial{axis}", value)
        self.set("kalman.resetEstimation", 1)
        self.run(0.8)

    def high_level(self, payload: bytes) -> int:
        """The return code of a command to the on-board planner."""
        return self.send(Port.HIGH_LEVEL, 0, payload)[-1][4]

    def take_off(self, height: float = 1.0, duration: float = 1.5) -> int:
        return self.high_level(struct.pack("<BBff?f", 7, 0, height, 0.0, True, duration))

    def land(self, height: float = 0.0, duration: float = 1.5) -> int:
        return self.high_level(struct.pack("<BBff?f", 8, 0, height, 0.0, True, duration))

    def go_to(self, x: float, y: float, z: float, yaw: float = 0.0, duration: float = 1.5) -> int:
        return self.high_level(struct.pack("<BBBBfffff", 12, 0, 0, 0, x, y, z, yaw, duration))

    def notify_setpoint_stop(self) -> None:
        self.send(Port.SETPOINT, 1, struct.pack("<BI", 0, 0))

    def hover_setpoint(self, place) -> None:
        """One full-state setpoint at rest."""
        x, y, z = (round(1000 * float(value)) for value in place)
        identity = 3 << 30
        self.send(Port.SETPOINT, 0, struct.pack("<B9hI3h", 6, x, y, z, 0, 0, 0, 0, 0, 0, identity, 0, 0, 0))

    def stream_hover(self, seconds: float) -> None:
        """Full-state setpoints at 100 Hz where the vehicle is now."""
        place = self.belief[:3].copy()
        self.run(seconds, lambda tick: self.hover_setpoint(place))


@pytest.fixture
def rig() -> Rig:
    """A vehicle on the floor, ready to take off."""
    made = Rig()
    made.prepare()
    return made


@pytest.fixture
def hovering(rig: Rig) -> Rig:
    """A vehicle in the air under its on-board planner."""
    assert rig.take_off() == 0
    rig.run(2.5)
    assert abs(rig.truth[2] - 1.0) < 0.05
    return rig


@pytest.fixture
def streamed(hovering: Rig) -> Rig:
    """A vehicle in the air that has just been sent setpoints for a while."""
    hovering.stream_hover(0.5)
    assert hovering.state is State.FLYING
    return hovering


@pytest.fixture
def make_rig() -> type[Rig]:
    return Rig
