"""A vehicle without dynamics behind the link's face, on a clock that only moves when the pilot sleeps."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from septic_flight import septic_payloads

from cfplan.errors import LinkError
from cfplan.flight.clock import SteppedClock
from cfplan.flight.firmware import NEWEST_KNOWN
from cfplan.flight.mocap.poses import Pose
from cfplan.flight.pilot.keys import HeldOrders
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.pilot.pilot import Pilot
from cfplan.flight.pilot.vehicle_rules import PARAMETER_RULES
from cfplan.flight.setpoints.packets import decode
from cfplan.flight.setpoints.stops import encode_stops
from cfplan.flight.telemetry import Estimate, Event, Phase, PhaseEntered, SetpointSent, Telemetry, VehicleStatus
from cfplan.safety.limits import (
    BatteryLimits,
    FirmwareSettings,
    FlightLimits,
    GroundManoeuvres,
    Ladder,
    Limits,
    PlanLimits,
    PoseLimits,
)
from cfplan.safety.space import Space
from cfplan.vehicle.airframes import AIRFRAMES

ARMED, CAN_FLY, FLYING, LOCKED = 1 << 1, 1 << 3, 1 << 4, 1 << 6
LEVEL = (0.0, 0.0, 0.0, 1.0)
LONGEST_STEP = 0.04  # m from one setpoint to the next, at 4 m/s


def make_limits() -> Limits:
    name = next(iter(AIRFRAMES))
    return Limits(
        vehicle=name,
        airframe=AIRFRAMES[name],
        plan=PlanLimits(2.0, 5.0, 8.0, 0.52, 0.015, 0.11, 4.9),
        flight=FlightLimits(
            deviation=Ladder(0.3, 0.6, 1.0),
            fence=Ladder(0.0, 0.1, 0.5),
            speed=Ladder(3.0, 4.0, 6.0),
            acceleration=Ladder(10.0, 15.0, 30.0),
            angular_velocity=Ladder(10.0, 15.0, 30.0),
            patience=0.1,
        ),
        space=Space((-3.0, -3.0, 0.0), (3.0, 3.0, 2.0), 0.2),
        battery=BatteryLimits(at_rest=3.9, under_load=3.2, under_load_seconds=1.0, endurance=240.0),
        pose=PoseLimits(
            rate=100.0, rate_min=50.0, latency=0.01, age_warning=0.05, age_brake=0.15, age_land=0.5, jump=0.1,
            agreement=0.03, yaw_agreement=0.1,
        ),
        firmware=FirmwareSettings(controller=2, estimator=2, oldest=(2025, 9, 1), newest=NEWEST_KNOWN),
        ground=GroundManoeuvres(take_off_height=0.5, take_off_speed=0.5, go_to_speed=0.5, land_speed=0.4),
    )  # fmt: skip


def _hover_command() -> float:
    airframe = make_limits().airframe
    return 65535 * airframe.hover_thrust / airframe.motor_thrust_max  # without a motor curve


HOVER_COMMAND = _hover_command()
GOOD_VALUES = {rule.name: rule.value(make_limits()) for rule in PARAMETER_RULES}


def make_payloads(distance: float = 2.0, duration: float = 2.0, height: float = 1.0) -> np.ndarray:
    """A straight flight along x, from rest to rest, with its yaw turning by 0.5 rad."""
    return septic_payloads(distance, duration, height, turn=0.5)


@dataclass
class World:
    """The clock, the vehicle as its link shows it, and motion capture, in one."""

    position: tuple[float, float, float] = (0.0, 0.5, 0.02)
    yaw: float = 0.0
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    voltage: float = 4.1
    firmware: str = "2026.08"
    protocol: int = 12
    uri: str = "fake://0"
    lost: str = ""
    fault: str = ""
    round_trip: float = 0.002
    parameters: dict[str, float] = field(default_factory=dict)
    unknown: tuple[str, ...] = ()
    arms_lost: int = 0  # orders to arm or disarm that the radio swallows
    cuts_lost: int = 0  # emergency stops that the radio swallows
    other_body: bool = False  # motion capture tracks one that stays on the floor
    stops_lost: int = 0  # stop setpoints and releases of priority that the radio swallows
    deaf: bool = False  # it is armed, and setpoints do not turn its motors
    floor: float = 0.02  # m, the height of a body that stands
    can_fly: bool = True  # what its supervisor says
    stubborn: dict[str, float] = field(default_factory=dict)
    replies: dict[int, int] = field(default_factory=dict)
    has_setpoint: bool = False
    extra_bits: int = 0
    pose_shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    poses_frozen: bool = False
    poses_stopped: bool = False
    estimate_silent: bool = False
    status_silent: bool = False
    status_every: int = 2  # 5 ms between reports of motors and battery
    hover_command: float = HOVER_COMMAND
    uplink_dead: bool = False
    revived: list[str] = field(default_factory=list)  # logs that the pilot created anew
    restarts: bool = True
    push: float | None = None  # m/s along y, whatever its setpoints are
    messages: list[Telemetry] = field(default_factory=list)
    forwarded: list[tuple[float, ...]] = field(default_factory=list)
    calls: list[str] = field(default_factory=list)
    signs_of_life: list[float] = field(default_factory=list)
    orders: HeldOrders = field(default_factory=HeldOrders)
    motors_off_in_the_air: float = 0.0
    armed: bool = False
    closed: bool = False
    stopped: bool = False
    motor_test: bool = False  # another client has started one

    def __post_init__(self) -> None:
        self.clock = SteppedClock(100.0, self.pass_time)
        self.motors_on = False
        self._poses: list[Pose] = []
        self._asked = (0.0, 0.0, 0.0)  # m/s, by the last setpoint
        self._count = 0
        self.motors_off_since = -math.inf
        self.estimate: Estimate | None = None
        self.status: VehicleStatus | None = None
        self.position_variance = (1e-5, 1e-5, 1e-5)
        self.acknowledged, self.log_heard = self.now, self.now
        self._logging = False

    # The clock.

    @property
    def now(self) -> float:
        return self.clock.now()

    def pass_time(self, end: float) -> None:
        while self.now < end - 1e-12:
            step = min(0.005, end - self.now)
            self.clock.reach(self.now + step)
            self._move(step)

    def when(self, phase: Phase, after: float, action: Callable[[], None]) -> None:
        """Do something so long after a phase was entered."""
        self._triggers = [*getattr(self, "_triggers", []), (phase, after, action)]

    def report(self, message: Telemetry) -> None:
        self.messages.append(message)
        if isinstance(message, PhaseEntered):
            for phase, after, action in getattr(self, "_triggers", []):
                if phase is message.phase:
                    self.clock.at(self.now + after, action)

    @property
    def phases(self) -> list[Phase]:
        return [message.phase for message in self.messages if isinstance(message, PhaseEntered)]

    @property
    def said(self) -> str:
        return "\n".join(message.text for message in self.messages if isinstance(message, Event))

    def sent(self) -> list[SetpointSent]:
        return [message for message in self.messages if isinstance(message, SetpointSent)]

    def _move(self, step: float) -> None:
        flying = self.position[2] > self.floor + 0.03
        if self.motors_on:
            self.motors_off_since = math.inf
        elif self.motors_off_since == math.inf:
            self.motors_off_since = self.now
        if flying and not self.motors_on:
            self.motors_off_in_the_air += step
        self.velocity = self._asked
        if self.push is not None:
            (x, y, z), (vx, _, vz) = self.position, self._asked
            self.position, self.velocity = (x, y + self.push * step, z), (vx, self.push, vz)
        self._count += 1
        if self._count % 2 == 0:
            self._sense()

    def _sense(self) -> None:
        wobble = 0.0 if self.poses_frozen else 1e-5 * (self._count % 7)
        place = tuple(a + b + wobble for a, b in zip(self.position, self.pose_shift, strict=True))
        turn = (0.0, 0.0, math.sin(self.yaw / 2), math.cos(self.yaw / 2))
        if self.other_body:
            place = (0.0, 0.5, 0.02 + wobble)
        if self.poses_frozen and self._poses_last is not None:
            place = self._poses_last
        if not self.poses_stopped:
            self._poses.append(Pose(self.now - 0.005, self.now, place, turn))
            self._poses_last = place
        if not self.uplink_dead:
            self.acknowledged = self.now
        if self._logging:
            flying = self.motors_on or self.now - self.motors_off_since < 2.0
            bits = (ARMED if self.armed else 0) | (FLYING if flying else 0) | self.extra_bits
            bits |= CAN_FLY if self.can_fly else 0
            motor = 4 * (round(self.hover_command) if self.motors_on else 0,)
            if not self.estimate_silent:
                self.log_heard = self.now
                self.estimate = Estimate(self.now, self.position, self.velocity, (0.0, 0.0, 0.0), turn)
            if not self.status_silent and self._count % self.status_every == 0:
                self.log_heard = self.now
                self.status = VehicleStatus(self.now, (0.0, 0.0, 0.0), motor, self.voltage, bits)

    # The pose source.

    def open(self) -> None:
        self._poses.clear()

    def poses(self) -> list[Pose]:
        came, self._poses = self._poses, []
        return came

    # The link.

    def send(self, packet) -> None:
        if self.deaf or self.stopped or self.uplink_dead:
            return
        self.motors_on = True
        state = decode(np.frombuffer(packet[1:], dtype=np.uint8))
        x, y, z = self._towards(state.position[0])
        self._asked = tuple(state.velocity[0].tolist())
        self.position = x, y if self.push is None else self.position[1], max(z, self.floor)

    def _towards(self, place: np.ndarray) -> list[float]:
        """Return where the vehicle is next on its way to a place, m: it catches up where setpoints went ahead of it."""
        way = place - self.position
        return (self.position + way * min(1.0, LONGEST_STEP / max(float(np.linalg.norm(way)), 1e-9))).tolist()

    def send_pose(self, position, quaternion) -> None:
        self.forwarded.append((self.now, *position))

    def has_parameter(self, name: str) -> bool:
        return name not in self.unknown

    def set_parameter(self, name: str, value: float) -> float:
        self.parameters[name] = self.stubborn.get(name, value)
        return self.parameters[name]

    def read_parameters(self, names) -> dict[str, float]:
        known = [name for name in names if self.has_parameter(name)]
        return {name: self.parameters.get(name, GOOD_VALUES[name]) for name in known}

    def start_logs(self) -> None:
        self._logging = True

    def stop_preflight_logs(self) -> None:
        self.calls.append("preflight logs off")

    def release_priority(self) -> None:
        self._note_once("release")

    def ask_motor_test(self) -> None:
        pass

    def end_motor_test(self) -> None:
        self.motor_test = False

    def recreate_log(self, name: str) -> None:
        if name not in self.revived:
            self.revived.append(name)

    def arm(self, do_arm: bool) -> None:
        self.calls.append("arm" if do_arm else "disarm")
        if self.arms_lost or self.uplink_dead:
            self.arms_lost = max(self.arms_lost - 1, 0)
            return
        self.armed = do_arm

    def emergency_stop(self) -> None:
        self.calls.append("emergency stop")
        if self.cuts_lost or self.uplink_dead:
            self.cuts_lost = max(self.cuts_lost - 1, 0)
            return
        self.stopped, self.armed, self.motors_on = True, False, False
        self.extra_bits |= LOCKED

    def restart(self) -> None:
        self.calls.append("restart")
        if not self.restarts:
            raise LinkError("it does not answer", where=self.uri, hint="switch it off and on by hand")

    def keep_alive(self) -> None:
        self.signs_of_life.append(self.now)

    def stop_setpoint(self) -> None:
        self._note_once("stop setpoint")
        if self.stops_lost or self.uplink_dead:
            self.stops_lost = max(self.stops_lost - 1, 0)
            return
        self.motors_on = False

    def _note_once(self, call: str) -> None:
        """Note a call, but not again where it is repeated."""
        if self.calls[-1:] != [call]:
            self.calls.append(call)

    def close(self) -> None:
        self.calls.append("close")
        self.closed = True

    _poses_last = None


@pytest.fixture
def world() -> World:
    return World()


@pytest.fixture
def mission(request: pytest.FixtureRequest) -> Mission:
    """A mission at a height of 1 m, or that of the parameter."""
    payloads = make_payloads(height=getattr(request, "param", 1.0))
    return Mission(payloads, encode_stops(decode(payloads), 100.0), make_limits())


@pytest.fixture
def limits() -> Limits:
    return make_limits()


@pytest.fixture
def fly(world, mission):
    """Flies the mission, with other limits where given."""

    def flight(**changes):
        flown = replace(mission, limits=replace(mission.limits, **changes))
        pilot = Pilot(
            flown,
            connect=lambda waiting: world,
            source=world,
            report=world.report,
            orders=world.orders,
            clock=world.clock,
        )
        return pilot.fly()

    return flight
