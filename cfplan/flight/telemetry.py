"""Telemetry of the pilot: small frozen messages on the flight's clock."""

from dataclasses import dataclass
from enum import StrEnum

Triple = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class Phase(StrEnum):
    """The phases of a flight, in their order."""

    CONNECT = "connect"
    RELEASE = "release"
    CONFIGURE = "configure"
    UPLOAD = "upload"
    FEED = "feed"
    CONVERGE = "converge"
    PREFLIGHT = "preflight"
    ARM = "arm"
    TAKE_OFF = "take off"
    GO_TO_START = "go to start"
    STREAM = "stream"
    HOLD = "hold"
    LAND = "land"
    DISARM = "disarm"
    CLOSED = "closed"


@dataclass(frozen=True, slots=True)
class SetpointSent:
    """A full-state setpoint as the vehicle decodes it; of a flight on board, one that would fly the same."""

    time: float  # s, when it was handed to the link, or was due on board
    due: float  # s, its deadline; time - due is the lateness
    index: int  # row of the encoded flight
    position: Triple
    velocity: Triple
    acceleration: Triple
    quaternion: Quaternion
    body_rate: Triple


@dataclass(frozen=True, slots=True)
class PoseReceived:
    """A pose from motion capture."""

    time: float  # s, when the vehicle was there
    received: float  # s, when the pose reached the pilot
    position: Triple
    quaternion: Quaternion


@dataclass(frozen=True, slots=True)
class Estimate:
    """The vehicle's own estimate, from its log."""

    time: float
    position: Triple
    velocity: Triple
    acceleration: Triple
    quaternion: Quaternion

    def position_at(self, time: float) -> Triple:
        """Return the position, m, a moment earlier or later, s, at the same velocity."""
        (x, y, z), (vx, vy, vz), ahead = self.position, self.velocity, time - self.time
        return x + ahead * vx, y + ahead * vy, z + ahead * vz

    def velocity_at(self, time: float) -> Triple:
        """Return the velocity, m/s, a moment earlier or later, s, at the same acceleration."""
        (vx, vy, vz), (ax, ay, az), ahead = self.velocity, self.acceleration, time - self.time
        return vx + ahead * ax, vy + ahead * ay, vz + ahead * az


@dataclass(frozen=True, slots=True)
class VehicleStatus:
    """Rates, motors, battery and supervisor, from the vehicle's log."""

    time: float
    body_rate: Triple
    motor: tuple[int, int, int, int]  # 16-bit commands
    battery_voltage: float
    supervisor: int  # bits of supervisor.info


@dataclass(frozen=True, slots=True)
class PhaseEntered:
    """The pilot entered a phase."""

    time: float
    phase: Phase


class Level(StrEnum):
    """Severity of an event."""

    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


@dataclass(frozen=True, slots=True)
class Event:
    """Something that a reader of the record should know."""

    time: float
    level: Level
    text: str


@dataclass(frozen=True, slots=True)
class PlanCommitted:
    """The pilot is bound to these setpoints from now on; those before the first of them stay as they were."""

    time: float  # s
    splice: int  # number of the first of them
    checksum: int  # of the proposal, stops included; 0 for what the flight began with
    payloads: bytes  # 29 each


@dataclass(frozen=True, slots=True)
class PathRequested:
    """A change of the path was asked for."""

    time: float  # s
    number: int  # by which its answer names it
    wish: str  # extend, replace, stop, slower or faster
    waypoints: str  # as JSON: [[x, y, z], …], m


@dataclass(frozen=True, slots=True)
class PathAnswered:
    """What became of a request."""

    time: float  # s
    number: int  # of the request
    verdict: str  # accepted, refused, late or superseded
    reason: str  # why not, one line
    splice: int  # number of the first setpoint of the new plan; -1 where there is none
    joint: float  # s from setpoint 0, from when on the motion is another; NaN where there is none
    ends: float  # s from setpoint 0, when the motion ends; NaN where there is none
    seconds: float  # from the request to the answer


Telemetry = (
    SetpointSent
    | PoseReceived
    | Estimate
    | VehicleStatus
    | PhaseEntered
    | Event
    | PlanCommitted
    | PathRequested
    | PathAnswered
)
