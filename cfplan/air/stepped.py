"""Drives the core of planning in the air on a stepped clock, in the pilot's thread; jobs take a given time.

Only processes, pipes and the computer's own time are left out. Faults of a real planner process can be injected.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from enum import Enum

import numpy as np

from cfplan.air.core import Answered, Asked, Begun, CoreState, Event, Made, Make, Propose, Tell, first_state, step
from cfplan.air.requests import PathAnswer, PathRequest, Wish
from cfplan.air.timeline import Replanned, Timeline
from cfplan.flight.clock import Clock
from cfplan.flight.setpoints.commitment import LEAST_AHEAD, Commitment, Proposal, Refusal, checksum_of
from cfplan.flight.setpoints.encoding import RATE
from cfplan.flight.telemetry import Triple
from cfplan.safety.limits import Limits

PLANNING = 0.1  # s that a job takes
STOPPED = 1.0  # s for which a stopped planner stands still


class PlannerFault(Enum):
    """Faults of a planner."""

    KILLED = "killed"  # it no longer plans or answers
    STOPPED = "stopped"  # each proposal comes STOPPED s later than it should
    LATE = "late"  # each proposal arrives one setpoint too late
    GARBAGE = "garbage"  # proposals hold other bytes than were certified
    OTHER_JOINT = "other joint"  # proposals begin three setpoints away from where they were made for


class SteppedPlanner:
    """Turns requests into proposals for a pilot on the same clock; a ProposalSource."""

    def __init__(
        self,
        timeline: Timeline,
        limits: Limits,
        clock: Clock,
        on_answer: Callable[[PathAnswer], None],
        *,
        planning: float = PLANNING,
    ):
        """Begin with the timeline of the pilot's mission; a job takes `planning`, s."""
        self._limits, self._clock, self._on_answer, self._planning = limits, clock, on_answer, planning
        self.state: CoreState = first_state(timeline, planning, planning)
        self.fault: PlannerFault | None = None
        self.on_committed: Callable[[Replanned], None] = lambda _: None  # called after each acceptance
        self._number = 0
        self._made: tuple[float, Made] | None = None  # when the job under way ends, s, and its result
        self._coming: tuple[float, Proposal] | None = None  # when a proposal arrives at the pilot, s, and it

    @property
    def timeline(self) -> Timeline:
        """Return what is committed and intended."""
        return self.state.timeline

    def request(self, wish: Wish, waypoints: Sequence[Triple] = ()) -> int:
        """Make a request; return its number, which its answer names. The latest request wins."""
        self._number += 1
        request = PathRequest(self._number, wish, tuple(waypoints))
        if self.fault is PlannerFault.KILLED:  # it reads nothing, and answers nothing
            self.state = replace(self.state, waiting=(request, self._clock.now()))
        else:
            self._take(Asked(request))
        return self._number

    @property
    def pending(self) -> frozenset[int]:
        """Return the numbers of the requests that are not answered yet.

        A request whose proposal the pilot left unanswered has been refused.
        """
        state = self.state
        at_pilot = None if state.sent is None or state.sent.unanswered else state.sent.job.request
        in_hand = None if state.job is None else state.job.request
        waiting = None if state.waiting is None else state.waiting[0]
        return frozenset(each.number for each in (at_pilot, in_hand, waiting) if each is not None)

    # Called by the pilot.

    def begin(self, start: float) -> None:
        self._take(Begun(start))

    def wait(self, patience: float) -> bool:
        """Let the clock go on to the next proposal, if one comes within `patience`, s."""
        if self.fault is PlannerFault.KILLED:
            return False
        until = self._clock.now() + patience
        self._work()
        while (due := self._next_due) is not None and due <= until:
            self._clock.sleep(max(due - self._clock.now(), 0.0))
            self._work()
            if self._coming is not None and self._clock.now() >= self._coming[0]:
                return True
        return False

    def newest(self) -> Proposal | None:
        self._work()
        if self._coming is None or self._clock.now() < self._coming[0]:
            return None
        (_, proposal), self._coming = self._coming, None
        return proposal

    def answer(self, proposal: Proposal, answer: Commitment | Refusal) -> None:
        sent = self.state.sent
        accepted = answer.checksum if isinstance(answer, Commitment) else None
        checksum = proposal.checksum if sent is None else sent.made.proposal.checksum  # a corrupted one has another
        self._take(Answered(checksum, accepted, self._clock.now(), "" if accepted is not None else str(answer)))
        if sent is not None and isinstance(answer, Commitment):
            self.on_committed(replace(sent.made, timeline=sent.made.accepted(answer)))

    # Internal.

    @property
    def _next_due(self) -> float | None:
        dues = [each[0] for each in (self._made, self._coming) if each is not None]
        return min(dues, default=None)

    def _work(self) -> None:
        if self.fault is PlannerFault.KILLED:
            return
        if self._made is not None and self._clock.now() >= self._made[0]:
            made, self._made = self._made[1], None
            self._take(made)
        self._take()

    def _take(self, *events: Event) -> None:
        now = self._clock.now()
        self.state, effects = step(self.state, events, now, self._limits)
        for effect in effects:
            match effect:
                case Make(job):
                    self._made = now + self._planning, job.outcome(self.state.timeline, self._limits)
                case Propose(proposal):
                    self._coming = self._arrives(proposal, now), self._spoilt(proposal)
                case Tell(answer):
                    self._on_answer(answer)

    def _arrives(self, proposal: Proposal, now: float) -> float:
        if self.fault is PlannerFault.STOPPED:
            return now + STOPPED
        if self.fault is PlannerFault.LATE:
            return self.state.begun + (proposal.splice - LEAST_AHEAD + 1) / RATE
        return now

    def _spoilt(self, proposal: Proposal) -> Proposal:
        if self.fault is PlannerFault.GARBAGE:
            return replace(proposal, payloads=np.roll(proposal.payloads, 7))
        if self.fault is PlannerFault.OTHER_JOINT:
            moved = proposal.splice + 3
            checksum = checksum_of(moved, proposal.payloads, proposal.stops)
            return replace(proposal, splice=moved, checksum=checksum)
        return proposal
