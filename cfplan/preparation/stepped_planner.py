"""A planner on a stepped clock, in the pilot's own thread: it plans in no time, and proposes as late as it is told to.

Its requests, plans and answers are those of the planner's process; only processes, pipes and the computer's own time
are left out. It can be made to fail as a process can.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from cfplan.errors import CfplanError
from cfplan.flight.clock import Clock
from cfplan.flight.setpoints.commitment import LEAST_AHEAD, Commitment, Proposal, Refusal, checksum_of
from cfplan.flight.setpoints.encoding import RATE
from cfplan.flight.telemetry import Triple
from cfplan.preparation.air_planner import (
    SLACK,
    PathAnswer,
    PathRequest,
    PathVerdict,
    Wish,
    answer_accepted,
    answer_refused,
    plan_request,
)
from cfplan.preparation.replan import HeldFlight, Replanned, accepted
from cfplan.safety.limits import Limits

PLANNING = 0.1  # s that planning takes
STOPPED = 1.0  # s for which a planner that is stopped stands still


class PlannerFault(Enum):
    """What can be wrong with a planner."""

    KILLED = "killed"  # it plans and answers nothing any more
    STOPPED = "stopped"  # each proposal comes STOPPED s later than it should
    LATE = "late"  # each proposal comes as its first setpoint is due
    GARBAGE = "garbage"  # proposals hold other bytes than were certified
    OTHER_JOINT = "other joint"  # proposals begin three setpoints away from where they were made for


@dataclass(slots=True)
class _InHand:
    """A proposal on its way to the pilot, or at it."""

    request: PathRequest
    asked: float  # s
    made: Replanned
    proposal: Proposal  # as it is sent
    due: float  # s, when it arrives


class SteppedPlanner:
    """Makes proposals of requests for a pilot on the same clock; a ProposalSource."""

    def __init__(
        self,
        held: HeldFlight,
        limits: Limits,
        clock: Clock,
        on_answer: Callable[[PathAnswer], None],
        *,
        planning: float = PLANNING,
    ):
        """Hold what the pilot's mission was made from; `planning`, s, is what a plan takes."""
        self.held, self._limits, self._clock, self._on_answer = held, limits, clock, on_answer
        self._planning = planning
        self.fault: PlannerFault | None = None
        self._number = 0
        self._begun = math.nan
        self._waiting: tuple[PathRequest, float] | None = None
        self._in_hand: _InHand | None = None

    def request(self, wish: Wish, waypoints: Sequence[Triple] = ()) -> int:
        """Ask for a change; return the number of its answer. The latest request wins."""
        self._number += 1
        if self._waiting is not None:
            self._on_answer(PathAnswer(self._waiting[0].number, PathVerdict.SUPERSEDED))
        self._waiting = PathRequest(self._number, wish, tuple(waypoints)), self._clock.now()
        return self._number

    # What the pilot calls.

    def begin(self, start: float) -> None:
        self._begun = start

    def newest(self) -> Proposal | None:
        now = self._clock.now()
        if self._in_hand is None and self._waiting is not None and self.fault is not PlannerFault.KILLED:
            (request, asked), self._waiting = self._waiting, None
            self._plan(request, asked, now)
        if self._in_hand is None or now < self._in_hand.due:
            return None
        self._in_hand.due = math.inf  # given once
        return self._in_hand.proposal

    def answer(self, proposal: Proposal, answer: Commitment | Refusal) -> None:
        if self._in_hand is None:
            return
        done, self._in_hand = self._in_hand, None
        if isinstance(answer, Commitment):
            self.held = accepted(done.made, answer)
            told = answer_accepted(done.request, done.made)
        else:
            told = answer_refused(done.request, answer)
        self._tell(told, done.asked)

    def _plan(self, request: PathRequest, asked: float, now: float) -> None:
        first = math.ceil((now - self._begun + self._planning + SLACK) * RATE) + LEAST_AHEAD
        try:
            made = plan_request(self.held, request, first, self._limits)
        except CfplanError as error:
            self._tell(PathAnswer(request.number, PathVerdict.REFUSED, str(error)), asked)
            return
        if isinstance(made, HeldFlight):
            self.held = made
            self._tell(PathAnswer(request.number, PathVerdict.ACCEPTED), asked)
            return
        due = now + self._planning
        if self.fault is PlannerFault.STOPPED:
            due += STOPPED
        elif self.fault is PlannerFault.LATE:
            due = self._begun + made.proposal.splice / RATE
        self._in_hand = _InHand(request, asked, made, self._spoilt(made.proposal), due)

    def _spoilt(self, proposal: Proposal) -> Proposal:
        if self.fault is PlannerFault.GARBAGE:
            return replace(proposal, payloads=np.roll(proposal.payloads, 7))
        if self.fault is PlannerFault.OTHER_JOINT:
            moved = proposal.splice + 3
            checksum = checksum_of(moved, proposal.payloads, proposal.stops)
            return replace(proposal, splice=moved, checksum=checksum)
        return proposal

    def _tell(self, answer: PathAnswer, asked: float) -> None:
        self._on_answer(replace(answer, seconds=self._clock.now() - asked))
