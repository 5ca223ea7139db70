"""The outcome of a flight: exit code, preflight table, phases, lateness and deviation."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from cfplan.errors import ExitCode
from cfplan.flight.pilot.deadlines import Lateness
from cfplan.flight.telemetry import Phase, Triple


class Rung(IntEnum):
    """The rungs of the abort ladder, the gravest last."""

    NONE = 0
    BRAKE = 1  # along the planned path to a hover, then land
    LAND = 2  # the same stop, then land at once, where it is
    CUT = 3  # motors off at any height


@dataclass(frozen=True, slots=True)
class Check:
    """One line of the preflight table."""

    name: str
    value: str
    threshold: str
    passed: bool
    hint: str = ""


@dataclass(frozen=True, slots=True)
class Deviation:
    """Distance of the measured position from the setpoint of the same moment, over the stream."""

    max: float  # m
    rms: float  # m
    time_of_max: float  # s from the first setpoint
    count: int  # poses that were compared

    @classmethod
    def of(cls, samples: Sequence[tuple[float, float]]) -> "Deviation":
        """Return the largest and the mean of samples (s from the first setpoint, m), in any order."""
        if not samples:
            return cls(0.0, 0.0, 0.0, 0)
        time, worst = max(samples, key=lambda sample: sample[1])
        rms = math.sqrt(sum(distance**2 for _, distance in samples) / len(samples))
        return cls(worst, rms, time, len(samples))


def settle_time(samples: Sequence[tuple[float, float]], within: float) -> float:
    """Return when, s after the end of the motion, the vehicle settled `within` m; inf if it did not.

    `samples` are (s after the end of the motion, m), ascending.
    """
    last_outside = max((index for index, (_, distance) in enumerate(samples) if distance > within), default=-1)
    return samples[last_outside + 1][0] if last_outside + 1 < len(samples) else math.inf


@dataclass(frozen=True, slots=True)
class FlightOutcome:
    """The pilot's report once the vehicle is down, or was never armed."""

    exit_code: ExitCode
    reason: str  # one line
    rung: Rung  # how far down the abort ladder it went
    checks: tuple[Check, ...]  # the checks of preflight up to the last one that was made
    phases: tuple[tuple[Phase, float], ...]  # each phase entered, with its time on the flight's clock
    first_setpoint: float  # s on the same clock; 0 if none was sent
    flown: float  # s, from the first setpoint to the last that moved
    lateness: Lateness
    deviation: Deviation
    settled_after: float  # s after the last moving setpoint; inf if it did not settle, or the plan was left
    end_position: Triple  # m, by the last pose
    telemetry_dropped: int = 0  # messages dropped because the main process was too slow
    hint: str = ""  # what to do about the first reason

    def to_dict(self) -> dict[str, Any]:
        """Return the outcome for JSON; a record's summary measures the flight from its streams."""
        return {
            "exit_code": int(self.exit_code),
            "reason": self.reason,
            "rung": self.rung.name.lower(),
            "setpoints_skipped": self.lateness.skipped,
            "telemetry_dropped": self.telemetry_dropped,
            "preflight": [
                {"name": check.name, "value": check.value, "threshold": check.threshold, "passed": check.passed}
                for check in self.checks
            ],
        }

    def check_rows(self) -> list[list[str]]:
        """Return the preflight table: check, value, threshold, verdict, and a hint if it failed."""
        return [
            [check.name, check.value, check.threshold, "ok", ""]
            if check.passed
            else [check.name, check.value, check.threshold, "FAILED", check.hint]
            for check in self.checks
        ]
