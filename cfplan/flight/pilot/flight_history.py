"""The history of one flight: its phases, preflight table, lateness and deviations, from which the outcome is made."""

import math
from collections.abc import Callable

from cfplan.errors import ExitCode
from cfplan.flight.clock import Clock
from cfplan.flight.mocap.poses import Pose
from cfplan.flight.pilot.deadlines import Lateness
from cfplan.flight.pilot.outcome import Check, Deviation, FlightOutcome, Rung, settle_time
from cfplan.flight.telemetry import Event, Level, Phase, PhaseEntered, Telemetry

SETTLED_WITHIN = 0.03  # m, from where the motion ended


class FlightHistory:
    """Collects what happens and reports it as telemetry."""

    def __init__(self, report: Callable[[Telemetry], None], clock: Clock):
        self.report, self._now = report, clock.now
        self.phases: list[tuple[Phase, float]] = []  # each with the time, s, at which it was entered
        self.checks: tuple[Check, ...] = ()  # the preflight table
        self.late: list[float] = []  # s, lateness of the plan's setpoints
        self.skipped = 0  # deadlines of the plan that passed without a setpoint
        self.off_plan: list[tuple[float, float]] = []
        """(s from the first setpoint, m) of each pose while the plan is flown and in the hover behind it."""
        self.first_setpoint = 0.0  # s, when the plan's first setpoint was due; 0 before
        self.stopped_at = 0.0  # s, when the plan was left for a stop; 0 if it was not
        self.rung = Rung.NONE  # how far down the abort ladder it went
        self.hint = ""  # what to do about the reason that ended the flight

    def enter(self, phase: Phase) -> None:
        """Note and report that a phase begins now."""
        now = self._now()
        self.phases.append((phase, now))
        self.report(PhaseEntered(now, phase))

    def add_event(self, level: Level, text: str) -> None:
        """Report an event."""
        self.report(Event(self._now(), level, text))

    def outcome(self, ends: float, exit_code: ExitCode, reason: str, last_pose: Pose | None) -> FlightOutcome:
        """Return the outcome of the flight, whose motion ended `ends` s after its first setpoint."""
        start = self.first_setpoint
        return FlightOutcome(
            exit_code=exit_code,
            reason=reason,
            rung=self.rung,
            checks=self.checks,
            phases=tuple(self.phases),
            first_setpoint=start,
            flown=min((self.stopped_at or self._now()) - start, ends) if start else 0.0,
            lateness=Lateness.of(self.late, self.skipped),
            deviation=Deviation.of([sample for sample in self.off_plan if sample[0] <= ends]),
            settled_after=settle_time([(t - ends, off) for t, off in self.off_plan if t > ends], SETTLED_WITHIN),
            hint=self.hint,
            end_position=last_pose.position if last_pose is not None else (math.nan, math.nan, math.nan),
        )
