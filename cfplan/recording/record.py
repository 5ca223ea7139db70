"""The record of a flight: its measurements, commands and decisions, on one clock, as columns."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.setpoints.encoding import controller_attitude
from cfplan.flight.setpoints.rate_trade import motion_of_sent
from cfplan.recording.header import RecordHeader
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.rotations import quaternions_of

FLIGHT_FILE = "flight.mcap"
SUMMARY_FILE = "summary.json"
PLAN_FILE = "plan.parquet"
UNCORRECTED_FILE = "uncorrected.parquet"  # the plan before its correction, if it was corrected
PLAN_IN_FLIGHT = "plan-{:08x}.parquet"  # by the checksum of its proposal, see Commitments


@dataclass(frozen=True, slots=True, eq=False)
class Setpoints:
    """The setpoints as sent; see telemetry.SetpointSent."""

    time: NDArray  # (N,) s, when each was handed to the link
    due: NDArray  # (N,) s, its deadline; it is sent ahead of the plan, see summary.reference_times()
    index: NDArray  # (N,) int, row of the encoded flight
    position: NDArray  # (N, 3) m
    velocity: NDArray  # (N, 3) m/s
    acceleration: NDArray  # (N, 3) m/s²
    quaternion: NDArray  # (N, 4) body→world, x y z w
    body_rate: NDArray  # (N, 3) rad/s


def meant_motion(setpoints: Setpoints) -> tuple[NDArray, NDArray, NDArray]:
    """Return the attitudes (N, 4), accelerations (N, 3) and body rates (N, 3) that setpoints stand for.

    The packets themselves differ, as most of the roll and pitch rates is sent as attitude.
    """
    if not len(setpoints.due):
        return setpoints.quaternion, setpoints.acceleration, setpoints.body_rate
    force = setpoints.acceleration + np.array([0.0, 0.0, GRAVITY])
    made = quaternions_of(controller_attitude(force, setpoints.quaternion))
    return motion_of_sent(setpoints.due, setpoints.acceleration, made, setpoints.body_rate)


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """The poses from motion capture; see telemetry.PoseReceived."""

    time: NDArray  # (N,) s, when the vehicle was there
    received: NDArray  # (N,) s
    position: NDArray  # (N, 3) m
    quaternion: NDArray  # (N, 4) body→world, x y z w


@dataclass(frozen=True, slots=True, eq=False)
class Estimates:
    """The vehicle's own estimates; see telemetry.Estimate."""

    time: NDArray  # (N,) s
    position: NDArray  # (N, 3) m
    velocity: NDArray  # (N, 3) m/s
    acceleration: NDArray  # (N, 3) m/s²
    quaternion: NDArray  # (N, 4) body→world, x y z w


@dataclass(frozen=True, slots=True, eq=False)
class StatusReports:
    """Rates, motors, battery and supervisor; see telemetry.VehicleStatus."""

    time: NDArray  # (N,) s
    body_rate: NDArray  # (N, 3) rad/s
    motor: NDArray  # (N, 4) int, 16-bit commands
    battery_voltage: NDArray  # (N,) V
    supervisor: NDArray  # (N,) int, bits of supervisor.info


@dataclass(frozen=True, slots=True, eq=False)
class Phases:
    """The phases of the pilot and when each began."""

    time: NDArray  # (N,) s
    phase: NDArray  # (N,) str, a value of telemetry.Phase


@dataclass(frozen=True, slots=True, eq=False)
class Events:
    """Messages for people: warnings, aborts, results."""

    time: NDArray  # (N,) s
    level: NDArray  # (N,) str, a value of telemetry.Level
    text: NDArray  # (N,) str


@dataclass(frozen=True, slots=True, eq=False)
class Commitments:
    """The setpoints to which the pilot was bound, one after another; see telemetry.PlanCommitted."""

    time: NDArray  # (N,) s
    splice: NDArray  # (N,) int, number of the first of them
    checksum: NDArray  # (N,) int, of the proposal; 0 for the commitment at the beginning
    payloads: NDArray  # (N,) bytes, 29 a setpoint


@dataclass(frozen=True, slots=True, eq=False)
class Requests:
    """The requested changes of the path; see telemetry.PathRequested."""

    time: NDArray  # (N,) s
    number: NDArray  # (N,) int
    wish: NDArray  # (N,) str
    waypoints: NDArray  # (N,) str, JSON


@dataclass(frozen=True, slots=True, eq=False)
class Answers:
    """The answers to the requests; see telemetry.PathAnswered."""

    time: NDArray  # (N,) s
    number: NDArray  # (N,) int, of the request
    verdict: NDArray  # (N,) str
    reason: NDArray  # (N,) str
    splice: NDArray  # (N,) int
    joint: NDArray  # (N,) s from setpoint 0
    ends: NDArray  # (N,) s from setpoint 0
    seconds: NDArray  # (N,) from the request to the answer


_NONE = np.empty(0)
_NO_COMMITMENTS = Commitments(_NONE, _NONE, _NONE, _NONE)
_NO_REQUESTS = Requests(_NONE, _NONE, _NONE, _NONE)
_NO_ANSWERS = Answers(*[_NONE] * 8)


@dataclass(frozen=True, slots=True, eq=False)
class Record:
    """A recorded flight; times are those of the flight's clock, cfplan.flight.clock."""

    folder: Path
    header: RecordHeader
    setpoints: Setpoints
    poses: Poses
    estimates: Estimates
    status: StatusReports
    phases: Phases
    events: Events
    summary: Mapping[str, Any]  # as written at the end of the flight; empty where there is none
    truncated: bool  # the file ends before its time, or is damaged; the streams hold all that can be read
    commitments: Commitments = _NO_COMMITMENTS
    requests: Requests = _NO_REQUESTS
    answers: Answers = _NO_ANSWERS

    @property
    def start(self) -> float:
        """Return s, the earliest time of any message; 0 in a record without messages."""
        firsts = [float(np.nanmin(times)) for times in self._times() if np.any(np.isfinite(times))]
        return min(firsts, default=0.0)

    @property
    def duration(self) -> float:
        """Return s from the first message to the last."""
        lasts = [float(np.nanmax(times)) for times in self._times() if np.any(np.isfinite(times))]
        return max(lasts, default=self.start) - self.start

    def phase_span(self, phase: str) -> tuple[float, float] | None:
        """Return s from the first entry into a phase until the next or the record's end; None where there was none."""
        entries = np.flatnonzero(self.phases.phase == phase)
        if len(entries) == 0:
            return None
        first = int(entries[0])
        after = first + 1
        end = self.phases.time[after] if after < len(self.phases.time) else self.start + self.duration
        return float(self.phases.time[first]), float(end)

    def _times(self) -> list[NDArray]:
        streams = (self.setpoints, self.poses, self.estimates, self.status, self.phases, self.events, self.commitments)
        return [stream.time for stream in streams]
